"""``transforms.json`` of nerfstudio, instant-ngp and NeRF, and the bare list of frames."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import (
    C2W_OPENCV,
    C2W_OPENGL,
    CameraFile,
    Lens,
    fisheye,
    make_camera_file,
    perspective,
)
from gsmerge.io.photos import find_image, image_size

_PARAMS = ("k1", "k2", "k3", "k4", "p1", "p2")  # the order of "distortion_params"
_DISTORTED = {"OPENCV", "RADIAL", "SIMPLE_RADIAL"}
_PERSPECTIVE = {"PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", *_DISTORTED}
_UNDISTORT = "undistort the images first"


def read_transforms(path: Path, data: Mapping[str, Any] | list[Any]) -> CameraFile:
    """Cameras of a parsed ``transforms.json``.

    A dictionary with ``frames`` has camera-to-world poses with OpenGL axes; a bare list of frames (as one backbone
    writes) has camera-to-world poses with OpenCV axes. Intrinsics are global or per frame, in pixels or as field of
    view. ``applied_transform`` is not applied: poses are as the Gaussians' world has them.

    Raises:
        SceneError: If a pose or an intrinsic is missing, or a lens of an unknown kind.
    """
    bare = isinstance(data, list)
    common: Mapping[str, Any] = {} if isinstance(data, list) else data
    frames = data if isinstance(data, list) else data["frames"]
    if not isinstance(frames, list) or not all(isinstance(f, dict) for f in frames):
        raise SceneError(path, "expected 'frames' to be a list of objects, found something else")
    poses, Ks, sizes, names, lenses = [], [], [], [], []
    for i, frame in enumerate(frames):
        name = str(frame.get("file_path") or frame.get("image_path") or frame.get("name") or f"view {i}")
        if "transform_matrix" not in frame:
            raise SceneError(path, f"view {name}: expected 'transform_matrix', found none")
        try:
            poses.append(np.array(frame["transform_matrix"], np.float64))
            lenses.append(_lens(path, name, {**common, **frame}))
            K, size = _intrinsics(path, name, {**common, **frame})
        except (TypeError, ValueError, ArithmeticError) as error:
            raise SceneError(path, f"view {name}: expected numbers ({error})") from error
        names.append(name)
        Ks.append(K)
        sizes.append(size)
    source = "frame list" if bare else "transforms.json"
    convention = C2W_OPENCV if bare else C2W_OPENGL
    return make_camera_file(path, source, convention, poses, Ks, sizes, names, lenses=lenses)


def _intrinsics(path: Path, name: str, values: Mapping[str, Any]) -> tuple[np.ndarray, tuple[int, int]]:
    """Intrinsics [3,3] and (width, height) of one frame, its own values before the global ones."""
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


def _lens(path: Path, name: str, values: Mapping[str, Any]) -> Lens | None:
    """The lens of one frame, None for a pinhole."""
    model = str(values.get("camera_model", "PINHOLE")).upper()
    params = {key: float(values.get(key) or 0) for key in (*_PARAMS, "k5", "k6")}
    listed = [float(value) for value in values.get("distortion_params") or ()]
    if not any(params.values()):
        params |= dict(zip(_PARAMS, listed, strict=False))
    if model == "OPENCV_FISHEYE" or values.get("is_fisheye"):
        return fisheye("OPENCV_FISHEYE", [params[key] for key in ("k1", "k2", "k3", "k4")])
    odd = next((key for key in ("k4", "k5", "k6") if params[key]), None)
    if model not in _PERSPECTIVE or odd is not None:
        what = (
            f"camera model {model}" if odd is None else f"lens distortion {odd}, which formats understand differently"
        )
        raise SceneError(
            path, f"view {name}: expected a pinhole, OPENCV or OPENCV_FISHEYE camera, found {what}", _UNDISTORT
        )
    return perspective(
        model if model in _DISTORTED else "OPENCV", [params[key] for key in ("k1", "k2", "p1", "p2", "k3")]
    )
