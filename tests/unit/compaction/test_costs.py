"""What a run is said to take before it begins."""

from __future__ import annotations

from typing import Any

import numpy as np
from made_gaussians import random_gaussians

from gsmerge import CompactOptions
from gsmerge.compaction.costs import IMPORT_SECONDS, RunCosts, expected_parts
from gsmerge.compaction.estimate import estimate
from gsmerge.facts.counts import count_limits
from gsmerge.facts.scene_size import SceneSize
from gsmerge.types import Cameras, Scene

VIEW = 480 * 320
ALONE = Scene(random_gaussians(20_000, 0), Cameras(np.zeros((0, 4, 4)), np.zeros((0, 3, 3)), 1, 1), None, None, ())
USUAL: dict[str, Any] = {
    "has_target": False, "has_curve": False, "max_drop": None, "rendered": False, "levels": 1, "has_trial": False,
}  # fmt: skip


def seconds(views: int = 12, *, steps: int = 240, count: int = 50_000, threads: int = 1, **changes: Any) -> float:
    """Wall time of a run, with settings of ``compact`` and with arguments of ``expected_parts``."""
    parts = {name: changes.pop(name) for name in tuple(changes) if name in USUAL}
    options = CompactOptions().with_settings({"checkpoint": "none"} | changes)
    size = SceneSize(views * VIEW, views, 320, 480, True, rendered=False)
    costs = RunCosts(options.to_dict(), views * VIEW, VIEW, 0.5, steps)
    expected = expected_parts(
        costs, count_limits(size, options.segment, options.decode, options.budget), count, **USUAL | parts
    )
    return costs.seconds(expected, views, threads)


def test_more_work_takes_longer() -> None:
    usual = seconds()
    assert IMPORT_SECONDS < seconds(steps=0) < seconds(steps=0, method="greedy")
    assert seconds(steps=0, method="random") < usual < seconds(recipe="paper", checkpoint="paper")
    assert usual < min(seconds(24), seconds(steps=1000), seconds(count=10**6))
    assert seconds(steps=0, count=1) == seconds(steps=0, count=10**6)
    for changes in ({"has_curve": True}, {"has_target": True}, {"levels": 3}, {"has_trial": True}):
        assert usual < seconds(**changes) < 4 * usual
    assert seconds(2) > seconds(2, threads=2) == seconds(2, threads=16)


def test_a_file_alone_is_fitted_except_by_a_draft() -> None:
    draft, asked, best = (
        estimate(ALONE, CompactOptions().with_settings({"budget": "10%", "effort": effort}))
        for effort in ("draft", "default", "best")
    )
    assert (draft["fit"], asked["fit"], best["fit"]) == ("none", "full", "full")
    assert asked["seconds"] < best["seconds"]
