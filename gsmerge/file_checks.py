"""Read files to their ends, and list what is wrong with each."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from gsmerge.errors import SceneError
from gsmerge.io import file_notes, read_cameras, read_gaussians
from gsmerge.io.bounds import check_file
from gsmerge.io.cameras.camera_file import as_pinholes, to_cameras
from gsmerge.io.cameras.embedded import holds_cameras
from gsmerge.io.cameras.npz_files import READ_ARRAYS, array_names, read_depths
from gsmerge.io.cameras.read import CAMERA_ENDINGS, CHUNK, is_colmap, read_all_cameras, read_sharp_camera
from gsmerge.io.formats import ply, spz, streamed
from gsmerge.io.formats.read import FileInfo, degree_notes
from gsmerge.io.formats.table import SCENE_SUFFIXES
from gsmerge.networks.checkpoint import load_checkpoint
from gsmerge.runtime.memory import human_bytes
from gsmerge.scene.files import find_scene_files, list_plys
from gsmerge.scene.no_gaussians import check_scene_file
from gsmerge.scene.read import load_files
from gsmerge.settings.extend import SUFFIX
from gsmerge.states.gsm_file import read_gsm, wrong_checksums
from gsmerge.states.state_file import load_state

NETWORKS = ".safetensors"
CAMERAS = (*CAMERA_ENDINGS, ".bin")
ARCHIVES = (".sog", ".npz", CHUNK)


@dataclass(frozen=True)
class FileCheck:
    """Content of a file and the problems found in it."""

    path: str
    kind: str  # "Gaussians", "cameras", "networks" or "state"; "" where it cannot be read
    count: int = 0  # Gaussians, views, parameters or groups
    layout: str = ""  # of the columns or of the cameras' file
    file_bytes: int = 0
    problems: tuple[str, ...] = ()  # one sentence each, without a full stop
    notes: tuple[str, ...] = ()  # what is odd, and not wrong, and what was not read
    num_views: int = 0  # cameras of a scene's folder
    num_photos: int = 0  # and their photos

    @property
    def line(self) -> str:
        """The result in one line for people."""
        if self.problems:
            return f"wrong  {self.path}: {'; '.join(self.problems)}"
        units = {"Gaussians": "Gaussians", "cameras": "cameras", "networks": "parameters"}
        unit = units.get(self.kind)
        size = f", {human_bytes(self.file_bytes)}" if self.file_bytes else ""
        layout = f", {self.layout}" if self.layout else ""
        views = f", {self.num_views:,} cameras, {self.num_photos:,} photos" if self.num_views else ""
        return f"ok     {self.path}: {self.count:,} {unit or f'groups, {self.kind}'}{layout}{views}{size}"


def check_content(path: Path) -> FileCheck:
    """Read a file of Gaussians, cameras or networks, a ``.gsm`` or a scene to its end, and check its content.

    The ending tells the kind of file. A folder has cameras, or a scene, which is read as ``compact`` reads it.
    UsageError if a package is missing.
    """
    try:
        file_check = _read(path)
    except SceneError as error:
        return FileCheck(str(path), "", problems=(_problem(error, path),))
    damaged = _damaged_member(path) if path.suffix.lower() in ARCHIVES else None
    problems = (*file_check.problems, *([damaged] if damaged else []))
    size = 0 if path.is_dir() else path.stat().st_size
    return replace(file_check, file_bytes=file_check.file_bytes or size, problems=problems)


def _problem(error: SceneError, path: Path) -> str:
    """Describe an error, with the name of its file unless that is ``path``."""
    return str(error).removeprefix(f"{path}: ")


def _read(path: Path) -> FileCheck:
    suffix = path.suffix.lower()
    if suffix == SUFFIX:
        return _read_gsm(path)
    if path.name == streamed.INDEX:
        return _read_levels(path)
    if suffix == NETWORKS:
        return FileCheck(str(path), "networks", load_checkpoint(path).networks.num_parameters)
    is_folder = os.path.isdir(path)
    if is_folder and list_plys(path):
        return _read_scene(path)
    if is_folder or suffix in CAMERAS:
        return _read_cameras(path)
    check_file(path)
    if suffix not in SCENE_SUFFIXES:
        endings = ", ".join((*SCENE_SUFFIXES, *CAMERAS, SUFFIX, NETWORKS, streamed.INDEX))
        raise SceneError(path, f"expected one of {endings}, found another kind of file", "it is not checked")
    file_check = _read_gaussians(path)
    beside: list[Path | None] = []
    with suppress(SceneError):  # of another file
        files = find_scene_files(path)
        beside = [files.cameras, files.images, files.masks]
    names = [place.name for place in beside if place not in (None, path)]
    return replace(file_check, notes=(*file_check.notes, *_not_read(names, " beside it")))


def _read_gaussians(path: Path) -> FileCheck:
    """Read a file of Gaussians, with the cameras inside it."""
    check_scene_file(path)
    info, suffix = read_gaussians(path).info, path.suffix.lower()
    problems = _problems(info)
    if suffix == ".spz":
        problems += [problem for problem in [spz.problem_at_end(path)] if problem]
    elif suffix == ".ply":
        if holds_cameras(path):
            pinholes, *_ = as_pinholes(read_cameras(path), ())
            to_cameras(pinholes)
        read_sharp_camera(path)
        left = ply.bytes_after_rows(path)
        behind = f"{left:,} bytes after the last of {info.count:,} rows, which nothing reads"
        problems += [behind] if left else []
    notes = (*(note for note in file_notes(info) if "opacit" in note), *degree_notes(info))
    return FileCheck(str(path), "Gaussians", info.count, info.layout, info.file_bytes, tuple(problems), notes)


def _read_scene(path: Path) -> FileCheck:
    """Read all Gaussians of a folder, with the cameras and photos that belong to them."""
    files = find_scene_files(path)
    parts = [_read_gaussians(ply) for ply in files.plys]
    starts = [f"{ply.name}: " if files.parts else "" for ply in files.plys]
    problems = [start + text for start, part in zip(starts, parts, strict=True) for text in part.problems]
    notes = [note for part in parts for note in part.notes]
    scene = replace(
        parts[0], path=str(path), count=sum(part.count for part in parts),
        file_bytes=sum(part.file_bytes for part in parts),
    )  # fmt: skip
    try:
        load = load_files(files)
    except SceneError as error:
        problems.append(_problem(error, path))
    else:
        notes += [note for note in load.notes if note not in file_notes(load.info)]
        scene = replace(scene, num_views=len(load.views.cameras), num_photos=len(load.views.images))
    return replace(scene, problems=tuple(problems), notes=tuple(dict.fromkeys(notes)))


def _read_cameras(path: Path) -> FileCheck:
    """Read the cameras of a file, of all scenes if it has several, or of a folder."""
    count, notes = 0, list[str]()
    for cameras in read_all_cameras(path):
        count += len(cameras)
    source, place = cameras.source, Path(cameras.path)
    if path.is_dir() and not is_colmap(path):
        notes.append("the folder has no Gaussians: its cameras alone were read")
    if place.is_dir():
        ending = ".bin" if source == "COLMAP binary" else ".txt"
        read = {f"{name}{ending}" for name in ("cameras", "images")}
        others = sorted(file.name for file in place.iterdir() if file.suffix in (".bin", ".txt"))
        notes += _not_read([name for name in others if name not in read])
    elif place.suffix == ".npz":
        read_depths(place)
        notes += _not_read(sorted(array_names(place) - READ_ARRAYS), " but for their checksums")
    return FileCheck(str(path), "cameras", count, source, notes=tuple(notes))


def _not_read(names: Sequence[str], remark: str = "") -> list[str]:
    """Make a note of the files that were not read; none if all were."""
    more = f" and {len(names) - 4} more" if len(names) > 4 else ""
    return [f"not read{remark}: {', '.join(names[:4])}{more}"] if names else []


def _read_levels(path: Path) -> FileCheck:
    """Read all levels of an index, one after the other."""
    index = streamed.read_index(path)
    infos = [streamed.read_level(path, level, index).info for level in range(len(index.levels))]
    problems = [f"level {level}: {problem}" for level, info in enumerate(infos) for problem in _problems(info)]
    beside = sum(info.file_bytes for info in infos) - (len(infos) - 1) * path.stat().st_size
    return FileCheck(str(path), "Gaussians", infos[0].count, infos[0].layout, beside, tuple(problems))


def _problems(info: FileInfo) -> list[str]:
    """Describe the rows that a reader sets aside or changes."""
    extreme = "Gaussian(s) with a log scale beyond +-30 or a harmonic beyond +-1e6"
    counted = {
        "row(s) with NaN or inf": info.num_nonfinite,
        extreme: info.num_clipped_scales,
        "Gaussian(s) with a rotation of length 0": info.num_zero_quats,
    }
    return [f"{count:,} of {info.count:,} {what}" for what, count in counted.items() if count]


def _read_gsm(path: Path) -> FileCheck:
    wrong = wrong_checksums(read_gsm(path))
    notes = () if wrong is not None else ("no checksums: an older gsmerge wrote it",)
    problems = [f"{', '.join(wrong[:4])}: not what was written, by the checksums"] if wrong else []
    try:
        state = load_state(path)
    except SceneError as error:
        problems.append(_problem(error, path))
        return FileCheck(str(path), "", problems=tuple(problems), notes=notes)
    return FileCheck(str(path), "state", len(state), problems=tuple(problems), notes=notes)


def _damaged_member(path: Path) -> str | None:
    """Name a file in an archive that does not have its checksum; None if all have."""
    try:
        with zipfile.ZipFile(path) as archive:
            name = archive.testzip()
    except Exception as error:  # whatever a damaged archive makes the library raise
        return f"cannot be unpacked ({' '.join(str(error).split())})"
    return None if name is None else f"{name}: not what was written, by its checksum"
