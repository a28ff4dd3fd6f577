"""The type of a scene that was read from files, with all facts about these files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsmerge.errors import list_doubts
from gsmerge.frozen import asdict, dataclass, field
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.formats.read_gaussians import FileInfo, kept_comments
from gsmerge.io.formats.rows import FLAT_COMMENT
from gsmerge.reading.alignment import Alignment, Recovery
from gsmerge.reading.choice import Choice
from gsmerge.reading.exporters import Exporter
from gsmerge.reading.larger_photos import PhotoSource
from gsmerge.reading.scene_files import SceneFiles
from gsmerge.types import Scene


@dataclass(frozen=True)
class Loaded:
    """A scene, with all facts about its files and how these files were read.

    ``scene`` is the :class:`Scene`, and ``notes`` say what was adapted. ``candidates`` have ``kind``, ``path``,
    ``chosen``, ``reason`` and ``option`` of the cameras, photos and masks that may belong to the scene. ``info`` is
    about the file of Gaussians, ``files`` has the paths, and ``alignment`` says how near Gaussians lie to their pixels.
    """

    scene: Scene  # with pixels if the rows have them
    info: FileInfo  # header and encodings of the file of Gaussians
    files: SceneFiles  # the paths of all its files
    # the cameras as stored in their file, in the order of the views; None if there are none, or if they do not fit
    cameras: CameraFile | None
    exporters: tuple[Exporter, ...]  # the exporters that may have written the file, or the one that the caller named
    notes: tuple[str, ...]  # notes on adapted or unusual content, and doubts, one sentence each, without a full stop
    # how well every view's Gaussians project into their own pixels; None if rows have no pixels
    alignment: Alignment | None = None
    recovery: Recovery | None = None  # the layout of rows that fits best, and by how much; None without pixels
    problem: str | None = None  # why the rows have no pixels, in one sentence; None if they have pixels
    # how far each camera was moved to its Gaussians; empty if none was moved
    moves: Sequence[dict[str, Any]] = ()
    joined: Sequence[dict[str, Any]] = ()  # where each of several joined scenes lies; empty for one scene
    photos_explain: bool = False  # whether the photos that names propose explain what most views show
    stats: Mapping[Path, tuple[int, ...]] = field(default_factory=dict)  # states of the files before they were read
    source: PhotoSource | None = None  # the photos as stored, until larger photos and masks are read; then None
    sha256: str | None = None  # hash of the files of Gaussians, one after the other; None if it was not asked for
    candidates: tuple[Choice, ...] = ()  # cameras, photos and masks that may belong to the scene, with reasons
    own_views: int = 0  # number of views that the rows form, if the rows are not pixels of the cameras; else 0

    @property
    def doubts(self) -> list[str]:
        """The notes that make results doubtful, such as notes on cameras and photos that are left out."""
        return list_doubts(self.notes)

    @property
    def comments(self) -> tuple[str, ...]:
        """Comments of the file's header that a result copies; all except that on 2D Gaussians, as results are 3D."""
        return tuple(comment for comment in kept_comments(self.info) if comment != FLAT_COMMENT)

    @property
    def recognised(self) -> dict[str, Any]:
        """Facts about the input for a report, as plain JSON types."""
        cameras = self.scene.cameras
        recovery = self.recovery
        info = self.info
        facts = {
            "path": str(self.files.ply),
            "sha256": self.sha256,
            "bytes": info.file_bytes,
            "num_gaussians": self.scene.num_gaussians,
            "num_views": len(cameras),
            "height": cameras.height,
            "width": cameras.width,
            "num_photos": len(self.scene.photo_views),
            "exporters": [entry.name for entry in self.exporters],
            "rows": recovery and recovery.description,
            "moved_cameras": list(self.moves),
            "candidates": [asdict(choice) for choice in self.candidates if choice.chosen],
        }
        if self.files.parts:
            facts["parts"] = [str(path) for path in self.files.parts]
        if self.joined:
            facts["files"] = list(self.joined)
        return facts | {
            "layout": info.layout,
            "sh_degree": info.sh_degree,
            "opacity_encoding": info.opacity_encoding,
            "num_nonfinite": info.num_nonfinite,
        }
