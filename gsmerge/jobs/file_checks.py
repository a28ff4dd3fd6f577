"""Read files completely, and list the reasons why ``compact`` would refuse each of them."""

from __future__ import annotations

import os
from pathlib import Path

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass, replace
from gsmerge.io import file_notes
from gsmerge.io.bounds import check_file
from gsmerge.io.cameras.read_cameras import read_cameras
from gsmerge.io.cameras.table import CAMERA_ENDINGS
from gsmerge.io.formats import ply, streamed
from gsmerge.io.formats.read_gaussians import degree_notes, read_gaussians
from gsmerge.io.formats.table import HTML, READ_ENDINGS, SCENE_SUFFIXES, STATE, STATE_ENDING, may_hold_gaussians
from gsmerge.io.image_names import IMAGE_SUFFIXES, OTHER_SUFFIXES
from gsmerge.jobs.batch.records import RECORDS
from gsmerge.jobs.states.state_file import holds_features, load_state
from gsmerge.reading.checkpoint import load_checkpoint
from gsmerge.reading.exporters import NO_HINTS
from gsmerge.reading.read_scene import read_files
from gsmerge.reading.scene_files import find_scene_files
from gsmerge.runtime.memory import human_bytes
from gsmerge.settings.reading import OpacityChoice, ReadHints

NETWORKS = ".safetensors"
CAMERA_FILE_ENDINGS = (*CAMERA_ENDINGS, ".bin")


@dataclass(frozen=True)
class FileCheck:
    """Content of a file, and the reasons to refuse the file."""

    path: str
    kind: str  # "Gaussians", "cameras", "networks" or "Feature Gaussians"; "" if the file cannot be read
    count: int = 0  # Number of Gaussians, cameras, parameters of networks, or Feature Gaussians
    layout: str = ""  # Layout of the columns, or format of the camera file
    file_bytes: int = 0
    problems: tuple[str, ...] = ()  # One sentence each, without a full stop
    notes: tuple[str, ...] = ()  # Unusual content that is not wrong, and content that was not read
    num_views: int = 0  # Views of a scene with cameras
    num_photos: int = 0  # Photos of a scene

    @property
    def line(self) -> str:
        """The result as one line of text."""
        if self.problems:
            return f"wrong  {self.path}: {'; '.join(self.problems)}"
        unit = "parameters" if self.kind == "networks" else self.kind
        size = f", {human_bytes(self.file_bytes)}" if self.file_bytes else ""
        layout = f", {self.layout}" if self.layout else ""
        views = f", {self.num_views:,} cameras, {self.num_photos:,} photos" if self.num_views else ""
        return f"ok     {self.path}: {self.count:,} {unit}{layout}{views}{size}"


def check_content(path: Path, *, opacity: OpacityChoice = "auto", hints: ReadHints = NO_HINTS) -> FileCheck:
    """Read a scene, a file of cameras or networks, or a ``.gsm`` completely, and return what it holds.

    The ending of the path decides the kind of file. A scene is read as ``compact`` reads it, with cameras and photos. A
    file that cannot be read is returned with its problem. UsageError if a package is missing.
    """
    try:
        if not holds_scene(path):
            file_check = _read_other(path)
        else:
            load = read_files(find_scene_files(path), opacity=opacity, hints=hints)
            info = load.info
            images = load.scene.images
            notes = (*load.notes, *degree_notes(info))
            num_photos = 0 if images is None else len(images)
            file_check = FileCheck(
                str(path), "Gaussians", info.count, info.layout, info.file_bytes, notes=notes,
                num_views=len(load.scene), num_photos=num_photos,
            )  # fmt: skip
    except SceneError as error:
        return FileCheck(str(path), "", problems=(str(error).removeprefix(f"{path}: "),))
    size = 0 if path.is_dir() else path.stat().st_size
    return replace(file_check, file_bytes=file_check.file_bytes or size)


def holds_scene(path: Path) -> bool:
    """Return whether a path is read as a scene, and not as cameras, networks, levels of detail or a state."""
    if STATE.names(path):
        return os.path.isfile(path) and not holds_features(path)
    return os.path.isdir(path) or may_hold_gaussians(path)


def _read_other(path: Path) -> FileCheck:
    """Read a file that is not a scene; SceneError if it cannot be read."""
    suffix = path.suffix.lower()
    if suffix == STATE_ENDING:
        return FileCheck(str(path), "Feature Gaussians", len(load_state(path)))
    if path.name == streamed.INDEX:
        index = streamed.read_index(path)
        infos = [streamed.read_level(path, level, index).info for level in range(len(index.levels))]
        # The index counts in the bytes of every level
        total_bytes = sum(info.file_bytes for info in infos) - (len(infos) - 1) * path.stat().st_size
        notes = dict.fromkeys(note for info in infos for note in file_notes(info))
        return FileCheck(str(path), "Gaussians", infos[0].count, infos[0].layout, total_bytes, notes=tuple(notes))
    if suffix == NETWORKS:
        return FileCheck(str(path), "networks", load_checkpoint(path).networks.num_parameters)
    if suffix in CAMERA_FILE_ENDINGS:
        cameras = read_cameras(path)
        return FileCheck(str(path), "cameras", len(cameras), cameras.source)
    check_file(path)
    if path.name == RECORDS:
        problem = "expected a scene, found the records of a batch"
        raise SceneError(path, problem, "gsmerge batch continues from them; name a result of it")
    if suffix in SCENE_SUFFIXES:
        find_scene_files(path)  # raises an error that says what a file without Gaussians holds
    if suffix == HTML.ending:
        read_gaussians(path)  # raises an error that says what to name in its place
    if suffix in IMAGE_SUFFIXES | OTHER_SUFFIXES:
        raise ply.no_ply_error(path)
    endings = ", ".join(dict.fromkeys((*READ_ENDINGS, *CAMERA_FILE_ENDINGS, NETWORKS)))
    raise SceneError(path, f"expected one of {endings}, found another kind of file")
