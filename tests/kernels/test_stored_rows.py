"""Rows by the native conversion are the same rows as column by column, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest

from gsmerge.io.formats import rows as arrays
from gsmerge.io.formats.read_gaussians import _convert_with_kernel, _convert_with_numpy

N = 200
ODD = {
    "x": (np.nan, np.inf, -np.inf, 2e13, 9e12), "f_dc_1": (np.nan, 2e6), "f_rest_4": (-2e6, np.inf),
    "scale_2": (31, -31, np.inf, -np.inf, np.nan), "rot_3": (1e20, np.nan, np.inf),
    "opacity": (np.inf, -np.inf, np.nan),
}  # fmt: skip


def make_rows(num_higher: int, seed: int = 0) -> np.ndarray:
    """Make rows of plain Gaussians with two columns beside what is used, all columns in a mixed order."""
    rng = np.random.default_rng(seed)
    names = [*arrays.REQUIRED_COLUMNS, *arrays.NORMALS[:2], *(f"f_rest_{i}" for i in range(3 * num_higher))]
    rows = np.empty(N, [(name, "<f4") for name in rng.permutation(names)])
    for name in names:
        rows[name] = rng.normal(0, 3, N)
    return rows


def empty_arrays(num_higher: int, means: str = "f4") -> dict[str, np.ndarray]:
    shapes = {"quats": (N, 4), "scales": (N, 3), "opacities": (N,), "sh0": (N, 1, 3), "shN": (N, num_higher, 3)}
    out = {name: np.full(shape, 7, np.float32) for name, shape in shapes.items()}
    return out | {"means": np.full((N, 3), 7, means), "valid": np.zeros(N, np.bool_)}


def assert_same(rows: np.ndarray, num_higher: int, means: str = "f4") -> None:
    fast, slow = empty_arrays(num_higher, means), empty_arrays(num_higher, means)
    num_done = _convert_with_kernel(rows, fast)
    counts = _convert_with_numpy(rows[num_done:], {name: array[num_done:] for name, array in fast.items()})
    assert counts == _convert_with_numpy(rows, slow)
    for name, values in slow.items():
        assert fast[name].tobytes() == values.tobytes(), name


@pytest.mark.parametrize("num_higher", [0, 3, 15])
def test_plain_rows_are_converted_at_once(num_higher: int) -> None:
    rows = make_rows(num_higher)
    assert _convert_with_kernel(rows, empty_arrays(num_higher)) == N
    assert_same(rows, num_higher)


@pytest.mark.parametrize("row", [0, 63, 64, N - 1])
@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in ODD.items() for value in values])
def test_rows_from_an_odd_one_on_are_taken_by_columns(name: str, value: float, row: int) -> None:
    rows = make_rows(3)
    rows[name][row] = value
    assert (_convert_with_kernel(rows, empty_arrays(3)) == N) == (value == 9e12)
    assert_same(rows, 3)


@pytest.mark.parametrize("size", [0, 1e-20, 1e-16, 1e-14])
def test_rows_of_zero_or_tiny_rotations_are_taken_by_columns(size: float) -> None:
    rows = make_rows(0)
    for name in arrays.QUATS:
        rows[name][70] *= np.float32(size)
    assert _convert_with_kernel(rows, empty_arrays(0)) == (64 if size < 1e-14 else N)
    assert_same(rows, 0)


@pytest.mark.parametrize("kinds", [{"x": "<f8"}, {"f_dc_0": "<i2"}, {"opacity": ">f4"}])
def test_other_types_are_taken_by_columns(kinds: dict[str, str]) -> None:
    rows = make_rows(0)
    other = rows.astype([(name, kinds.get(name, "<f4")) for name in rows.dtype.names or ()])
    assert _convert_with_kernel(other, empty_arrays(0)) == 0
    assert_same(other, 0, "f8" if "x" in kinds else "f4")
