"""``.torch`` chunks of RealEstate10K as pixelSplat and its relatives read them: scenes with their photos.

torch's loader for weights reads them. It makes only containers, numbers and tensors, and executes no code.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError, refuse_without_torch
from gsmerge.io.bounds import MAX_VIEWS, read_budget
from gsmerge.io.cameras.camera_file import StoredView, make_pinhole
from gsmerge.io.cameras.camera_source import CameraSource, StoredCameras
from gsmerge.io.photo_files import PhotoArrays, decode_embedded, photo_size

with refuse_without_torch():
    import torch

_COLUMNS = 18  # fx fy cx cy 0 0, then world to camera, 3x4


def read_re10k(source: CameraSource) -> StoredCameras:
    """Read the cameras and photos of the scene with the key ``source.scene``; a chunk with one scene needs no key.

    A chunk is a list of ``{key, cameras, images}``: ``cameras [v,18]`` are fx, fy, cx, cy divided by the image's
    size, two zeros and a world-to-camera 3x4 (OpenCV axes); ``images`` are v JPEG files as tensors of bytes.
    SceneError if the chunk cannot be read, has no scene of that key, or an array has another shape.
    """
    path, scene = source.path, source.scene
    entries = _load(path)
    named = [entry for entry in entries if isinstance(entry.get("key"), str) and entry["key"] == scene]
    if 1 not in (len(entries), len(named)):
        keys = ", ".join(key[:40] for entry in entries[:3] if isinstance(key := entry.get("key"), str))
        problem = f"expected one scene with the key {scene!r}, found {len(named)} among {len(entries)} ({keys}, ...)"
        raise SceneError(path, problem, "name the .ply as its scene is named")
    entry = entries[0] if len(entries) == 1 else named[0]
    rows = _rows(path, entry["cameras"])
    names = [f"view {i}" for i in range(len(rows))]
    photos = _photos(path, entry.get("images"), names)
    size = photo_size(photos) or (0, 0)
    views = [
        StoredView(name, row[6:].reshape(3, 4), make_pinhole(*row[:4]), size)
        for name, row in zip(names, rows, strict=True)
    ]
    return StoredCameras(views, photos)


def _load(path: Path) -> list[Mapping[str, Any]]:
    try:
        data = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever damage makes torch raise
        reason = " ".join(str(error).split())[:100]
        problem = (
            f"expected a chunk written by torch.save, found a damaged one, or objects, which are not read ({reason})"
        )
        raise SceneError(path, problem) from error
    entries = data if isinstance(data, list) else [data]
    if not entries or not all(isinstance(entry, Mapping) and "cameras" in entry for entry in entries):
        raise SceneError(path, "expected a list of scenes with 'key', 'cameras' and 'images', found something else")
    return entries


def _rows(path: Path, cameras: Any) -> np.ndarray:
    if not isinstance(cameras, torch.Tensor) or cameras.shape[1:] != (_COLUMNS,) or not cameras.is_floating_point():
        found = f"{list(cameras.shape)} of {cameras.dtype}" if isinstance(cameras, torch.Tensor) else "something else"
        raise SceneError(path, f"expected cameras [v,{_COLUMNS}] of floating-point numbers, found {found}")
    if not 0 < len(cameras) <= MAX_VIEWS:
        raise SceneError(path, f"expected 1 to {MAX_VIEWS} cameras, found {len(cameras)}")
    return cameras.detach().double().numpy()


def _photos(path: Path, images: Any, names: list[str]) -> PhotoArrays:
    """Decode the photos ``[v,h,w,3]`` uint8; empty if the chunk has none."""
    listed = isinstance(images, list | tuple)
    if images is None or (listed and not images):
        return ()
    if not listed or len(images) != len(names):
        count = len(images) if listed else type(images).__name__
        raise SceneError(path, f"expected {len(names)} images, one per camera, found {count}")
    if not all(isinstance(image, torch.Tensor) and (image.ndim, image.dtype) == (1, torch.uint8) for image in images):
        raise SceneError(path, "expected images as tensors [bytes] of uint8, found another type or shape")
    return decode_embedded(read_budget(path), names, [image.numpy() for image in images])
