"""Classes for what camera readers take and return, and functions that convert the numbers in files of cameras."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass
from gsmerge.io.bounds import read_json
from gsmerge.io.cameras.camera_file import Convention, StoredView
from gsmerge.io.formats.ply import Element, open_ply
from gsmerge.io.photo_files import PhotoArrays


@dataclass(frozen=True)
class CameraSource:
    """A camera file or folder, whose content is read once, at the first use."""

    path: Path
    folder: Path | None = None  # folder of the Gaussians, where some models write how they moved the cameras

    @cached_property
    def json(self) -> Any:
        """Parsed content of the file, which is JSON."""
        return read_json(self.path)

    @property
    def object(self) -> dict[str, Any]:
        """Parsed content of a JSON file that holds one object; empty for any other JSON file."""
        return self.json if isinstance(self.json, dict) else {}

    @property
    def first(self) -> dict[str, Any]:
        """First entry of a JSON file that holds a list of objects; empty for any other JSON file."""
        entries = self.json if isinstance(self.json, list) else []
        return entries[0] if entries and all(isinstance(entry, dict) for entry in entries) else {}

    @cached_property
    def ply(self) -> dict[str, Element]:
        """Elements of a PLY file."""
        return open_ply(self.path)[0].elements


def check_objects(path: Path, entries: Sequence[Any], place: str = "the file") -> None:
    """Raise SceneError, with the number of the first wrong entry, if an entry of a JSON list is no object."""
    for i, entry in enumerate(entries):
        if not isinstance(entry, dict):
            found = "a list" if isinstance(entry, list) else json.dumps(entry)
            raise SceneError(path, f"expected {place} to be a list of objects, found {found:.40} as entry {i + 1}")


class StoredCameras(NamedTuple):
    """Cameras as a file stores them, before they are converted to a :class:`CameraFile`."""

    views: list[StoredView]
    images: PhotoArrays = ()  # ``[c,h,w,3]`` uint8 sRGB; empty without any
    order: str = "auto"  # order of the Gaussians' rows
    convention: Convention | None = None  # convention of the poses if it differs from that of the format
    counts: np.ndarray | None = None  # ``[c,h,w]`` bool, where ``images`` count; None: everywhere
    depths: np.ndarray | None = None  # depth maps in any unit, ``[c,h,w]`` if they are of these cameras


@contextmanager
def number_errors(path: Path, expected: str) -> Iterator[None]:
    """In a ``with`` block, convert errors about keys and numbers to a SceneError that begins with ``expected``."""
    try:
        yield
    except (LookupError, AttributeError, TypeError, ValueError, ArithmeticError) as error:
        raise SceneError(path, f"{expected} ({error})") from error


def to_number(value: Any) -> float:
    """Convert a JSON number; raise TypeError for true, false and null, ValueError for text that is no number."""
    if isinstance(value, bool):
        raise TypeError(f"found {str(value).lower()}")
    return float(value)


def to_array(values: Any) -> np.ndarray:
    """Convert lists of numbers to float64; errors as in :func:`to_number`."""
    array = np.array(values, np.float64)
    if bool in set(map(type, np.array(values, object).flat)):
        raise TypeError("found true or false")
    return array


def convert_value(function: Callable[[Any], Any], key: str, value: Any) -> Any:
    """Convert the value of a key by ``function``. For a wrong value, raise a ValueError that begins with the key."""
    try:
        return function(value)
    except (LookupError, TypeError, ValueError, ArithmeticError) as error:
        raise ValueError(f"{key!r}: {error}") from error
