"""``.torch`` chunks of RealEstate10K as pixelSplat and its relatives read them: scenes with their photos."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import MAX_VIEWS, check_file
from gsmerge.io.cameras.camera_file import W2C_OPENCV, CameraFile, View, make_camera_file, make_pinhole
from gsmerge.io.photo_files import decode_embedded, photo_size

if TYPE_CHECKING:
    import torch  # imported only where there is a chunk

SUFFIX = ".torch"
_COLUMNS = 18  # fx fy cx cy 0 0, then world to camera, 3x4
_MAX_PICKLE = 16 << 20  # bytes of a chunk's structure; its numbers lie elsewhere
_MAX_PHOTOS = 1 << 30  # bytes of the decoded photos


def read_re10k(path: Path, scene: str | None = None) -> CameraFile:
    """Read the cameras and photos of one scene of a chunk by its key, which a chunk of one scene need not have.

    A chunk is a list of ``{key, cameras, images}``: ``cameras [v,18]`` are fx, fy, cx, cy divided by the image's
    size, two zeros and a world-to-camera 3x4 (OpenCV axes); ``images`` are v JPEG files as tensors of bytes.
    Nothing in it is executed: only tensors and plain containers are read. SceneError if it cannot be read, has no
    scene of that key, or an array has another shape.
    """
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
    return make_camera_file(path, "re10k chunk", W2C_OPENCV, views, photos)


def _load(path: Path) -> list[Mapping[str, Any]]:
    import torch

    check_file(path)
    problem = "expected a chunk written by torch.save, found"
    if not zipfile.is_zipfile(path):
        raise SceneError(path, f"{problem} something else")
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise SceneError(path, f"{problem} packed members")
        if max((m.file_size for m in members if m.filename.endswith(".pkl")), default=0) > _MAX_PICKLE:
            raise SceneError(path, f"{problem} more than {_MAX_PICKLE >> 20} MiB of structure")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            data = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except (SceneError, MemoryError):
        raise
    except Exception as error:  # whatever a damaged archive makes the libraries raise
        raise SceneError(path, f"{problem} a damaged one, or objects, which are not read") from error
    entries = data if isinstance(data, list) else [data]
    if not entries or not all(isinstance(entry, Mapping) and "cameras" in entry for entry in entries):
        raise SceneError(path, "expected a list of scenes with 'key', 'cameras' and 'images', found something else")
    return entries


def _rows(path: Path, cameras: Any) -> np.ndarray:
    import torch

    if not isinstance(cameras, torch.Tensor) or cameras.ndim != 2 or cameras.shape[1] != _COLUMNS:
        shape = list(cameras.shape) if isinstance(cameras, torch.Tensor) else type(cameras).__name__
        raise SceneError(path, f"expected cameras [v,{_COLUMNS}], found {shape}")
    if not 0 < len(cameras) <= MAX_VIEWS:
        raise SceneError(path, f"expected 1 to {MAX_VIEWS} cameras, found {len(cameras)}")
    if not (cameras.is_floating_point() and _has_values(cameras)):
        raise SceneError(path, f"expected cameras of numbers, found {cameras.dtype}")
    return cameras.detach().double().numpy()


def _has_values(tensor: torch.Tensor) -> bool:
    """Return whether the numbers of a tensor are in memory, one after the other: others may be in a chunk."""
    import torch

    return tensor.layout == torch.strided and tensor.device.type == "cpu"


def _photos(path: Path, images: Any, names: list[str]) -> np.ndarray | None:
    """Decode the photos ``[v,h,w,3]`` uint8; None where the chunk has none."""
    import torch

    listed = isinstance(images, list | tuple)
    if images is None or (listed and not images):
        return None
    if not listed or len(images) != len(names):
        count = len(images) if listed else type(images).__name__
        raise SceneError(path, f"expected {len(names)} images, one per camera, found {count}")
    limit = path.stat().st_size
    for image in images:
        plain = isinstance(image, torch.Tensor) and image.ndim == 1 and image.dtype == torch.uint8
        if not plain or not _has_values(image) or image.numel() > limit or not image.is_contiguous():
            raise SceneError(path, "expected images as tensors [bytes] of uint8, found others")
    return decode_embedded(path, names, [image.numpy() for image in images], _MAX_PHOTOS)
