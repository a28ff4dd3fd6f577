"""Declare how a file stores its views, by the keys of their poses, intrinsics, sizes and lenses, and read them.

An entry in the table of camera formats may have a :class:`ViewLayout`, by which :func:`read_views` reads files of the
format.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass, field
from gsmerge.io.cameras.camera_file import Lens, StoredView, check_camera_count, make_lens, make_pinhole
from gsmerge.io.cameras.camera_source import (
    CameraSource,
    StoredCameras,
    check_objects,
    convert_value,
    number_errors,
    to_array,
    to_number,
)
from gsmerge.io.image_names import find_image
from gsmerge.io.photo_files import Size, image_size
from gsmerge.method.geometry.transforms import motion_matrices
from gsmerge.method.kernels.elementary import cos, sin

_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")  # the order of nerfstudio's "distortion_params"
_COEFFICIENTS = (*_DISTORTION, "k5", "k6")
# Camera models with distortion, and then all models that are read. Both sets lack OPENCV_FISHEYE
_DISTORTED = {"OPENCV", "RADIAL", "SIMPLE_RADIAL"}
_PINHOLE_OR_OPENCV = {"PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", *_DISTORTED}
_FOCAL = ("fx", "fy", "angle_x", "angle_y")  # values from which a focal length follows

Key = str | tuple[str, ...]  # a key, or several names of a key; the first name with a value is read


class Entry(NamedTuple):
    """One view as a file stores it, before it is converted."""

    values: Mapping[str, Any]  # values of this view alone
    shared: Mapping[str, Any] = {}  # values that several views share, read where ``values`` have none
    name: str = ""  # name of its image, if no value has it
    path: Path | None = None  # the view's own file, if each view has a file


@dataclass(frozen=True)
class Matrix:
    """A matrix under one key, as a list for each row or as one flat list, row by row."""

    key: str

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys that a view must have."""
        return (self.key,)

    def read(self, values: Mapping[str, Any]) -> np.ndarray:
        """Read the matrix; errors as in :func:`convert_value`."""
        return np.asarray(convert_value(_to_matrix, self.key, values[self.key]))


def _to_matrix(value: Any) -> np.ndarray:
    """Convert lists of numbers to a matrix; nine numbers of a flat list are 3x3, others rows of four."""
    numbers = to_array(value)
    return numbers.reshape(-1, 3 if numbers.size == 9 else 4) if numbers.ndim == 1 else numbers


def rotation_of_matrix(numbers: np.ndarray) -> np.ndarray:
    """Return the rotation ``[3,3]`` whose nine numbers a file lists row by row."""
    return numbers.reshape(3, 3)


def rotation_of_vector(numbers: np.ndarray) -> np.ndarray:
    """Return the rotation ``[3,3]`` about a vector ``[3]`` by an angle in radians that is the vector's length."""
    motion = np.concatenate([numbers.reshape(1, 3), np.zeros((1, 3))], 1)
    return motion_matrices(motion)[0, :3, :3]


