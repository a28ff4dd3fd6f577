"""``.torch`` chunks of RealEstate10K as pixelSplat and its relatives read them: scenes with their photos.

Files of ``torch.save`` are read without torch: plain containers and numbers, nothing is executed. Such a file is a ZIP
archive whose members are not packed: a pickle of the structure, and the bytes of every storage, of which tensors are
views (torch's ``serialization.py``, since version 1.6).
"""

from __future__ import annotations

import pickle
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import MAX_VIEWS, check_file
from gsmerge.io.cameras.camera_file import View, make_pinhole
from gsmerge.io.cameras.camera_format import CameraSource, StoredCameras
from gsmerge.io.photo_files import decode_embedded, photo_size

SUFFIX = ".torch"
_COLUMNS = 18  # fx fy cx cy 0 0, then world to camera, 3x4
_MAX_PHOTOS = 1 << 30  # bytes of the decoded photos
MAX_PICKLE = 16 << 20  # bytes of a file's structure; its numbers lie elsewhere
MAX_INDEX = 1 << 48  # of a number in a storage
_DTYPES = {
    "FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2", "ByteStorage": "u1", "CharStorage": "i1",
    "ShortStorage": "<i2", "IntStorage": "<i4", "LongStorage": "<i8", "BoolStorage": "?",
}  # fmt: skip
_LOCAL_HEADER = struct.Struct("<4s22xHH")  # mark, and the bytes of the name and of what follows it


def read_re10k(source: CameraSource) -> StoredCameras:
    """Read the cameras and photos of one scene from a chunk; a chunk with one scene needs no key.

    A chunk is a list of ``{key, cameras, images}``: ``cameras [v,18]`` are fx, fy, cx, cy divided by the image's
    size, two zeros and a world-to-camera 3x4 (OpenCV axes); ``images`` are v JPEG files as tensors of bytes.
    SceneError if it cannot be read, has no scene of that key, or an array has another shape.
    """
    path, scene = source.path, source.scene
    entries = _load(path)
    named = [entry for entry in entries if isinstance(entry.get("key"), str) and entry["key"] == scene]
    if 1 not in (len(entries), len(named)):
        keys = ", ".join(str(entry.get("key"))[:40] for entry in entries[:3])
        problem = f"expected one scene with the key {scene!r}, found {len(named)} among {len(entries)} ({keys}, ...)"
        raise SceneError(path, problem, "name the .ply as its scene is named")
    entry = entries[0] if len(entries) == 1 else named[0]
    rows = _rows(path, entry.get("cameras"))
    names = [f"view {i}" for i in range(len(rows))]
    photos = _photos(path, entry.get("images"), names)
    size = photo_size(photos) or (0, 0)
    views = [
        View(name, row[6:].reshape(3, 4), make_pinhole(*row[:4]), size) for name, row in zip(names, rows, strict=True)
    ]
    return StoredCameras(views, photos)


def _load(path: Path) -> list[Mapping[str, Any]]:
    check_file(path)
    data = read_torch_file(path)
    entries = data if isinstance(data, list) else [data]
    if not entries or not all(isinstance(entry, Mapping) and "cameras" in entry for entry in entries):
        raise SceneError(path, "expected a list of scenes with 'key', 'cameras' and 'images', found something else")
    return entries


def _rows(path: Path, cameras: Any) -> np.ndarray:
    if not isinstance(cameras, StoredTensor) or cameras.shape[1:] != (_COLUMNS,):
        shape = list(cameras.shape) if isinstance(cameras, StoredTensor) else type(cameras).__name__
        raise SceneError(path, f"expected cameras [v,{_COLUMNS}], found {shape}")
    if not 0 < cameras.shape[0] <= MAX_VIEWS:
        raise SceneError(path, f"expected 1 to {MAX_VIEWS} cameras, found {cameras.shape[0]}")
    if cameras.dtype is None or cameras.dtype.kind != "f":
        raise SceneError(path, f"expected cameras of numbers, found {cameras.dtype or 'another type'}")
    with np.errstate(invalid="ignore"):  # a signalling NaN, which is refused as any other
        return cameras.read().astype(np.float64)


def _photos(path: Path, images: Any, names: list[str]) -> np.ndarray | None:
    """Decode the photos ``[v,h,w,3]`` uint8; None where the chunk has none."""
    listed = isinstance(images, list | tuple)
    if images is None or (listed and not images):
        return None
    if not listed or len(images) != len(names):
        count = len(images) if listed else type(images).__name__
        raise SceneError(path, f"expected {len(names)} images, one per camera, found {count}")
    limit = path.stat().st_size
    for image in images:
        plain = isinstance(image, StoredTensor) and image.dtype == np.uint8
        if not plain or image.strides != (1,) or image.size > limit:
            raise SceneError(path, "expected images as tensors [bytes] of uint8, found others")
    return decode_embedded(path, names, [image.read() for image in images], _MAX_PHOTOS)


