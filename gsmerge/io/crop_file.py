"""Read a crop from a small JSON or TOML file: a sphere, or a box that may be rotated."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry import rotmat_to_euler
from gsmerge.io.bounds import read_table
from gsmerge.settings.stages import parse_crop

# Sets of keys that place a shape; without ``matrix``, a box may also have the key ``rotate``
FORMS = {"box": ({"min", "max"}, {"center", "size"}, {"matrix"}), "sphere": ({"center", "radius"}, {"matrix"})}
MAX_NUMBER = 1e15  # squares and products of smaller numbers are far from overflow
SHEAR = 1e-3  # largest cosine of the angle between two axes of a matrix that count as perpendicular


def read_crop(path: Path) -> str:
    """Read a crop from a file, and return it as text for :func:`gsmerge.settings.stages.parse_crop`.

    SceneError if the file cannot be read or holds no valid crop.
    """
    table = read_table(path)
    try:
        shape = table.get("shape")
        if shape not in tuple(FORMS):  # not in the dictionary itself, since a list has no hash
            raise ValueError(f"shape: expected {' or '.join(FORMS)}, found {shape!r:.40}")
        numbers = _list_box(table) if shape == "box" else _list_sphere(table)
        text = f"{shape}:{','.join(repr(float(number)) for number in numbers)}"
        parse_crop(text)
    except ValueError as error:
        raise SceneError(path, str(error)) from error
    return text


def _list_box(table: Mapping[str, Any]) -> list[float]:
    """List the two corners of a box, and the angles (degrees) by which it is rotated about its centre."""
    keys = _check_keys(table)
    if "matrix" in keys:
        middle, halves, rotation = _parse_matrix(table)
        return [*(middle - halves), *(middle + halves), *rotmat_to_euler(rotation)]
    rotate = _parse_numbers(table, "rotate") if "rotate" in table else np.zeros(3)
    if "min" in keys:
        return [*_parse_numbers(table, "min"), *_parse_numbers(table, "max"), *rotate]
    middle, halves = _parse_numbers(table, "center"), _parse_numbers(table, "size") / 2
    return [*(middle - halves), *(middle + halves), *rotate]


def _list_sphere(table: Mapping[str, Any]) -> list[float]:
    """List the centre of a sphere and its radius."""
    if "matrix" not in _check_keys(table):
        return [*_parse_numbers(table, "center"), *_parse_numbers({"radius": [table["radius"]]}, "radius", (1,))]
    middle, radii, _ = _parse_matrix(table)
    if radii.max() > (1 + SHEAR) * radii.min():
        raise ValueError(f"matrix: expected a sphere with one scale along all axes, found {radii.round(4).tolist()}")
    return [*middle, radii.max()]


def _check_keys(table: Mapping[str, Any]) -> set[str]:
    """Return the keys that place a shape, without ``rotate``; ValueError if they are none of the sets of ``FORMS``."""
    keys, forms = table.keys() - {"shape"}, FORMS[table["shape"]]
    optional = {"rotate"} if table["shape"] == "box" and "matrix" not in keys else set[str]()
    if keys - optional not in forms:
        expected = " or ".join(" and ".join(sorted(form)) for form in forms)
        raise ValueError(f"{table['shape']}: expected {expected}, found {', '.join(sorted(keys)) or 'neither'}")
    return keys - optional


def _parse_matrix(table: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Decompose the matrix that maps a cube from -1 to 1, or a sphere of radius 1: centre, scales ``[3]``, rotation."""
    matrix = _parse_numbers(table, "matrix", (4, 4))
    axes = matrix[:3, :3]
    scales = np.sqrt(np.square(axes).sum(0))
    if (matrix[3] != (0, 0, 0, 1)).any() or not (scales > 0).all():
        problem = "expected a 4 x 4 matrix, row by row, of a translation, rotation and scale, with the last row 0 0 0 1"
        raise ValueError(f"matrix: {problem}")
    rotation = axes / scales
    cosine = max(abs(float((rotation[:, i] * rotation[:, j]).sum())) for i, j in ((0, 1), (0, 2), (1, 2)))
    if cosine > SHEAR:
        raise ValueError(f"matrix: expected axes at right angles, found a cosine of {cosine:.3g} between two of them")
    # Mirroring does not change a cube, so the matrix becomes a rotation
    rotation[:, 2] *= np.sign((np.cross(rotation[:, 0], rotation[:, 1]) * rotation[:, 2]).sum())
    return matrix[:3, 3], scales, rotation


def _parse_numbers(table: Mapping[str, Any], name: str, shape: tuple[int, ...] = (3,)) -> np.ndarray:
    """Return an entry as numbers of the given shape; ValueError for any other content."""
    expected = f"{name}: expected {' x '.join(map(str, shape))} number(s) from -{MAX_NUMBER:g} to {MAX_NUMBER:g}"
    try:
        numbers = np.array(table[name])
    except ValueError as error:  # lists of different lengths
        raise ValueError(f"{expected}, found lists of different lengths") from error
    if numbers.shape != shape or numbers.dtype.kind not in "iuf" or not (abs(numbers) < MAX_NUMBER).all():
        raise ValueError(f"{expected}, found {table[name]!r:.60}")
    return numbers.astype(np.float64)