@dataclass(frozen=True, eq=False)
class RotationAndShift:
    """A pose ``[3,4]`` under two keys: one for its rotation, one for its last column.

    Args:
        rotation: Key of the rotation.
        shift: Key of the last column, which is the camera's centre if poses are camera-to-world.
        to_matrix: Function that makes the rotation ``[3,3]`` from the numbers under ``rotation``:
            :func:`rotation_of_matrix`, :func:`rotation_of_vector`, or for quaternions wxyz
            :func:`gsmerge.method.geometry.transforms.quat_to_rotmat`.
    """

    rotation: str
    shift: str
    to_matrix: Callable[[np.ndarray], np.ndarray] = rotation_of_matrix

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys that a view must have."""
        return self.rotation, self.shift

    def read(self, values: Mapping[str, Any]) -> np.ndarray:
        """Read the pose; errors as in :func:`convert_value`."""
        rotation = convert_value(lambda value: self.to_matrix(to_array(value)), self.rotation, values[self.rotation])
        shift = convert_value(lambda value: to_array(value).reshape(3, 1), self.shift, values[self.shift])
        return np.concatenate([rotation, shift], 1)


@dataclass(frozen=True)
class PinholeKeys:
    """Intrinsics with a key for each number. If a view lacks the value of an optional key, the default is taken.

    Args:
        fx: Key of the horizontal focal length, which by default equals the vertical focal length.
        fy: Key of the vertical focal length, which by default equals the horizontal focal length.
        cx: Key of the principal point's x, by default the middle of the image.
        cy: Key of the principal point's y, by default the middle of the image.
        angle_x: Key of the horizontal field of view in radians, for views without ``fx``; "" if there is none.
        angle_y: Key of the vertical field of view in radians, for views without ``fy``; "" if there is none.
    """

    fx: Key
    fy: Key
    cx: Key
    cy: Key
    angle_x: Key = ""
    angle_y: Key = ""


@dataclass(frozen=True)
class ViewLayout:
    """Where a file lists its views, and the keys under which each view has its values.

    A value of null counts as missing. If a view lacks a value other than its name and pose, the value is taken from the
    object that has the list of views.

    Args:
        pose: The pose, in the convention of the format.
        K: The intrinsics: a key for each number, or a matrix ``[3,3]``.
        views: Key of the list of views, "" if the whole file is the list, or a function that lists the views.
        name: Key of the image's name. Views without a name are called "view 0", "view 1" and so on.
        size: Keys of width and height in pixels, or the key of a list [height, width]; "" if the file has no size.
        unit: Unit of the intrinsics: a pixel, the image's width and height, or the image's larger side. If the unit is
            "pixels" but all intrinsics are small, they are taken as shares of width and height, see
            :func:`make_camera_file`.
        origin: Point from which the principal point is measured: the upper left corner or the middle of the image.
        lens: Key of the camera model, "" if all views are pinholes. The keys of the coefficients are k1, k2 and so on.
        models: The program's name of a camera model -> COLMAP's name, if the two names differ.
        optional: Keys that a view may lack. A size that is missing is read from the view's image. If no view of the
            file has a focal length, focal lengths are estimated later.
        mask: Key of the name of the image's mask; "" if there is none.
        finish: Function that completes the views from other content of the file or folder; None if none is needed.
    """

    pose: Matrix | RotationAndShift
    K: PinholeKeys | Matrix
    views: str | Callable[[CameraSource], Sequence[Entry]] = ""
    name: Key = ()
    size: tuple[str, str] | str = ""
    unit: Literal["pixels", "size", "larger side"] = "pixels"
    origin: Literal["corner", "middle"] = "corner"
    lens: str = ""
    models: Mapping[str, str] = field(default_factory=dict)
    optional: Sequence[Key] = ()
    mask: str = ""
    finish: Callable[[CameraSource, list[StoredView]], list[StoredView]] | None = None

    @property
    def number_keys(self) -> dict[str, Key]:
        """Keys of single numbers, by the fields of :class:`PinholeKeys`, and by "w" and "h" for width and height."""
        keys: dict[str, Key] = dict(vars(self.K)) if isinstance(self.K, PinholeKeys) else {}
        keys |= dict(zip(("w", "h"), self.size, strict=True)) if isinstance(self.size, tuple) else {}
        return {name: key for name, key in keys.items() if key}


def read_views(source: CameraSource, layout: ViewLayout) -> StoredCameras:
    """Read the cameras of a file by its layout. If a value is missing or wrong, SceneError names file, view and key."""
    if callable(layout.views):
        entries = layout.views(source)
    else:  # the key of a list in a JSON object; with the key "", the whole file is the list
        stored = source.object.get(layout.views) if layout.views else source.json
        place = repr(layout.views) if layout.views else "the file"
        if not isinstance(stored, list):
            raise SceneError(source.path, f"expected {place} to be a list of objects, found something else")
        check_objects(source.path, stored, place)
        check_camera_count(source.path, len(stored))
        entries = [Entry(view, source.object) for view in stored]
    # Keys of intrinsics, size and lens that must have a value in each view, or in the object that views share
    required_keys = [key for name, key in layout.number_keys.items() if not name.startswith("angle")]
    required_keys += [layout.K.key] if isinstance(layout.K, Matrix) else []
    required_keys += [key for key in (layout.size, layout.lens) if isinstance(key, str) and key]
    required_keys = [key for key in required_keys if key not in layout.optional]
    shared: dict[int, dict[str, Any]] = {}  # id of an object that views share -> its values, converted only once
    cameras: list[tuple[Path, str, np.ndarray, dict[str, Any]]] = []
    for i, entry in enumerate(entries):
        names = (entry.values[key] for key in _alternatives(layout.name) if entry.values.get(key) not in (None, ""))
        path = entry.path or source.path
        name = entry.name or str(next(names, f"view {i}"))
        missing: list[Key] = [key for key in layout.pose.keys if entry.values.get(key) is None]
        for key in required_keys:
            if _find_value(entry.values, key) is None and _find_value(entry.shared, key) is None:
                missing.append(key)
        if missing:
            words = ", ".join(" or ".join(map(repr, _alternatives(key))) for key in missing)
            raise SceneError(path, f"view {name}: expected {words}, found none")
        if id(entry.shared) not in shared:
            with number_errors(path, "expected numbers"):
                shared[id(entry.shared)] = _camera_values(layout, entry.shared)
        with number_errors(path, f"view {name}: expected numbers"):
            values = shared[id(entry.shared)] | _camera_values(layout, entry.values)
            cameras.append((path, name, layout.pose.read(entry.values), values))
    has_intrinsics = any(key in values for *_, values in cameras for key in ("K", *_FOCAL))
    size_of = cache(image_size)  # many views may name the same photo
    # engines write matrices column by column, in which every pose ends in 0, 0, 0, 1 downward
    have_no_shift = all(pose.shape == (4, 4) and not pose[:3, 3].any() for _, _, pose, _ in cameras)
    by_columns = have_no_shift and any(pose[3, :3].any() for _, _, pose, _ in cameras)
    views = []
    for path, name, stored, values in cameras:
        pose = stored.T if by_columns else stored
        with number_errors(path, f"view {name}: expected numbers"):
            lens = _lens(path, name, values) if layout.lens else None
            K = None
            if has_intrinsics:
                K, values = _intrinsics(path, name, layout, values, size_of)
            size = round(values.get("w", 0)), round(values.get("h", 0))
            views.append(StoredView(name, pose=pose, K=K, size=size, lens=lens, mask=values.get("mask", "")))
    return StoredCameras(views if layout.finish is None else layout.finish(source, views))


def _alternatives(key: Key) -> tuple[str, ...]:
    """Return all names of a :data:`Key`, the most preferred first."""
    return (key,) if isinstance(key, str) else key


def _find_value(values: Mapping[str, Any], key: Key) -> Any:
    """Return the value of a key under the first of the key's names that has a value; None if no name has a value."""
    return next((values[name] for name in _alternatives(key) if values.get(name) is not None), None)


