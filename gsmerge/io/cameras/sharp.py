"""The camera that SHARP writes into its ``.ply``: elements ``extrinsic``, ``intrinsic`` and ``image_size``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plyfile import PlyListProperty

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import W2C_OPENCV, CameraFile, View, make_camera_file, make_pinhole
from gsmerge.io.formats.ply import READERS
from gsmerge.io.formats.ply_file import open_ply

SOURCE = "SHARP"
_ELEMENTS = ("extrinsic", "intrinsic", "image_size")
LAYERS = 2  # Gaussians per cell: a front and a back layer


def read_sharp(path: Path) -> CameraFile | None:
    """The camera inside a ``.ply``, at the size of its grid; None where there is none.

    The grid is square whatever the photo's shape: the photo was stretched to it. SceneError if the numbers are damaged.
    """
    if path.suffix.lower() in READERS:
        return None
    data = open_ply(path)
    if "vertex" not in data or not all(name in data for name in _ELEMENTS):
        return None
    for element in (data[name] for name in _ELEMENTS):
        if element.count > 16 or len(element.properties) != 1 or isinstance(element.properties[0], PlyListProperty):
            return None
    extrinsic, intrinsic, size = (np.asarray([row[0] for row in data[name].data], np.float64) for name in _ELEMENTS)
    side = round((data["vertex"].count / LAYERS) ** 0.5)
    if LAYERS * side * side != data["vertex"].count or len(size) != 2 or not (size > 0).all():
        return None
    if len(extrinsic) not in (12, 16) or len(intrinsic) not in (4, 9):
        raise SceneError(path, f"expected 16 and 9 numbers of a camera, found {len(extrinsic)} and {len(intrinsic)}")
    K = make_pinhole(*intrinsic) if len(intrinsic) == 4 else intrinsic.reshape(3, 3)
    K = K * np.array([[side / size[0]], [side / size[1]], [1.0]])
    view = View(path.stem, extrinsic.reshape(-1, 4), K, (side, side))
    return make_camera_file(path, SOURCE, W2C_OPENCV, [view])
