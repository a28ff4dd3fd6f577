"""``transforms.json`` of nerfstudio, instant-ngp and NeRF, and the bare list of frames."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import C2W_OPENCV, C2W_OPENGL, CameraFile, make_camera_file
from gsmerge.io.images import find_image, image_size

_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_PINHOLE = {"PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "PERSPECTIVE", "RADIAL", "SIMPLE_RADIAL"}


def read_transforms(path: Path, data: Mapping[str, Any] | list[Any]) -> CameraFile:
    """Cameras of a parsed ``transforms.json``.

    A dictionary with ``frames`` has camera-to-world poses with OpenGL axes; a bare list of frames (as one backbone
    writes) has camera-to-world poses with OpenCV axes. Intrinsics are global or per frame, in pixels or as field of
    view. ``applied_transform`` is not applied: poses are as the Gaussians' world has them.

    Raises:
        SceneError: If a pose or an intrinsic is missing, or a lens is distorted.
    """
    bare = isinstance(data, list)
    common: Mapping[str, Any] = {} if isinstance(data, list) else data
    frames = data if isinstance(data, list) else data["frames"]
    if not isinstance(frames, list) or not all(isinstance(f, dict) for f in frames):
        raise SceneError(path, "expected 'frames' to be a list of objects, found something else")
    poses, Ks, sizes, names = [], [], [], []
    for i, frame in enumerate(frames):
        name = str(frame.get("file_path") or frame.get("image_path") or frame.get("name") or f"view {i}")
        if "transform_matrix" not in frame:
            raise SceneError(path, f"view {name}: expected 'transform_matrix', found none")
        try:
            poses.append(np.array(frame["transform_matrix"], np.float64))
            K, size = _intrinsics(path, name, {**common, **frame})
        except (TypeError, ValueError, ArithmeticError) as error:
            raise SceneError(path, f"view {name}: expected numbers ({error})") from error
        names.append(name)
        Ks.append(K)
        sizes.append(size)
    source = "frame list" if bare else "transforms.json"
    return make_camera_file(path, source, C2W_OPENCV if bare else C2W_OPENGL, poses, Ks, sizes, names)


def _intrinsics(path: Path, name: str, values: Mapping[str, Any]) -> tuple[np.ndarray, tuple[int, int]]:
    """Intrinsics [3,3] and (width, height) of one frame, its own values before the global ones."""
    _refuse_distortion(path, name, values)
    width, height = float(values.get("w") or 0), float(values.get("h") or 0)
    has_focal = any(key in values for key in ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y"))
    if has_focal and not (width and height) and not {"fl_x", "cx", "cy"} <= values.keys():
        image = find_image(path.parent, name)
        if image is None:
            raise SceneError(path, f"view {name}: expected 'w' and 'h', found neither them nor the image itself")
        width, height = image_size(image)
    missing = [key for key in ("fl_x", "w", "h") if key not in values]
    if not has_focal:
        raise SceneError(
            path,
            f"expected intrinsics (fl_x, fl_y, cx, cy, w, h), found none of {', '.join(missing)} for view {name}",
            "add them in pixels, for all frames or for each",
        )
    fx = _focal(values, "x", width) or _focal(values, "y", height)
    fy = _focal(values, "y", height) or fx
    cx = float(values["cx"]) if "cx" in values else width / 2
    cy = float(values["cy"]) if "cy" in values else height / 2
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), (round(width), round(height))


def _focal(values: Mapping[str, Any], axis: str, size: float) -> float:
    """Focal length along an axis in pixels, 0 where the file has none."""
    if f"fl_{axis}" in values:
        return float(values[f"fl_{axis}"])
    if f"camera_angle_{axis}" in values:
        return 0.5 * size / math.tan(0.5 * float(values[f"camera_angle_{axis}"]))
    return 0.0


def _refuse_distortion(path: Path, name: str, values: Mapping[str, Any]) -> None:
    model = str(values.get("camera_model", "PINHOLE")).upper()
    coefficients = [float(values.get(key) or 0) for key in _DISTORTION]
    coefficients += [float(value) for value in values.get("distortion_params") or ()]
    if model not in _PINHOLE or values.get("is_fisheye") or any(coefficients):
        what = f"camera model {model}" if model not in _PINHOLE else "lens distortion"
        raise SceneError(path, f"view {name}: expected a pinhole camera, found {what}", "undistort the images first")