def _camera_values(layout: ViewLayout, values: Mapping[str, Any]) -> dict[str, Any]:
    """Convert the intrinsics, size and lens in ``values``, which are those of one view, or are shared by all views.

    The result has the names of ``number_keys``, "K" for a matrix, and "mask". For a lens it also has "model",
    "is_fisheye", "distortion_params" and the coefficients. Names without a value in the file are left out. Errors are
    those of :func:`convert_value`.
    """
    keys = layout.number_keys | ({name: name for name in _COEFFICIENTS} if layout.lens else {})
    camera: dict[str, Any] = {}
    for name, key in keys.items():
        value = _find_value(values, key)
        if value is not None:
            camera[name] = convert_value(to_number, " or ".join(_alternatives(key)), value)
    if isinstance(layout.size, str) and values.get(layout.size) is not None:
        camera["h"], camera["w"] = convert_value(_two_numbers, layout.size, values[layout.size])
    if isinstance(layout.K, Matrix) and values.get(layout.K.key) is not None:
        camera["K"] = layout.K.read(values)
    if values.get(layout.mask):
        camera["mask"] = str(values[layout.mask])
    if not layout.lens:
        return camera
    if values.get(layout.lens) is not None:
        model = values[layout.lens]
        max_model = 40  # most letters of a camera model's name
        camera["model"] = str(layout.models.get(model, model)).upper()[:max_model]
    if values.get("is_fisheye") is not None:
        camera["is_fisheye"] = values["is_fisheye"]
    if values.get("distortion_params") is not None:
        numbers = values["distortion_params"][: len(_DISTORTION)]
        camera["distortion_params"] = [convert_value(to_number, "distortion_params", number) for number in numbers]
    return camera


def _two_numbers(values: Any) -> tuple[float, float]:
    """Convert a list of two JSON numbers; raise ValueError for another count."""
    if len(values) != 2:
        raise ValueError(f"expected two numbers, found {len(values)}")
    return to_number(values[0]), to_number(values[1])


