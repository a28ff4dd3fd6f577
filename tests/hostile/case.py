"""A hostile input: something done to a small scene, and what may come of it."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.kernels.matrices import matmul

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
VIEWS, WIDTH, HEIGHT = 3, 24, 16

Spoil = Callable[[Path], Sequence[object] | None]


@dataclass(frozen=True)
class Case:
    """One hostile input.

    Args:
        spoil: Changes a scene's folder; returns the arguments of the command where they are others than the folder.
        codes: The exit codes of ``compact`` that are right.
        named: The file that an error line has to name.
        says: Values in the error line, as ``messages.names``. A case that has some is no dry run.
    """

    spoil: Spoil
    codes: tuple[int, ...] = (3,)
    named: str = ""
    says: tuple[str, ...] = ()


READ, USAGE, REFUSED, EITHER = (0,), (2,), (3,), (0, 3)


def cameras_of(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Camera-to-world poses ``[v,4,4]`` with OpenCV axes and intrinsics ``[3,3]`` of the unspoiled scene."""
    data = json.loads((folder / "transforms.json").read_text())
    c2w = matmul(np.array([frame["transform_matrix"] for frame in data["frames"]]), FLIP)
    K = np.array([[data["fl_x"], 0, data["cx"]], [0, data["fl_y"], data["cy"]], [0, 0, 1.0]])
    return c2w, K


def without_transforms(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """:func:`cameras_of`; the file is removed, so that another kind takes its place."""
    actual = cameras_of(folder)
    (folder / "transforms.json").unlink()
    return actual


def names() -> list[str]:
    return [f"view_{view:03d}" for view in range(VIEWS)]


def sparse(path: Path, size: int, start: bytes = b"") -> None:
    """A file of that many bytes, of which only the start takes room on the disk."""
    with path.open("wb") as file:
        file.write(start)
        file.truncate(size)


def add_bomb(path: Path, name: str, method: int, start: bytes = b"") -> None:
    """Add a member to an archive that unpacks to 168 MB, of which the directory promises 512 bytes."""
    with zipfile.ZipFile(path, "a", method) as archive:
        with archive.open(name, "w") as file:
            file.write(start)
            for _ in range(10):
                file.write(bytes(1 << 24))
        archive.getinfo(name).file_size = 512


def edit_json(name: str, change: Callable[[Any], Any]) -> Spoil:
    """A change to the parsed content of a file; what the change returns replaces it, unless None."""

    def spoil(folder: Path) -> None:
        path = folder / name
        data = json.loads(path.read_text())
        changed = change(data)
        path.write_text(json.dumps(data if changed is None else changed))

    return spoil


def write(name: str, content: bytes | str) -> Spoil:
    def spoil(folder: Path) -> None:
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)

    return spoil


def remove(name: str) -> Spoil:
    def spoil(folder: Path) -> None:
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return spoil
