"""Read files to their ends, and list what is wrong with each."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

from gsmerge.encoded.encoded import Encoded
from gsmerge.encoded.gsm_file import ENCODED, STATE, SUFFIX, read_gsm, wrong_checksums
from gsmerge.errors import SceneError
from gsmerge.io import file_notes, read_cameras, read_gaussians
from gsmerge.io.cameras.read import CAMERA_ENDINGS, find_cameras, read_sharp_camera
from gsmerge.io.formats import ply, spz, streamed
from gsmerge.io.formats.read import FileInfo, degree_notes, read_level
from gsmerge.io.formats.table import SCENE_SUFFIXES
from gsmerge.networks.checkpoint import load_checkpoint
from gsmerge.online.file import load_stored
from gsmerge.report import human_bytes
from gsmerge.scene.files import find_plys, list_plys

NETWORKS = ".safetensors"
CAMERAS = (*CAMERA_ENDINGS, ".bin")
ARCHIVES = (".sog", ".npz")


@dataclass(frozen=True)
class FileCheck:
    """Content of a file and the problems found in it."""

    path: str
    # "Gaussians", "cameras", "networks", "encoded scene" or "state"; "" where it cannot be read
    kind: str
    count: int = 0  # Gaussians, views, parameters or groups
    layout: str = ""  # of the columns or of the cameras' file
    file_bytes: int = 0
    problems: tuple[str, ...] = ()  # one sentence each, without a full stop
    notes: tuple[str, ...] = ()  # what is odd, and not wrong

    @property
    def line(self) -> str:
        """The result in one line for people."""
        if self.problems:
            return f"wrong  {self.path}: {'; '.join(self.problems)}"
        units = {"Gaussians": "Gaussians", "cameras": "cameras", "networks": "parameters"}
        unit = units.get(self.kind)
        size = f", {human_bytes(self.file_bytes)}" if self.file_bytes else ""
        layout = f", {self.layout}" if self.layout else ""
        return f"ok     {self.path}: {self.count:,} {unit or f'groups, {self.kind}'}{layout}{size}"


def check_content(path: Path) -> FileCheck:
    """Read a file of Gaussians, cameras or networks, or a ``.gsm``, to its end, and check its content.

    The ending says which it is; a folder has the cameras of a COLMAP model. UsageError if a package
    is missing.
    """
    try:
        file_check = _read(path)
    except SceneError as error:
        problem = str(error).removeprefix(f"{path}: ")
        return FileCheck(str(path), "", problems=(problem,))
    damaged = _damaged_member(path) if path.suffix.lower() in ARCHIVES else None
    problems = (*file_check.problems, *([damaged] if damaged else []))
    size = 0 if path.is_dir() else path.stat().st_size
    return replace(file_check, file_bytes=file_check.file_bytes or size, problems=problems)


def _read(path: Path) -> FileCheck:
    suffix = path.suffix.lower()
    if suffix == SUFFIX:
        return _read_gsm(path)
    if path.name == streamed.INDEX:
        return _read_levels(path)
    if suffix == NETWORKS:
        return FileCheck(str(path), "networks", load_checkpoint(path).networks.num_parameters)
    if path.is_dir() and list_plys(path):  # a scene
        return _read_scene(path)
    if path.is_dir() or suffix in CAMERAS:
        cameras = read_cameras(path)
        return FileCheck(str(path), "cameras", len(cameras), cameras.source)
    if suffix not in SCENE_SUFFIXES:
        endings = ", ".join((*SCENE_SUFFIXES, *CAMERAS, SUFFIX, NETWORKS, streamed.INDEX))
        raise SceneError(path, f"expected one of {endings}, found another kind of file", "it is not checked")
    info = read_gaussians(path).info
    problems = _problems(info)
    if suffix == ".spz":
        problems += [problem for problem in [spz.problem_at_end(path)] if problem]
    elif suffix == ".ply":
        read_sharp_camera(path)
        left = ply.bytes_after_rows(path)
        behind = f"{left:,} bytes after the last of {info.count:,} rows, which nothing reads"
        problems += [behind] if left else []
    notes = [*(note for note in file_notes(info) if "opacit" in note), *degree_notes(info)]
    facts = (str(path), "Gaussians", info.count, info.layout)
    return FileCheck(*facts, problems=tuple(problems), notes=tuple(notes))


def _read_scene(path: Path) -> FileCheck:
    """Read the Gaussians of a folder, of all parts if it has several, and its cameras."""
    cameras_path, plys = find_cameras(path), find_plys(path)
    if cameras_path is not None:
        read_cameras(cameras_path, scene=plys[0].stem)
    parts = [_read(ply) for ply in plys]
    starts = [f"{ply.name}: " if len(plys) > 1 else "" for ply in plys]
    problems = [start + text for start, part in zip(starts, parts, strict=True) for text in part.problems]
    count, notes = sum(part.count for part in parts), tuple(dict.fromkeys(note for p in parts for note in p.notes))
    return replace(parts[0], path=str(path), count=count, problems=tuple(problems), notes=notes)


def _read_levels(path: Path) -> FileCheck:
    """Read all levels of an index, one after the other."""
    index = streamed.read_index(path)
    infos = [read_level(path, level, index).info for level in range(len(index.levels))]
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
    wrong = wrong_checksums(read_gsm(path, ENCODED, STATE))
    notes = () if wrong is not None else ("no checksums: an older gsmerge wrote it",)
    problems = [f"{', '.join(wrong[:4])}: not what was written, by the checksums"] if wrong else []
    try:
        stored = load_stored(path)
    except SceneError as error:
        problems.append(error.problem)
        return FileCheck(str(path), "", problems=tuple(problems), notes=notes)
    kind = "encoded scene" if isinstance(stored, Encoded) else "state"
    return FileCheck(str(path), kind, len(stored), problems=tuple(problems), notes=notes)


def _damaged_member(path: Path) -> str | None:
    """Name a file in an archive that does not have its checksum; None if all have."""
    try:
        with zipfile.ZipFile(path) as archive:
            name = archive.testzip()
    except Exception as error:  # whatever a damaged archive makes the library raise
        return f"cannot be unpacked ({' '.join(str(error).split())})"
    return None if name is None else f"{name}: not what was written, by its checksum"
