"""Classes that declare how a file stores its views, by the keys of their poses, intrinsics, sizes and lenses.

An entry in the table of camera formats may have a :class:`ViewLayout`, by which ``read_views.py`` reads files of the
format.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from gsmerge.geometry.transforms import motion_matrices
from gsmerge.io.cameras.camera_file import StoredView
from gsmerge.io.cameras.camera_source import CameraSource, convert_value, to_array

Key = str | tuple[str, ...]  # a key, or several names of a key; the first name with a value is read


class Entry(NamedTuple):
    """One view as a file stores it, before it is converted."""

    values: Mapping[str, Any]  # values of this view alone
    shared: Mapping[str, Any] = {}  # values that several views share, read where ``values`` have none
    name: str = ""  # name of its image, if no value has it
    path: Path | None = None  # the view's own file, if each view has a file


@dataclass(frozen=True)
class Matrix:
    """A matrix under one key.

    Args:
        key: The key.
        shape: Shape of the matrix, if files may list all its numbers in one flat list. None if files have a list for
            each row.
    """

    key: str
    shape: tuple[int, int] | None = None

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys that a view must have."""
        return (self.key,)

    def read(self, values: Mapping[str, Any]) -> np.ndarray:
        """Read the matrix; errors as in :func:`convert_value`."""
        shape = self.shape
        return np.asarray(
            convert_value(
                lambda value: to_array(value) if shape is None else to_array(value).reshape(shape),
                self.key,
                values[self.key],
            )
        )


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
            :func:`gsmerge.geometry.transforms.quat_to_rotmat`.
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
