"""Arrays in files: their pages leave memory, their values stay."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsmerge.runtime import memory


def test_values_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "MAPPED_BYTES", 1)
    array = memory.make_array((300, 5), np.float32)
    array[:] = np.arange(1500).reshape(300, 5)
    memory.free_pages([array, array[10:20, 2]])
    np.testing.assert_array_equal(array, np.arange(1500).reshape(300, 5))


def test_private_pages_of_others_stay(tmp_path: Path) -> None:
    np.zeros(4096, np.float32).tofile(tmp_path / "rows")
    array = np.memmap(tmp_path / "rows", np.float32, mode="c")
    array[:] = 1
    memory.free_pages([array])
    assert (array == 1).all()


def test_rows_are_gathered_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "MAPPED_BYTES", 64)
    array = memory.make_array((5, 4, 3), np.float32)
    array[:] = np.arange(60).reshape(5, 4, 3)
    rng = np.random.default_rng(0)
    rows, columns = rng.integers(0, 5, 30), rng.integers(0, 4, 30)
    np.testing.assert_array_equal(memory.gather(array, rows), array[rows])
    np.testing.assert_array_equal(memory.gather(array, rows, columns), array[rows, columns])
    assert memory.gather(array, rows[:0]).shape == (0, 4, 3)