def _intrinsics(
    path: Path, name: str, layout: ViewLayout, values: dict[str, Any], size_of: Callable[[Path], Size]
) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the intrinsics ``[3,3]`` of a view, converted to pixels from the unit and origin of the layout.

    If the intrinsics need a size and the file has no size, the image's size is read by ``size_of``. Also return the
    values of the view with this size. Raise SceneError if the intrinsics or the image are missing.
    """
    if isinstance(layout.K, Matrix):
        K = values["K"]
        if K.shape != (3, 3):
            problem = f"expected 3x3 numbers in {layout.K.key!r}, found shape {K.shape}"
            raise SceneError(path, f"view {name}: {problem}")
        sides = [[round(values.get("w", 0.0))], [round(values.get("h", 0.0))], [1]]
        return (K * np.array(sides) if layout.unit == "size" else K), values
    keys = layout.number_keys
    if not any(key in values for key in _FOCAL):
        missing = ", ".join(str(keys[field]) for field in ("fx", "w", "h") if field not in values)
        expected = ", ".join(str(keys[field]) for field in ("fx", "fy", "cx", "cy", "w", "h"))
        problem = f"view {name}: expected intrinsics ({expected}), found none of {missing}"
        raise SceneError(path, problem, "add them in pixels, for all views or for each")
    has_size = values.get("w") and values.get("h")
    if not has_size and not {"fx", "cx", "cy"} <= values.keys() and keys.get("w") in layout.optional:
        w = repr(keys["w"])
        h = repr(keys["h"])
        image = find_image(path.parent, name, path, remedy=f"add {w} and {h} to the camera file")
        if image is None:
            raise SceneError(path, f"view {name}: expected {w} and {h}, found neither them nor the image itself")
        values = values | dict(zip(("w", "h"), size_of(image), strict=True))
    width = values.get("w", 0.0)
    height = values.get("h", 0.0)
    unit = max(width, height) if layout.unit == "larger side" else 1.0  # pixels
    fx = _focal(values, "x", width)
    fy = _focal(values, "y", height)
    fx = fx or fy if layout.K.fx in layout.optional else fx
    fy = fy or fx if layout.K.fy in layout.optional else fy
    if layout.origin == "middle":
        cx, cy = (side / 2 + unit * values.get(key, 0.0) for key, side in (("cx", width), ("cy", height)))
    else:
        cx = values.get("cx", width / 2)
        cy = values.get("cy", height / 2)
    return make_pinhole(unit * fx, unit * fy, cx, cy), values


def _focal(values: Mapping[str, float], axis: str, side: float) -> float:
    """Return the focal length along an axis, or compute it from the angle of view; 0 if the file has no such values.

    ``side``: pixels of the image along the axis.
    """
    if f"f{axis}" in values:
        return values[f"f{axis}"]
    if f"angle_{axis}" in values:
        half = 0.5 * values[f"angle_{axis}"]
        if half >= math.pi / 2:
            raise ValueError(f"an angle of view of {2 * half:g} radians, half a turn or more; is it in degrees?")
        with np.errstate(all="ignore"):  # an angle of 0 gives an infinite focal length, which is refused later
            return float(0.5 * side * cos(half) / sin(half))
    return 0.0


_PANORAMAS = ("equirect", "spher", "panoram")  # parts of the names of 360-degree models
_CUT_PANORAMAS = "cut pinhole pictures out of the 360-degree panoramas first, as nerfstudio's ns-process-data does"


def _lens(path: Path, name: str, values: Mapping[str, Any]) -> Lens | None:
    """Return the lens of a view; None for a pinhole, and SceneError for a camera model that is not supported."""
    model = values.get("model", "PINHOLE")
    params = {key: values.get(key, 0.0) for key in _COEFFICIENTS}
    if not any(params.values()):
        params |= dict(zip(_DISTORTION, values.get("distortion_params", ()), strict=False))
    if model == "OPENCV_FISHEYE" or values.get("is_fisheye"):
        return make_lens("OPENCV_FISHEYE", "fisheye", [params[key] for key in ("k1", "k2", "k3", "k4")])
    ambiguous = next((key for key in ("k4", "k5", "k6") if params[key]), None)
    if model not in _PINHOLE_OR_OPENCV or ambiguous is not None:
        distortion = f"lens distortion {ambiguous}, which formats understand differently"
        found = f"camera model {model}" if ambiguous is None else distortion
        problem = f"view {name}: expected a pinhole, OPENCV or OPENCV_FISHEYE camera, found {found}"
        is_panorama = any(part in model.lower() for part in _PANORAMAS)
        raise SceneError(path, problem, _CUT_PANORAMAS if is_panorama else "undistort the images first")
    coefficients = [params[key] for key in ("k1", "k2", "p1", "p2", "k3")]
    return make_lens(model if model in _DISTORTED else "OPENCV", "perspective", coefficients)
