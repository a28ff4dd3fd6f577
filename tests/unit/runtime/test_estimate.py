"""What a scene is said to cost before it is worked on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gsmerge.options import CompactOptions
from gsmerge.runtime import memory
from gsmerge.runtime.estimate import (
    REPORT_VIEWS,
    memory_bytes,
    memory_problem,
    score_cost,
    work_seconds,
)
from gsmerge.runtime.memory import machine_memory, peak_memory

VIEW = 480 * 320


def seconds(views: int, **settings: Any) -> float:
    options = CompactOptions().with_settings(settings)
    plain = options.resolved(photos=True) | {"checkpoint": "none"}
    return work_seconds(views * VIEW, VIEW, plain, photos=True, fit_steps=options.fit.steps)


def test_each_scored_view_costs_every_gaussian_of_the_input() -> None:
    """Every Gaussian of the input is rendered in every scored view."""
    assert score_cost(4) == 2 * score_cost(2)
    assert score_cost(REPORT_VIEWS) == score_cost(500)


def test_higher_harmonics_are_counted_once() -> None:
    plain, degree4 = (memory_bytes(10**7, photos=True, num_rest=num) for num in (0, 72))
    assert 4 * 72 * 10**7 <= degree4 - plain <= 5 * 72 * 10**7


def test_the_papers_online_setting_fits_into_24_gb() -> None:
    for num_rest in (0, 9, 24, 45, 72):
        assert memory_problem(memory_bytes(84 * VIEW, photos=True, num_rest=num_rest), 24 * 10**9) is None


def test_what_does_not_fit_is_said() -> None:
    assert memory_problem(10, None) is None
    assert memory_problem(10, 10) is None
    said = memory_problem(30 * 10**9, 24 * 10**9)
    assert said is not None
    assert "about 30.0 GB of memory are needed and this machine has 24.0 GB" in said
    assert "--effort draft" in said


def test_the_machines_memory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    there = machine_memory()
    assert there is None or 10**8 < there < 10**15
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(memory, "LIMITS", (str(tmp_path / "none"), str(limit)))
    limit.write_text("max\n")
    assert machine_memory() is None or machine_memory() > peak_memory()
    limit.write_text("123456789\n")
    assert machine_memory() == 123456789
