"""``camera_params.json`` of WorldMirror 1 and 2."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import C2W_OPENCV, CameraFile, make_camera_file


def read_world_mirror(path: Path, data: Mapping[str, Any]) -> CameraFile:
    """Cameras of a parsed ``camera_params.json``.

    ``extrinsics`` and ``intrinsics`` are lists of ``{camera_id, matrix}``; poses are camera-to-world with OpenCV
    axes, intrinsics in pixels of the processed size, which only the images have. ``camera_id``
    is the stem of the image's name, or the image's number, by which the cameras are then sorted.

    Raises:
        SceneError: If the two lists do not name the same cameras, or a matrix is none.
    """
    poses, Ks = (_matrices(path, data, key, side) for key, side in (("extrinsics", 4), ("intrinsics", 3)))
    if poses.keys() != Ks.keys():
        odd = sorted(poses.keys() ^ Ks.keys())[0]
        raise SceneError(path, f"expected extrinsics and intrinsics of the same cameras, found only one for {odd}")
    names = sorted(poses, key=int) if all(name.isdecimal() for name in poses) else list(poses)
    return make_camera_file(
        path, "camera_params.json", C2W_OPENCV, [poses[n] for n in names], [Ks[n] for n in names],
        [(0, 0)] * len(names), names,
    )  # fmt: skip


def _matrices(path: Path, data: Mapping[str, Any], key: str, side: int) -> dict[str, np.ndarray]:
    entries = data.get(key)
    if not isinstance(entries, list):
        raise SceneError(path, f"expected {key!r} to be a list, found something else")
    matrices = {}
    for entry in entries:
        try:
            name, matrix = str(entry["camera_id"]), np.array(entry["matrix"], np.float64)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise SceneError(path, f"{key}: expected entries of 'camera_id' and 'matrix' ({error})") from error
        if matrix.shape not in ((side, side), (3, side)):
            raise SceneError(path, f"{key} of {name}: expected {side}x{side} numbers, found shape {matrix.shape}")
        matrices[name] = matrix
    return matrices
