"""Arrays of an ``.npz``: never objects, and never more than the archive can hold."""

from __future__ import annotations

import math
import warnings
import zipfile
from collections.abc import Collection
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import check_file

_FREE_BYTES = 64 << 20  # an array of that size is read however well it is compressed
_MAX_RATIO = 100  # of unpacked to packed bytes; photos and depth maps reach 20
_KINDS = "biufU"


def array_names(path: Path) -> frozenset[str]:
    """Names of the arrays in an ``.npz``; none if it cannot be read."""
    try:
        if not path.is_file() or not zipfile.is_zipfile(path):
            return frozenset()
        with zipfile.ZipFile(path) as archive:
            return frozenset(_members(archive))
    except Exception:  # whatever a damaged archive makes the library raise
        return frozenset()


def read_arrays(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Those of the named arrays that an ``.npz`` has, in its order. SceneError if it cannot be read, an array holds
    anything but numbers and text, or one is larger than its bytes in the archive allow.
    """
    check_file(path)
    if not zipfile.is_zipfile(path):
        raise SceneError(path, "expected a readable .npz file, found something else")
    try:
        with zipfile.ZipFile(path) as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of headers in old styles
            members = _members(archive)
            return {name: _read(path, archive, info) for name, info in members.items() if name in names}
    except SceneError:
        raise
    except Exception as error:  # whatever a damaged archive makes the libraries raise
        raise SceneError(path, f"expected a readable .npz file, found a damaged one ({error})") from error


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    return {info.filename[:-4]: info for info in archive.infolist() if info.filename.endswith(".npy")}


def _read(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    name = info.filename
    if info.file_size > max(_FREE_BYTES, _MAX_RATIO * info.compress_size):
        raise SceneError(path, f"{name}: found {info.file_size >> 20} MiB in {info.compress_size} packed bytes")
    with archive.open(info) as file:
        first = np.lib.format.read_magic(file) == (1, 0)
        read_header = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(file)
    if dtype.kind not in _KINDS:
        kind = "objects, which are not read because they could run code" if dtype.hasobject else str(dtype)[:40]
        raise SceneError(path, f"{name}: expected numbers, found {kind}")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize > info.file_size:
        raise SceneError(path, f"{name}: expected as many bytes as shape {list(shape)} needs, found fewer")
    with archive.open(info) as file:
        return np.asarray(np.lib.format.read_array(file, allow_pickle=False))
