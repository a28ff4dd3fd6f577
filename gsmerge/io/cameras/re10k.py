"""``.torch`` chunks of RealEstate10K as pixelSplat and its relatives read them: scenes with their photos.

Files of ``torch.save`` are read without torch: plain containers and numbers, nothing is executed. Such a file is a ZIP
archive whose members are not packed: a pickle of the structure, and the bytes of every storage, of which tensors are
views (torch's ``serialization.py``, since version 1.6).
"""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.archives import open_archive
from gsmerge.io.bounds import MAX_VIEWS, ReadBudget, read_budget, read_errors
from gsmerge.io.cameras.camera_file import View, make_pinhole
from gsmerge.io.cameras.camera_format import CameraSource, StoredCameras
from gsmerge.io.photo_files import Photos, decode_embedded, photo_size
from gsmerge.io.pickles import Names, read_pickle
from gsmerge.types import StrPath

_COLUMNS = 18  # fx fy cx cy 0 0, then world to camera, 3x4
_MAX_INDEX = 1 << 48  # of a number in a storage
_MAX_AXES = 64  # of an array of NumPy's
_DTYPES = {
    "FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2", "ByteStorage": "u1", "CharStorage": "i1",
    "ShortStorage": "<i2", "IntStorage": "<i4", "LongStorage": "<i8", "BoolStorage": "?",
    "BFloat16Storage": None, "ComplexFloatStorage": None, "ComplexDoubleStorage": None,
}  # fmt: skip
_LOCAL_HEADER = struct.Struct("<4s22xHH")  # mark, and the bytes of the name and of what follows it


def read_re10k(source: CameraSource) -> StoredCameras:
    """Read the cameras and photos of one scene from a chunk; a chunk with one scene needs no key.

    A chunk is a list of ``{key, cameras, images}``: ``cameras [v,18]`` are fx, fy, cx, cy divided by the image's
    size, two zeros and a world-to-camera 3x4 (OpenCV axes); ``images`` are v JPEG files as tensors of bytes.
    SceneError if it cannot be read, has no scene of that key, or an array has another shape.
    """
    path, scene, budget = source.path, source.scene, read_budget(source.path)
    entries = _load(budget)
    named = [entry for entry in entries if isinstance(entry.get("key"), str) and entry["key"] == scene]
    if 1 not in (len(entries), len(named)):
        keys = ", ".join(key[:40] for entry in entries[:3] if isinstance(key := entry.get("key"), str))
        problem = f"expected one scene with the key {scene!r}, found {len(named)} among {len(entries)} ({keys}, ...)"
        raise SceneError(path, problem, "name the .ply as its scene is named")
    return _read_scene(budget, entries[0] if len(entries) == 1 else named[0])


def read_scenes(path: Path) -> Iterator[StoredCameras]:
    """Read the cameras and photos of all scenes of a chunk, one after the other, as :func:`read_re10k`."""
    budget = read_budget(path)
    return (_read_scene(budget, entry) for entry in _load(budget))


def _read_scene(budget: ReadBudget, entry: Mapping[str, Any]) -> StoredCameras:
    rows = _rows(budget.path, entry.get("cameras"))
    names = [f"view {i}" for i in range(len(rows))]
    photos = _photos(budget, entry.get("images"), names)
    size = photo_size(photos) or (0, 0)
    views = [
        View(name, row[6:].reshape(3, 4), make_pinhole(*row[:4]), size) for name, row in zip(names, rows, strict=True)
    ]
    return StoredCameras(views, photos)


def _load(budget: ReadBudget) -> list[Mapping[str, Any]]:
    data = read_torch_file(budget)
    entries = data if isinstance(data, list) else [data]
    if not entries or not all(isinstance(entry, Mapping) and "cameras" in entry for entry in entries):
        problem = "expected a list of scenes with 'key', 'cameras' and 'images', found something else"
        raise SceneError(budget.path, problem)
    return entries


def _rows(path: StrPath, cameras: Any) -> np.ndarray:
    if not isinstance(cameras, StoredTensor) or cameras.shape[1:] != (_COLUMNS,):
        shape = list(cameras.shape) if isinstance(cameras, StoredTensor) else type(cameras).__name__
        raise SceneError(path, f"expected cameras [v,{_COLUMNS}], found {shape}")
    if not 0 < cameras.shape[0] <= MAX_VIEWS:
        raise SceneError(path, f"expected 1 to {MAX_VIEWS} cameras, found {cameras.shape[0]}")
    if cameras.storage.dtype is None or cameras.storage.dtype.kind != "f":
        raise SceneError(path, f"expected cameras of numbers, found {cameras.storage.dtype or 'another type'}")
    with np.errstate(invalid="ignore"):  # a signalling NaN, which is refused as any other
        return cameras.read().astype(np.float64)


def _photos(budget: ReadBudget, images: Any, names: list[str]) -> Photos:
    """Decode the photos ``[v,h,w,3]`` uint8; none where the chunk has none."""
    listed = isinstance(images, list | tuple)
    if images is None or (listed and not images):
        return ()
    if not listed or len(images) != len(names):
        count = len(images) if listed else type(images).__name__
        raise SceneError(budget.path, f"expected {len(names)} images, one per camera, found {count}")
    for image in images:
        if not isinstance(image, StoredTensor) or image.storage.dtype != np.uint8 or image.strides != (1,):
            raise SceneError(budget.path, "expected images as tensors [bytes] of uint8, found others")
    return decode_embedded(budget, names, [image.read() for image in images])


class _Storage(NamedTuple):
    member: zipfile.ZipInfo  # with its bytes
    dtype: np.dtype[Any] | None  # None: of a type that is not read


