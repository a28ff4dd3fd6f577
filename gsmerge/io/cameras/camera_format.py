"""Camera formats as records: how the files of one are recognised and read, and how they store poses."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from plyfile import PlyData

from gsmerge.errors import SceneError
from gsmerge.io.bounds import read_json
from gsmerge.io.cameras.camera_file import CameraFile, Convention, StoredView, make_camera_file
from gsmerge.io.formats.ply import open_ply
from gsmerge.io.photo_files import PhotoArrays


@dataclass(frozen=True)
class CameraSource:
    """A camera file or COLMAP folder, whose content is read once, at the first use."""

    path: Path
    scene: str | None = None  # which one, where a file holds several
    folder: Path | None = None  # of the Gaussians, where a backbone writes how it moved the cameras

    @cached_property
    def json(self) -> Any:
        """Parsed content of a JSON file."""
        return read_json(self.path)

    @property
    def object(self) -> dict[str, Any]:
        """Parsed content of a JSON file that holds one object; empty for other files."""
        return self.json if isinstance(self.json, dict) else {}

    @property
    def first(self) -> dict[str, Any]:
        """First entry of a JSON file that holds a list of objects; empty for other files."""
        entries = self.json if isinstance(self.json, list) else []
        return entries[0] if entries and all(isinstance(entry, dict) for entry in entries) else {}

    @cached_property
    def ply(self) -> PlyData:
        """Elements of a PLY file."""
        return open_ply(self.path)


class StoredCameras(NamedTuple):
    """Cameras as a file stores them, before conversion."""

    views: list[StoredView]
    images: PhotoArrays = ()  # ``[c,h,w,3]`` uint8 sRGB; empty without any
    order: str = "auto"  # of the Gaussians' rows
    convention: Convention | None = None  # where the numbers show another one than the format's


@dataclass(frozen=True)
class CameraFormat:
    """A format of camera files: how to recognise and read it, and its conventions."""

    name: str  # the ``source`` of its cameras
    files: str  # for people
    ending: str  # of files' names, in lower case; "" for a folder
    read: Callable[[CameraSource], StoredCameras]  # SceneError where it is damaged
    convention: Convention
    intrinsics: str  # how they are stored, for people
    recognise: Callable[[CameraSource], bool] = lambda _: True  # of a file with the ending

    def cameras(self, source: CameraSource) -> CameraFile:
        """Read the cameras of a file; SceneError if it is damaged or incomplete."""
        return self.convert(source.path, self.read(source))

    def convert(self, path: Path, stored: StoredCameras) -> CameraFile:
        """Convert the cameras that a file stores; SceneError if one of them is invalid."""
        convention = stored.convention or self.convention
        return make_camera_file(path, self.name, convention, stored.views, stored.images, stored.order)


@contextmanager
def number_errors(path: Path, expected: str) -> Iterator[None]:
    """Turn errors of missing entries, and of values that are no numbers or objects, in the block into a SceneError."""
    try:
        yield
    except (LookupError, AttributeError, TypeError, ValueError, ArithmeticError) as error:
        raise SceneError(path, f"{expected} ({error})") from error


def to_number(value: Any) -> float:
    """Convert a JSON number; TypeError for true, false and null, ValueError for other text."""
    if isinstance(value, bool):
        raise TypeError(f"found {str(value).lower()}")
    return float(value)


def to_array(values: Any) -> np.ndarray:
    """Convert lists of numbers to float64; errors as in :func:`to_number`."""
    array = np.array(values, np.float64)
    if bool in set(map(type, np.array(values, object).flat)):
        raise TypeError("found true or false")
    return array
