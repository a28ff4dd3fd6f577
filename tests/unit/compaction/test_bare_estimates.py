"""What a file without cameras is said to take."""

from __future__ import annotations

import numpy as np
from made_gaussians import random_gaussians

from gsmerge import CompactOptions
from gsmerge.compaction.estimate import estimate
from gsmerge.runtime.estimate import placed_seconds
from gsmerge.types import Cameras, Scene

NONE = Cameras(np.zeros((0, 4, 4)), np.zeros((0, 3, 3)), 1, 1)


def test_a_fit_is_told_where_a_budget_is_named() -> None:
    scene = Scene(random_gaussians(20_000, 0), NONE, None, None, ())
    plain, asked, best = (
        estimate(scene, CompactOptions().with_settings(settings))
        for settings in ({}, {"budget": "10%"}, {"budget": "10%", "effort": "best"})
    )
    assert (plain["fit"], asked["fit"], best["fit"]) == ("none", "full", "full")
    assert asked["seconds"] < best["seconds"]


def test_more_counts_steps_and_views_take_longer() -> None:
    def seconds(threads: int = 2, fit_steps: int = 200, views: int = 48, tries: int = 1) -> float:
        return placed_seconds(10**6, 10**4, threads=threads, fit_steps=fit_steps, views=views, tries=tries)

    assert seconds(fit_steps=0) < seconds() < seconds(fit_steps=1000) < seconds(fit_steps=1000, views=144)
    assert seconds() < seconds(threads=1)
    assert seconds() < seconds(tries=4)
