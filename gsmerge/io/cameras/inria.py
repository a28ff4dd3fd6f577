"""``cameras.json`` of an INRIA model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import C2W_OPENCV, CameraFile, make_camera_file

_KEYS = ("position", "rotation", "fx", "fy", "width", "height")


def read_inria(path: Path, entries: list[dict[str, Any]]) -> CameraFile:
    """Cameras of a parsed ``cameras.json``: camera-to-world rotation rows and centre, principal point in the middle.

    Raises:
        SceneError: If a key is missing or not a number.
    """
    poses, Ks, sizes, names = [], [], [], []
    for i, entry in enumerate(entries):
        name = str(entry.get("img_name", f"view {i}"))
        missing = [key for key in _KEYS if key not in entry]
        if missing:
            raise SceneError(path, f"view {name}: missing {', '.join(missing)}")
        try:
            rotation = np.array(entry["rotation"], np.float64).reshape(3, 3)
            centre = np.array(entry["position"], np.float64).reshape(3, 1)
            fx, fy, width, height = (float(entry[key]) for key in ("fx", "fy", "width", "height"))
            sizes.append((round(width), round(height)))
        except (TypeError, ValueError, ArithmeticError) as error:
            raise SceneError(path, f"view {name}: expected numbers ({error})") from error
        poses.append(np.concatenate([rotation, centre], 1))
        Ks.append(np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]]))
        names.append(name)
    return make_camera_file(path, "INRIA cameras.json", C2W_OPENCV, poses, Ks, sizes, names)
