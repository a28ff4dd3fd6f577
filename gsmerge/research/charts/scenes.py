"""The scenes of a grid as files: names, held-out views, and a hash of all that is read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsmerge.errors import SceneError, UsageError
from gsmerge.io import SceneFiles, find_scene_files
from gsmerge.io.cameras.colmap import is_colmap
from gsmerge.io.cameras.read import find_cameras
from gsmerge.io.content_hash import cameras_of, content_hash, filled, photos_of, read_files, stem_of


@dataclass(frozen=True)
class SceneSource:
    """A scene before it is read."""

    path: Path  # as given
    name: str  # short name, different for every scene of a grid
    files: SceneFiles  # gaussians, cameras, photos
    targets: Path | None  # cameras of the held-out views; None without any
    target_images: Path | None  # folder of their photos; None: found by their cameras
    num_views: int | None  # views of its camera file, an upper bound for those of the scene; None if unknown
    sha256: str  # of everything that is read


def find_scenes(
    scenes: Sequence[Path], targets: str | None = None, target_images: str | None = None
) -> list[SceneSource]:
    """The files of all scenes: ``.ply`` files, or the folders that they are in.

    ``targets``, cameras of held-out views, and ``target_images``, the folder of their photos, are one path for all or a
    template with ``{scene}`` (as given), ``{parent}`` (its folder) and ``{stem}`` (its name without extension) in it. A
    SceneError if a file is missing, a UsageError if a scene is given twice or a template holds another name.
    """
    named = zip(scenes, scene_names(scenes), strict=True)
    return [_make_source(one, name, filled(targets, one), filled(target_images, one)) for one, name in named]


def scene_names(scenes: Sequence[Path]) -> list[str]:
    """A short name for every scene: its own, with as many folders before it as it takes to distinguish them.

    A UsageError if a scene is given twice.
    """
    parts = [(*scene.absolute().parent.parts, stem_of(scene.absolute())) for scene in scenes]
    for depth in range(1, max(map(len, parts), default=0) + 1):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    if not scenes:
        return []
    raise UsageError("expected every scene once, got one twice")


def _make_source(scene: Path, name: str, targets: Path | None, target_images: Path | None) -> SceneSource:
    files = find_scene_files(scene)
    if targets is not None and not targets.exists():
        raise SceneError(targets, f"expected cameras of held-out views of {scene}, found nothing")
    read = [files.ply, files.cameras, files.images, targets and _cameras_inside(targets), target_images]
    read += [*read_files(files), *(photos_of(targets) if targets else [])]
    cameras = None if files.cameras is None else cameras_of(files.cameras, files.ply.stem)
    num_views = None if cameras is None else len(cameras)
    once = dict.fromkeys(path for path in read if path is not None)
    return SceneSource(scene, name, files, targets, target_images, num_views, content_hash(list(once)))


def _cameras_inside(path: Path) -> Path:
    """The cameras that are read from a folder: other files in it, such as results, do not change the hash."""
    cameras = find_cameras(path) if path.is_dir() and not is_colmap(path) else None
    return path if cameras is None else cameras
