"""Rows by the native conversion are the same rows as column by column, bit for bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scenes
from plyfile import PlyData, PlyElement

from gsmerge.io.formats import read_gaussians
from gsmerge.io.formats import rows as arrays
from gsmerge.method.kernels.stored_rows import convert_rows

N = 200
ODD = {
    "x": (np.nan, np.inf, -np.inf, 2e13, 9e12), "f_dc_1": (np.nan, 2e6), "f_rest_4": (-2e6, np.inf),
    "scale_2": (31, -31, np.inf, -np.inf, np.nan), "rot_3": (1e20, np.nan, np.inf),
    "opacity": (np.inf, -np.inf, np.nan),
}  # fmt: skip


def make_rows(num_higher: int) -> np.ndarray:
    """Make rows of plain Gaussians with two columns beside what is used, all columns in a mixed order."""
    rng = np.random.default_rng(0)
    names = [*arrays.REQUIRED_COLUMNS, *arrays.NORMALS[:2], *(f"f_rest_{i}" for i in range(3 * num_higher))]
    rows = np.empty(N, [(name, "<f4") for name in rng.permutation(names)])
    for name in names:
        rows[name] = rng.normal(0, 3, N)
    return rows


@pytest.fixture
def native(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return how many rows each call of the kernel has converted."""
    counts = list[int]()

    def counted(*arguments: np.ndarray) -> int:
        counts.append(convert_rows(*arguments))
        return counts[-1]

    monkeypatch.setattr(read_gaussians, "convert_rows", counted)
    return counts


def assert_same(folder: Path, rows: np.ndarray) -> None:
    """Read a file as it is, and with a column of doubles that nothing uses: all columns are then taken one by one."""
    wide = np.zeros(N, [*rows.dtype.descr, ("label", "<f8")])
    for name in rows.dtype.names or ():
        wide[name] = rows[name]
    files = []
    for name, each in (("a.ply", rows), ("b.ply", wide)):
        PlyData([PlyElement.describe(each, "vertex")], byte_order="<").write(str(folder / name))
        files.append(read_gaussians.read_ply(folder / name))
    native, by_columns = files
    assert scenes.identical(native.gaussians, by_columns.gaussians)
    assert native.valid.tobytes() == by_columns.valid.tobytes()
    for name in ("num_nonfinite", "num_empty", "num_zero_quats", "adapted", "opacity_encoding"):
        assert getattr(native.info, name) == getattr(by_columns.info, name), name


@pytest.mark.parametrize("num_higher", [0, 3, 15])
def test_plain_rows_are_converted_at_once(num_higher: int, native: list[int], tmp_path: Path) -> None:
    assert_same(tmp_path, make_rows(num_higher))
    assert native == [N]


@pytest.mark.parametrize("row", [0, 63, 64, N - 1])
@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in ODD.items() for value in values])
def test_rows_from_an_odd_one_on_are_taken_by_columns(
    name: str, value: float, row: int, native: list[int], tmp_path: Path
) -> None:
    rows = make_rows(3)
    rows[name][row] = value
    assert_same(tmp_path, rows)
    assert (native == [N]) == (value == 9e12)


@pytest.mark.parametrize("size", [0, 1e-20, 1e-16, 1e-14])
def test_rows_of_zero_or_tiny_rotations_are_taken_by_columns(size: float, native: list[int], tmp_path: Path) -> None:
    rows = make_rows(0)
    for name in arrays.QUATS:
        rows[name][70] *= np.float32(size)
    assert_same(tmp_path, rows)
    assert native == [64 if size < 1e-14 else N]


@pytest.mark.parametrize(("name", "kind"), [("x", "<f8"), ("f_dc_0", "<f8"), ("opacity", "<f8")])
def test_other_types_are_taken_by_columns(name: str, kind: str, native: list[int], tmp_path: Path) -> None:
    rows = make_rows(0)
    assert_same(tmp_path, rows.astype([(each, kind if each == name else "<f4") for each in rows.dtype.names or ()]))
    assert native == []
