"""Read files completely, and list the reasons why ``compact`` would refuse each of them."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

from gsmerge.compaction.files import nothing_left, shows_nothing
from gsmerge.errors import SceneError
from gsmerge.io import file_notes
from gsmerge.io.archives import damaged_member
from gsmerge.io.bounds import check_file
from gsmerge.io.cameras.npz_files import read_depths
from gsmerge.io.cameras.read import read_all_cameras
from gsmerge.io.cameras.table import CAMERA_ENDINGS, CHUNK
from gsmerge.io.formats import ply, spz, streamed
from gsmerge.io.formats.read import degree_notes
from gsmerge.io.formats.table import (
    META,
    READ_ENDINGS,
    SCENE_SUFFIXES,
    SEVERAL_USES,
    STATE_ENDING,
    find_format,
    may_hold_gaussians,
)
from gsmerge.io.image_names import IMAGE_SUFFIXES, OTHER_SUFFIXES
from gsmerge.networks.checkpoint import load_checkpoint
from gsmerge.runtime.memory import human_bytes
from gsmerge.scene.exporters import AUTO
from gsmerge.scene.files import find_scene_files, list_plys
from gsmerge.scene.read import load_files
from gsmerge.settings.reading import OpacityChoice, ReadHints
from gsmerge.states.state_file import holds_features, load_state

NETWORKS = ".safetensors"
CAMERAS = (*CAMERA_ENDINGS, ".bin")
ARCHIVES = (".sog", ".npz", CHUNK)


@dataclass(frozen=True)
class FileCheck:
    """Content of a file, and the reasons to refuse it."""

    path: str
    kind: str  # "Gaussians", "cameras", "networks" or "Feature Gaussians"; "" if the file cannot be read
    count: int = 0  # Number of Gaussians, Feature Gaussians, views of cameras, or parameters of networks
    layout: str = ""  # Layout of the columns, or format of the camera file
    file_bytes: int = 0
    problems: tuple[str, ...] = ()  # One sentence each, without a full stop
    notes: tuple[str, ...] = ()  # Unusual content that is not wrong, and content that was not read
    num_views: int = 0  # Views of a scene with cameras
    num_photos: int = 0  # Photos of a scene

    @property
    def line(self) -> str:
        """The result as one line for people."""
        if self.problems:
            return f"wrong  {self.path}: {'; '.join(self.problems)}"
        unit = {"networks": "parameters"}.get(self.kind, self.kind)
        size = f", {human_bytes(self.file_bytes)}" if self.file_bytes else ""
        layout = f", {self.layout}" if self.layout else ""
        views = f", {self.num_views:,} cameras, {self.num_photos:,} photos" if self.num_views else ""
        return f"ok     {self.path}: {self.count:,} {unit}{layout}{views}{size}"


def check_content(path: Path, *, opacity: OpacityChoice = "auto", hints: ReadHints = AUTO) -> FileCheck:
    """Read a file completely: Gaussians with the cameras and photos beside them, cameras, networks or a ``.gsm``.

    The ending decides the kind of file. A scene is read as ``compact`` reads it. UsageError if a package is missing.
    """
    try:
        file_check = _read_scene(path, opacity, hints) if holds_scene(path) else _read(path)
    except SceneError as error:
        return FileCheck(str(path), "", problems=(str(error).removeprefix(f"{path}: "),))
    problems = (*file_check.problems, *list_damage(path))
    size = 0 if path.is_dir() else path.stat().st_size
    return replace(file_check, file_bytes=file_check.file_bytes or size, problems=problems)


def holds_scene(path: Path) -> bool:
    """Return whether a path is read as a scene, not as cameras, networks, levels or a state."""
    suffix = path.suffix.lower()
    if suffix in SEVERAL_USES:
        return os.path.exists(path) and may_hold_gaussians(path)
    if suffix == STATE_ENDING:
        return os.path.isfile(path) and not holds_features(path)
    if path.name == META:
        return find_format(path).holds(path)
    return suffix in SCENE_SUFFIXES or os.path.isdir(path)


def list_damage(path: Path) -> list[str]:
    """List problems that reading a file does not reveal: bytes after its content, and wrong checksums of its parts."""
    suffix = path.suffix.lower()
    if os.path.isdir(path):
        return [f"{file.name}: {problem}" for file in list_plys(path) for problem in list_damage(file)]
    problem = None
    if suffix in ARCHIVES:
        problem = damaged_member(path)
    elif suffix == ".spz":
        problem = spz.problem_at_end(path)
    elif suffix == ".ply" and (surplus := ply.bytes_after_rows(path)):
        problem = f"{surplus:,} bytes after the last row, which are not read"
    return [problem] if problem else []


def _read(path: Path) -> FileCheck:
    """Read a file that is not a scene; SceneError if it cannot be read."""
    suffix = path.suffix.lower()
    if suffix == STATE_ENDING:
        return FileCheck(str(path), "Feature Gaussians", len(load_state(path)))
    if path.name == streamed.INDEX:
        return _read_levels(path)
    if suffix == NETWORKS:
        return FileCheck(str(path), "networks", load_checkpoint(path).networks.num_parameters)
    if suffix in CAMERAS:
        return _read_cameras(path)
    check_file(path)
    if suffix in SCENE_SUFFIXES:
        find_scene_files(path)  # which says what a file without Gaussians holds
    if suffix in IMAGE_SUFFIXES | OTHER_SUFFIXES:
        raise ply.no_ply(path)
    endings = ", ".join(dict.fromkeys((*READ_ENDINGS, *CAMERAS, NETWORKS)))
    raise SceneError(path, f"expected one of {endings}, found another kind of file")


def _read_scene(path: Path, opacity: OpacityChoice, hints: ReadHints) -> FileCheck:
    """Read the Gaussians of a scene, with the cameras and photos that belong to them."""
    load = load_files(find_scene_files(path), opacity=opacity, hints=hints)
    if shows_nothing(load.scene):
        raise nothing_left(load.files.ply)
    info, views = load.info, load.views
    notes, num_photos = (*load.notes, *degree_notes(info)), 0 if views.images is None else len(views.images)
    return FileCheck(
        str(path), "Gaussians", info.count, info.layout, info.file_bytes, notes=notes,
        num_views=len(views.cameras), num_photos=num_photos,
    )  # fmt: skip


def _read_cameras(path: Path) -> FileCheck:
    """Read the cameras of a file; if it has several scenes, read the cameras of all."""
    count = 0
    for cameras in read_all_cameras(path):
        count += len(cameras)
    if Path(cameras.path).suffix == ".npz":
        read_depths(Path(cameras.path))
    return FileCheck(str(path), "cameras", count, cameras.source)


def _read_levels(path: Path) -> FileCheck:
    """Read all levels of detail of an index, one after the other."""
    index = streamed.read_index(path)
    infos = [streamed.read_level(path, level, index).info for level in range(len(index.levels))]
    total_bytes = sum(info.file_bytes for info in infos) - (len(infos) - 1) * path.stat().st_size
    notes = dict.fromkeys(note for info in infos for note in file_notes(info))
    return FileCheck(str(path), "Gaussians", infos[0].count, infos[0].layout, total_bytes, notes=tuple(notes))
