"""Arrays in files keep their values when pages leave memory, and a run knows what it needs and has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsmerge.runtime import memory


def test_values_stay_when_pages_are_freed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "MAPPED_BYTES", 1)
    array = memory.make_array((300, 5), np.float32)
    array[:] = np.arange(1500).reshape(300, 5)
    memory.free_pages([array, array[10:20, 2]])
    np.testing.assert_array_equal(array, np.arange(1500).reshape(300, 5))


def test_freed_pages_of_private_copies_keep_their_values(tmp_path: Path) -> None:
    np.zeros(4096, np.float32).tofile(tmp_path / "rows")
    array = np.memmap(tmp_path / "rows", np.float32, mode="c")
    array[:] = 1
    memory.free_pages([array])
    assert (array == 1).all()


def test_rows_gathered_in_parts_are_those_of_indexing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "MAPPED_BYTES", 64)
    array = memory.make_array((5, 4, 3), np.float32)
    array[:] = np.arange(60).reshape(5, 4, 3)
    rng = np.random.default_rng(0)
    rows, columns = rng.integers(0, 5, 30), rng.integers(0, 4, 30)
    np.testing.assert_array_equal(memory.gather(array, rows), array[rows])
    np.testing.assert_array_equal(memory.gather(array, rows, columns), array[rows, columns])
    assert memory.gather(array, rows[:0]).shape == (0, 4, 3)


def test_block_takes_less_memory_than_the_whole() -> None:
    assert memory.memory_bytes(10**6) < memory.memory_bytes(10**6, num_elsewhere=10**7) < memory.memory_bytes(10**7)


def test_harmonics_count_once_in_the_memory_that_is_needed() -> None:
    plain, degree4 = (memory.memory_bytes(10**7, num_rest=num) for num in (0, 72))
    assert 4 * 72 * 10**7 <= degree4 - plain <= 5 * 72 * 10**7


def test_too_little_memory_is_named_with_what_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    for available, fits in ((None, True), (30 * 10**9, True), (24 * 10**9, False)):
        monkeypatch.setattr(memory, "machine_memory", lambda available=available: available)
        assert (memory.memory_problem(30 * 10**9) is None) == fits
    said = memory.memory_problem(30 * 10**9)
    assert "about 30.0 GB of memory are needed, and this machine has 24.0 GB" in said


def test_the_machines_memory_is_that_of_its_control_group(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(memory, "LIMITS", (str(tmp_path / "none"), str(limit)))
    limit.write_text("max\n")
    whole = memory.machine_memory()
    assert whole is None or whole > memory.peak_memory()
    limit.write_text("123456789\n")
    assert memory.machine_memory() == 123456789