@dataclass(frozen=True)
class StoredTensor:
    """A tensor in a file whose values are read on request."""

    path: Path
    member: zipfile.ZipInfo  # with the bytes of its storage
    dtype: np.dtype[Any] | None  # None: of a type that is not read
    offset: int  # of its first number in the storage
    shape: tuple[int, ...]
    strides: tuple[int, ...]  # in numbers

    @property
    def size(self) -> int:
        """Number of values."""
        return prod(self.shape)

    def read(self) -> np.ndarray:
        """Read the values; SceneError if the file does not hold them."""
        if self.dtype is None:
            raise SceneError(self.path, "expected plain numbers, found another type")
        lengths = zip(self.shape, self.strides, strict=True)
        span = 1 + sum((n - 1) * stride for n, stride in lengths) if self.size else 0
        width = self.dtype.itemsize
        content = self._bytes(width * self.offset, width * span)
        if len(content) < width * span:
            raise SceneError(self.path, "expected a chunk written by torch.save, found a damaged one")
        steps = [width * stride for stride in self.strides]
        return np.ndarray(self.shape, self.dtype, content, 0, steps).copy()

    def _bytes(self, start: int, count: int) -> bytes:
        """Read bytes of the storage, fewer where the file ends before."""
        with self.path.open("rb") as file:
            file.seek(self.member.header_offset)
            head = file.read(_LOCAL_HEADER.size)
            if len(head) < _LOCAL_HEADER.size or start + count > self.member.file_size:
                return b""
            mark, name, more = _LOCAL_HEADER.unpack(head)
            file.seek(name + more + start, 1)
            return file.read(count) if mark == b"PK\3\4" else b""


def read_torch_file(path: Path) -> Any:
    """Read the structure of a file of ``torch.save``, with a :class:`StoredTensor` for a tensor.

    SceneError if it is another file, a damaged one, or holds more than plain containers and
    tensors.
    """
    problem = "expected a chunk written by torch.save, found"
    if not zipfile.is_zipfile(path):
        raise SceneError(path, f"{problem} something else")
    try:
        with zipfile.ZipFile(path) as archive:
            members = {member.filename: member for member in archive.infolist()}
            if any(member.compress_type != zipfile.ZIP_STORED for member in members.values()):
                raise SceneError(path, f"{problem} packed members")
            (name,) = (name for name in members if name.split("/")[1:] == ["data.pkl"])
            if members[name].file_size > MAX_PICKLE:
                raise SceneError(path, f"{problem} more than {MAX_PICKLE >> 20} MiB of structure")
            content = archive.read(name)
        folder = name.removesuffix("data.pkl")
        return _Structure(path, folder, members, content).load()
    except (SceneError, MemoryError):
        raise
    except Exception as error:  # whatever a damaged archive makes the libraries raise
        problem = f"{problem} a damaged one, or objects, which are not read"
        raise SceneError(path, problem) from error


class _Structure(pickle._Unpickler):
    """An unpickler that knows tensors and ordered dictionaries alone.

    It is the one written in Python: that in C takes as much memory as a file asks for. Nor does a
    file set the fields of what was made.
    """

    dispatch: ClassVar[dict[int, Callable[[pickle.Unpickler], None]]] = {
        code: step for code, step in pickle._Unpickler.dispatch.items() if code != pickle.BUILD[0]
    }

    def __init__(self, path: Path, folder: str, members: dict[str, zipfile.ZipInfo], content: bytes) -> None:
        super().__init__(BytesIO(content))
        self._path, self._folder, self._members = path, folder, members

    def find_class(self, module: str, name: str) -> Any:
        """Return what stands for a name: of a storage the type of its numbers."""
        objects = {
            ("collections", "OrderedDict"): OrderedDict,
            ("torch._utils", "_rebuild_tensor_v2"): self._make_tensor,
            ("torch._utils", "_rebuild_parameter"): lambda tensor, *_: tensor,
        }
        if module == "torch" and name.endswith("Storage"):
            return np.dtype(_DTYPES[name]) if name in _DTYPES else None
        if (module, name) not in objects:
            raise pickle.UnpicklingError(f"refused to load {module}.{name}")
        return objects[module, name]

    def persistent_load(self, pid: Any) -> Any:
        """Find the numbers of a storage."""
        _, dtype, key, *_ = pid
        return self._members[f"{self._folder}data/{key}"], dtype

    def _make_tensor(self, storage: Any, offset: int, shape: Any, strides: Any, *_: object) -> Any:
        member, dtype = storage
        numbers = (offset, *shape, *strides)
        if not all(type(number) is int and 0 <= number < MAX_INDEX for number in numbers):
            raise pickle.UnpicklingError("a tensor of an impossible shape")
        if len(shape) != len(strides) or not isinstance(member, zipfile.ZipInfo):
            raise pickle.UnpicklingError("a tensor of another form")
        return StoredTensor(self._path, member, dtype, offset, tuple(shape), tuple(strides))
