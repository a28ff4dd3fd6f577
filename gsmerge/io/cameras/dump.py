"""``views.npz``: what a user writes out of a running model that saves no cameras (``examples/04_dump_views.py``).

``c2w [v,4,4]`` (or 3x4; OpenCV axes), ``K [v,3,3]`` (pixels of the processed images, or divided by their size),
``images [v,h,w,3]`` as the network saw them (uint8, or float in [0, 1]; also ``[v,3,h,w]``), and ``order``, the
order of the rows of the ``.ply``, where it is known.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gsmerge.errors import SceneError
from gsmerge.io.alignment.layouts import ORDERS
from gsmerge.io.cameras.camera_file import C2W_OPENCV, CameraFile, make_camera_file
from gsmerge.io.cameras.da3 import as_images, check_poses
from gsmerge.io.formats.npz import array_names, read_arrays

SOURCE = "dump of a model"


def is_dump(path: Path) -> bool:
    """Whether an npz holds camera-to-world poses under the name ``c2w``; False if it cannot be read."""
    return "c2w" in array_names(path)


def read_dump(path: Path) -> CameraFile:
    """Cameras and images of a ``views.npz``.

    Raises:
        SceneError: If the file cannot be read, lacks an array, or one has another shape than it should.
    """
    arrays = read_arrays(path, ("c2w", "K", "images", "order"))
    missing = [name for name in ("c2w", "K", "images") if name not in arrays]
    if missing:
        raise SceneError(path, f"missing array{'s' * (len(missing) > 1)} {', '.join(missing)}, found {list(arrays)}")
    poses, Ks = arrays["c2w"], arrays["K"]
    check_poses(path, poses, Ks, ("c2w [v,4,4]", "K [v,3,3]"))
    images = as_images(path, arrays["images"], len(poses))
    height, width = images.shape[1:3]
    order = str(arrays["order"]) if "order" in arrays else "auto"
    if order not in ORDERS:
        raise SceneError(path, f"expected 'order' to be one of {', '.join(ORDERS)}, found {order[:40]!r}")
    names = [f"view {i}" for i in range(len(poses))]
    made = make_camera_file(path, SOURCE, C2W_OPENCV, poses, Ks, [(width, height)] * len(poses), names, images)
    return replace(made, order=order)