@dataclass
class _TorchFile:
    """A file whose tensors are read; together they have at most as many bytes as the file."""

    budget: ReadBudget
    num_bytes: int = 0  # read so far

    def count(self, num_bytes: int) -> None:
        """Count bytes before they are read; SceneError if the file has fewer."""
        self.num_bytes += num_bytes
        if self.num_bytes > self.budget.file_bytes:
            problem = f"expected tensors of at most the file's {self.budget.file_bytes:,} bytes in all, found more"
            raise SceneError(self.budget.path, problem, "save each once")


@dataclass(frozen=True)
class StoredTensor:
    """A tensor in a file whose values are read on request."""

    file: _TorchFile
    storage: _Storage
    offset: int  # of its first number in the storage
    shape: tuple[int, ...]
    strides: tuple[int, ...]  # in numbers

    @property
    def size(self) -> int:
        """Number of values."""
        return prod(self.shape)

    def read(self) -> np.ndarray:
        """Read the values; SceneError if the file does not hold all of them."""
        path, dtype = self.file.budget.path, self.storage.dtype
        if dtype is None:
            raise SceneError(path, "expected plain numbers, found another type")
        span = min(self.size, 1)
        for stride, length in sorted(zip(self.strides, self.shape, strict=True)):
            if length > 1 and stride < span:
                problem = "expected a tensor that stores each value, found an expanded or overlapping one"
                raise SceneError(path, problem, "save a contiguous copy")
            span += (length - 1) * stride if self.size else 0
        self.file.count(dtype.itemsize * self.size)
        content = self._bytes(dtype.itemsize * self.offset, dtype.itemsize * span)
        if len(content) < dtype.itemsize * span:
            raise SceneError(path, "expected a chunk written by torch.save, found a damaged one")
        steps = [dtype.itemsize * stride for stride in self.strides]
        return np.ndarray(self.shape, dtype, content, 0, steps).copy()

    def _bytes(self, start: int, count: int) -> bytes:
        """Read bytes of the storage, fewer where the file ends before."""
        path = self.file.budget.path
        with read_errors(path), open(path, "rb") as file:
            file.seek(self.storage.member.header_offset)
            head = file.read(_LOCAL_HEADER.size)
            if len(head) < _LOCAL_HEADER.size or start + count > self.storage.member.file_size:
                return b""
            mark, name, more = _LOCAL_HEADER.unpack(head)
            file.seek(name + more + start, 1)
            return file.read(count) if mark == b"PK\3\4" else b""


def read_torch_file(budget: ReadBudget) -> Any:
    """Read the structure of a file of ``torch.save``, with a :class:`StoredTensor` for a tensor.

    SceneError if it is another file, a damaged one, holds more than plain containers and tensors, or takes more than
    its budget.
    """
    path, problem = budget.path, "expected a chunk written by torch.save, found"
    try:
        with read_errors(path), open_archive(path, (zipfile.ZIP_STORED,)) as archive:
            members = archive.infolist()
            _check_places(budget, members)
            (structure,) = (member for member in members if member.filename.split("/")[1:] == ["data.pkl"])
            content = archive.read(structure)
        folder = f"{structure.filename.removesuffix('.pkl')}/"
        storages = {member.filename.removeprefix(folder): member for member in members}
        return read_pickle(content, budget, _names(budget), lambda pid: _find_storage(storages, pid))
    except zipfile.BadZipFile as error:
        raise SceneError(path, f"{problem} something else, or a damaged one") from error
    except (ValueError, RuntimeError, ArithmeticError, EOFError, struct.error) as error:  # of zipfile and read_pickle
        problem = f"{problem} a damaged one, or objects, which are not read ({str(error)[:100]})"
        raise SceneError(path, problem) from error


def _check_places(budget: ReadBudget, members: list[zipfile.ZipInfo]) -> None:
    """Raise ValueError if a member lies outside the file, since reading allocates the size that a member declares."""
    for member in members:
        places = member.header_offset, member.file_size, member.compress_size
        if not 0 <= min(places) <= max(places) <= budget.file_bytes:
            raise ValueError("expected members in the file, found others")


def _names(budget: ReadBudget) -> Names:
    """Return the globals that a pickle of torch may name: storages, each with the type of its numbers."""
    file = _TorchFile(budget)
    return {
        ("collections", "OrderedDict"): _make_dictionary,
        ("torch._utils", "_rebuild_tensor_v2"): lambda *arguments: _make_tensor(file, arguments),
        ("torch._utils", "_rebuild_parameter"): lambda data, *_: data,
        **{("torch", name): dtype and np.dtype(dtype) for name, dtype in _DTYPES.items()},
    }


def _make_dictionary() -> dict[str, object]:
    return {}


def _find_storage(storages: Mapping[str, zipfile.ZipInfo], pid: object) -> _Storage:
    match pid:
        case ("storage", None | np.dtype() as dtype, str(key), _, _) if key in storages:
            return _Storage(storages[key], dtype)
    raise ValueError("expected a storage of the file, found none")


def _make_tensor(file: _TorchFile, arguments: object) -> StoredTensor:
    match arguments:
        case (_Storage() as storage, int(offset), tuple(shape), tuple(strides), _, _):
            numbers = (offset, *shape, *strides) if len(shape) == len(strides) <= _MAX_AXES else ()
            if set(map(type, numbers)) == {int} and 0 <= min(numbers) <= max(numbers) < _MAX_INDEX:
                return StoredTensor(file, storage, offset, shape, strides)
    raise ValueError("expected a tensor, found one of another form")
