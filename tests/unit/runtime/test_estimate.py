"""What a scene is said to cost before it is worked on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gsmerge.facts.scene_size import SceneSize
from gsmerge.plan import choose_for_scene
from gsmerge.runtime import estimate, memory
from gsmerge.runtime.estimate import memory_bytes, memory_problem, wall_seconds, work_seconds
from gsmerge.runtime.memory import machine_memory, peak_memory
from gsmerge.settings.compact import CompactOptions

VIEW = 480 * 320


def seconds(views: int = 12, *, fit_steps: int = 240, num_drawn: float = 0.3 * VIEW, **settings: Any) -> float:
    options = CompactOptions().with_settings(settings)
    size = SceneSize(views * VIEW, views, 320, 480, True, rendered=False)
    plain = choose_for_scene(size, options).settings(options)
    return work_seconds(views * VIEW, VIEW, plain, fit_steps=fit_steps, num_drawn=num_drawn)


def test_more_work_takes_longer() -> None:
    none = seconds(fit="none", checkpoint="none")
    assert none < seconds(fit="none") < seconds(fit="none", checkpoint="none", method="greedy")
    assert none < seconds(fit_steps=55) < seconds() < seconds(fit_steps=1000)
    assert seconds(24, fit="none") == pytest.approx(2 * seconds(12, fit="none"))
    assert seconds(method="voxel") < seconds() < seconds(method="unmerged-fit", num_drawn=12 * VIEW)
    assert seconds(num_drawn=0) < seconds() < seconds(num_drawn=VIEW)
    assert seconds(fit="none", num_drawn=0) == seconds(fit="none", num_drawn=VIEW)


def test_a_search_counts_what_it_tries() -> None:
    plain = CompactOptions().with_settings({"checkpoint": "none"}).to_dict()

    def searched(**facts: Any) -> float:
        return work_seconds(12 * VIEW, VIEW, plain, fit_steps=240, num_drawn=VIEW / 25, **facts)

    assert searched() < searched(short_steps=60, short_drawn=[VIEW / 25] * 4)
    assert 3 * searched() > searched(tries=3) > 2 * searched() > searched(short_steps=60, short_drawn=[VIEW / 25] * 4)
    assert seconds(recipe="paper") > 2 * seconds(fit="none", checkpoint="shipped")


def test_threads_share_the_views() -> None:
    plain = CompactOptions().to_dict()
    one, two, many = (
        wall_seconds(2 * VIEW, 2, plain, fit_steps=240, num_drawn=VIEW, threads=threads) for threads in (1, 2, 16)
    )
    assert one > two == many > estimate.IMPORT_SECONDS


def test_higher_harmonics_are_counted_once() -> None:
    plain, degree4 = (memory_bytes(10**7, num_rest=num) for num in (0, 72))
    assert 4 * 72 * 10**7 <= degree4 - plain <= 5 * 72 * 10**7


def test_a_block_takes_less_memory_than_the_whole() -> None:
    block = memory_bytes(10**6, num_elsewhere=10**7)
    assert memory_bytes(10**6) < block < memory_bytes(10**7)


def test_the_papers_online_setting_fits_into_24_gb() -> None:
    assert max(memory_bytes(84 * VIEW, num_rest=num_rest) for num_rest in (0, 9, 24, 45, 72)) < 24 * 10**9


def test_what_does_not_fit_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    for available, fits in ((None, True), (30 * 10**9, True), (24 * 10**9, False)):
        monkeypatch.setattr(estimate, "machine_memory", lambda available=available: available)
        assert (memory_problem(30 * 10**9) is None) == fits
    said = memory_problem(30 * 10**9)
    assert "about 30.0 GB of memory are needed, and this machine has 24.0 GB" in said
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
