"""What a scene is said to cost before it is worked on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gsmerge.options import CompactOptions
from gsmerge.runtime import memory
from gsmerge.runtime.estimate import (
    MAX_SCORED_VIEWS,
    memory_bytes,
    memory_problem,
    plan_document,
    plan_lines,
    score_cost,
    work_seconds,
)
from gsmerge.runtime.memory import machine_memory, peak_memory

VIEW = 480 * 320


def seconds(views: int, **settings: Any) -> float:
    options = CompactOptions().with_settings(settings)
    plain = options.resolved(photos=True) | {"checkpoint": "none"}
    return work_seconds(views * VIEW, VIEW, plain, photos=True, fit_steps=options.fit.steps)


def test_many_views_cost_more_each_as_far_as_they_are_scored() -> None:
    """Every Gaussian of the input is rendered in every scored view."""
    assert score_cost(20) == 2 * score_cost(10)
    assert score_cost(MAX_SCORED_VIEWS) == score_cost(500)
    assert seconds(24, effort="draft") > 2 * seconds(12, effort="draft")
    assert seconds(84, fit="none") > seconds(84, fit="none", robust=False)


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


def plan(*, photos: bool = True, views: int = 12, count: int | None = None, **settings: Any) -> dict[str, Any]:
    options = CompactOptions().with_settings(settings)
    return plan_document(
        {"ply": "scene.ply", "cameras": "transforms.json", "images": None},
        (views, 100, 200),
        options.resolved(photos=photos),
        output_path=Path("small.ply"),
        per_view=800,
        photos=photos,
        threads=2,
        fit_steps=options.fit.steps,
        default_count=views * 800 * options.decode.k,
        budget=count,
    )


def test_plan_counts() -> None:
    assert plan(k=2)["output"]["num_gaussians_at_most"] == 12 * 800 * 2
    assert plan(views=1, k=8)["output"]["num_gaussians_at_most"] == 6400
    assert plan()["input"]["num_gaussians"] == 240_000
    assert plan(budget="auto")["output"]["num_gaussians_at_most"] == 12 * 800


def test_plan_says_where_adaptive_superpixels_start() -> None:
    adaptive = {"segmentation": "bass-adaptive"}
    assert any("800 per view at the start, 1" in line for line in plan_lines(plan(**adaptive)))
    assert any("800 per view, 1" in line for line in plan_lines(plan(**adaptive, superpixels=800)))
    assert any("800 per view, 1" in line for line in plan_lines(plan()))


def test_plan_of_a_budget() -> None:
    document = plan(budget="2%", count=4800)
    assert document["output"]["num_gaussians_at_most"] == 4800
    assert document["superpixels_per_view"] is None
    assert any("at most 4,800" in line for line in plan_lines(document))
    assert all(plan_lines(plan(budget="auto")))


def test_plan_says_what_will_not_run() -> None:
    def runs(**settings: Any) -> tuple[bool, str]:
        document = plan(**settings)
        return document["robust"], document["fit"]

    assert runs() == (False, "full")
    assert runs(fit="color") == (True, "color")
    assert runs(fit="color", robust=False) == (False, "color")
    assert runs(fit="none", effort="draft") == (False, "none")
    assert runs(robust=True) == (True, "full")
    assert runs(photos=False) == (False, "none")
    assert runs(photos=False, robust=True) == (False, "none")


def test_plan_of_less_work_takes_less() -> None:
    full, lean = plan()["estimate"], plan(robust=False, fit="none")["estimate"]
    assert lean["seconds"] < full["seconds"]
    assert plan(photos=False)["estimate"]["memory_bytes"] < full["memory_bytes"]
    assert all(line for line in plan_lines(plan()))
