"""Read the camera that SHARP writes into the elements of its ``.ply``."""

from __future__ import annotations

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import StoredView, make_pinhole
from gsmerge.io.cameras.camera_source import CameraSource, StoredCameras
from gsmerge.io.formats.table import PLY, find_format

SHARP = "SHARP"  # ``source`` of this camera
_SHARP_ELEMENTS = ("extrinsic", "intrinsic", "image_size")  # SHARP's first versions do not write image_size


def read_sharp(source: CameraSource) -> StoredCameras | None:
    """Read the camera that SHARP writes into a ``.ply``; None if the ``.ply`` has no such camera.

    The width and height of the view are those of SHARP's grid of Gaussians. The grid is square, because SHARP stretches
    photos of any shape to a square. Raise SceneError if the numbers of the camera are damaged.
    """
    if find_format(source.path).read is not PLY.read:
        return None
    elements = source.ply
    present = [name for name in _SHARP_ELEMENTS if name in elements]
    if "vertex" not in elements or not {"extrinsic", "intrinsic"}.issubset(present):
        return None
    for element in (elements[name] for name in present):
        if element.count > 16 or len(element.columns) != 1 or element.has_lists:
            return None
    with np.errstate(all="ignore"):  # the check of all cameras refuses NaN
        numbers = {name: np.asarray([row[0] for row in elements[name].rows[:]], np.float64) for name in present}
    extrinsic, intrinsic, size = numbers["extrinsic"], numbers["intrinsic"], numbers.get("image_size", np.zeros(0))
    if len(intrinsic) == 4 and "image_size" not in numbers:  # first versions write focal lengths and size
        focal_lengths, size = intrinsic[:2], intrinsic[2:]
        intrinsic = make_pinhole(*focal_lengths, *(size / 2)).reshape(-1)
    sharp_layers = 2  # Gaussians in each cell of the grid, of a front and a back layer
    side = round((elements["vertex"].count / sharp_layers) ** 0.5)
    if sharp_layers * side * side != elements["vertex"].count or len(size) != 2 or not (size > 0).all():
        return None
    if len(extrinsic) not in (12, 16) or len(intrinsic) != 9:
        problem = f"expected 16 and 9 numbers of a camera, found {len(extrinsic)} and {len(intrinsic)}"
        raise SceneError(source.path, problem)
    pose, K = extrinsic.reshape(-1, 4).copy(), intrinsic.reshape(3, 3)
    if len(extrinsic) == 12:  # first versions write the rotation column by column
        pose[:, :3] = pose[:, :3].T.copy()
    K = K * np.array([[side / size[0]], [side / size[1]], [1.0]])
    return StoredCameras([StoredView(source.path.stem, pose, K, (side, side))])
