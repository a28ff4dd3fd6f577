"""Cameras in nerfstudio's ``transforms.json``, and in lists of its frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import Lens, StoredView, check_count, make_lens, make_pinhole
from gsmerge.io.cameras.camera_format import CameraSource, StoredCameras, number_errors, to_array, to_number
from gsmerge.io.image_names import find_image
from gsmerge.io.photo_files import Size, image_size
from gsmerge.kernels.elementary import cos, sin

_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")  # the order of "distortion_params"
_COEFFICIENTS = (*_DISTORTION, "k5", "k6")
_DISTORTED = {"OPENCV", "RADIAL", "SIMPLE_RADIAL"}
_PERSPECTIVE = {"PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", *_DISTORTED}
_FOCAL_KEYS = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
_NUMBER_KEYS = (*_FOCAL_KEYS, "w", "h", "cx", "cy", *_COEFFICIENTS)
_MAX_MODEL = 40  # letters of a camera model's name


def read_transforms(source: CameraSource) -> StoredCameras:
    """Read the cameras of a ``transforms.json`` or a bare list of frames; SceneError if a value is missing.

    Intrinsics are global or per frame, in pixels or as field of view; no frame need have any. ``applied_transform``
    is not applied: poses are in the Gaussians' world.
    """
    return StoredCameras(transforms_views(source.path, source.json))


def transforms_views(path: Path, data: Any) -> list[StoredView]:
    """Read the views of a parsed ``transforms.json``; see :func:`read_transforms`."""
    frames = data["frames"] if isinstance(data, dict) else data
    if not isinstance(frames, list) or not all(isinstance(f, dict) for f in frames):
        raise SceneError(path, "expected 'frames' to be a list of objects, found something else")
    check_count(path, len(frames))
    with number_errors(path, "expected numbers"):
        common = _camera_values(data) if isinstance(data, dict) else {}
    entries: list[tuple[str, np.ndarray, dict[str, Any]]] = []
    for i, frame in enumerate(frames):
        name = str(frame.get("file_path") or frame.get("image_path") or frame.get("name") or f"view {i}")
        if "transform_matrix" not in frame:
            raise SceneError(path, f"view {name}: expected 'transform_matrix', found none")
        with number_errors(path, f"view {name}: expected numbers"):
            entries.append((name, to_array(frame["transform_matrix"]), {**common, **_camera_values(frame)}))
    bare = not any(key in values for _, _, values in entries for key in _FOCAL_KEYS)
    views, size_of = [], cache(image_size)  # of photos that many frames may name
    for name, pose, values in entries:
        with number_errors(path, f"view {name}: expected numbers"):
            lens = _lens(path, name, values)
            size = round(values.get("w", 0)), round(values.get("h", 0))
            K, size = (None, size) if bare else _intrinsics(path, name, values, size_of)
            views.append(StoredView(name, pose, K, size, lens))
    return views


def _camera_values(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a camera's intrinsics in a file, or in one of its frames; null counts as missing."""
    values: dict[str, Any] = {key: to_number(entry[key]) for key in _NUMBER_KEYS if entry.get(key) is not None}
    values |= {key: entry[key] for key in ("camera_model", "is_fisheye") if entry.get(key) is not None}
    if "camera_model" in values:
        values["camera_model"] = str(values["camera_model"]).upper()[:_MAX_MODEL]
    if entry.get("distortion_params") is not None:
        values["distortion_params"] = [to_number(value) for value in entry["distortion_params"][: len(_DISTORTION)]]
    return values


def _intrinsics(
    path: Path, name: str, values: Mapping[str, Any], size_of: Callable[[Path], Size]
) -> tuple[np.ndarray, Size]:
    """Return intrinsics ``[3,3]`` and (width, height) of a frame, from its own values or those of all frames."""
    if not any(key in values for key in _FOCAL_KEYS):
        missing = ", ".join(key for key in ("fl_x", "w", "h") if key not in values)
        problem = f"expected intrinsics (fl_x, fl_y, cx, cy, w, h), found none of {missing} for view {name}"
        raise SceneError(path, problem, "add them in pixels, for all frames or for each")
    width, height = values.get("w", 0.0), values.get("h", 0.0)
    if not (width and height) and not {"fl_x", "cx", "cy"} <= values.keys():
        image = find_image(path.parent, name, "add 'w' and 'h' to the camera file")
        if image is None:
            raise SceneError(path, f"view {name}: expected 'w' and 'h', found neither them nor the image itself")
        width, height = size_of(image)
    fx = _focal(values, "x", width) or _focal(values, "y", height)
    fy = _focal(values, "y", height) or fx
    K = make_pinhole(fx, fy, values.get("cx", width / 2), values.get("cy", height / 2))
    return K, (round(width), round(height))


def _focal(values: Mapping[str, float], axis: str, size: float) -> float:
    """Return the focal length along an axis in pixels, 0 where the file has none."""
    if f"fl_{axis}" in values:
        return values[f"fl_{axis}"]
    if f"camera_angle_{axis}" in values:
        half = 0.5 * values[f"camera_angle_{axis}"]
        with np.errstate(all="ignore"):  # of an angle of 0: a focal length that is not finite is refused
            return float(0.5 * size * cos(half) / sin(half))
    return 0.0


def _lens(path: Path, name: str, values: Mapping[str, Any]) -> Lens | None:
    """Return the lens of a frame, None for a pinhole."""
    model = values.get("camera_model", "PINHOLE")
    params = {key: values.get(key, 0.0) for key in _COEFFICIENTS}
    if not any(params.values()):
        params |= dict(zip(_DISTORTION, values.get("distortion_params", ()), strict=False))
    if model == "OPENCV_FISHEYE" or values.get("is_fisheye"):
        return make_lens("OPENCV_FISHEYE", "fisheye", [params[key] for key in ("k1", "k2", "k3", "k4")])
    odd = next((key for key in ("k4", "k5", "k6") if params[key]), None)
    if model not in _PERSPECTIVE or odd is not None:
        odd_lens = f"lens distortion {odd}, which formats understand differently"
        what = odd_lens if odd is not None else f"camera model {model}"
        problem = f"view {name}: expected a pinhole, OPENCV or OPENCV_FISHEYE camera, found {what}"
        raise SceneError(path, problem, "undistort the images first")
    coefficients = [params[key] for key in ("k1", "k2", "p1", "p2", "k3")]
    return make_lens(model if model in _DISTORTED else "OPENCV", "perspective", coefficients)
