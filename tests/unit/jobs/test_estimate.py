"""The time and the fit of a run are estimated before it begins."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from exports import export_rows, save_export, smooth_scene
from made_gaussians import random_gaussians

from gsmerge import CompactOptions, compact
from gsmerge.counts.curve import curve_counts
from gsmerge.jobs.estimate import IMPORT_SECONDS, RunCosts, estimate
from gsmerge.method.facts.scene_size import SceneSize
from gsmerge.plan.counts import count_limits, level_counts
from gsmerge.plan.forecast import usual_builds
from gsmerge.reading.read_scene import load_scene
from gsmerge.types import Cameras, Scene

VIEW = 480 * 320
ALONE = Scene(random_gaussians(20_000, 0), Cameras(np.zeros((0, 4, 4)), np.zeros((0, 3, 3)), 1, 1), None, None, ())


def seconds(
    views: int = 12, *, steps: int = 240, count: int = 50_000, threads: int = 1, num_builds: int = 1,
    has_curve: bool = False, has_trial: bool = False, **changes: Any,
) -> float:  # fmt: skip
    """Return the wall time of a run, with settings of ``compact``."""
    options = CompactOptions().with_settings({"checkpoint": "none"} | changes)
    size = SceneSize(views * VIEW, views, 320, 480, True, rendered=False)
    limits = count_limits(size, options.segment, options.decode, options.budget)
    curve = curve_counts(None, limits.default, limits.min_count, limits.max_count) if has_curve else ((), 0)
    costs = RunCosts(
        options.to_dict(), views * VIEW, VIEW, 0.5, steps, num_builds=num_builds, curve=curve, has_trial=has_trial
    )
    return costs.seconds(count, level_counts(count, options.budget.levels), views, threads)


def test_a_run_with_more_work_is_estimated_to_take_longer() -> None:
    usual = seconds()
    assert IMPORT_SECONDS < seconds(steps=0) < seconds(steps=0, method="greedy")
    assert seconds(steps=0, method="random") < usual < seconds(recipe="paper", checkpoint="paper")
    assert usual < min(seconds(24), seconds(steps=1000), seconds(count=10**6))
    assert seconds(steps=0, count=1) == seconds(steps=0, count=10**6)
    searched = seconds(num_builds=usual_builds(has_target=True, rendered=False))
    for longer in (seconds(levels=3), seconds(has_trial=True), seconds(has_curve=True), searched):
        assert usual < longer < 4 * usual
    assert seconds(2) > seconds(2, threads=2) == seconds(2, threads=16)


def test_a_file_without_cameras_is_fitted_except_in_a_draft() -> None:
    draft, asked, best = (
        estimate(ALONE, CompactOptions().with_settings({"budget": "10%", "effort": effort}))
        for effort in ("draft", "default", "best")
    )
    assert (draft["fit"], asked["fit"], best["fit"]) == ("none", "full", "full")
    assert asked["seconds"] < best["seconds"]


def test_a_draft_with_filled_borders_has_no_more_than_the_estimate(tmp_path: Path) -> None:
    """Filled pixels have superpixels, too, and no fit grows to a number of its own."""
    tiny = smooth_scene(96, 72)
    inner = np.zeros((3, 72, 96), bool)
    inner[:, 10:-10, 12:-12] = True
    scene = load_scene(save_export(tmp_path, tiny, export_rows(tiny, np.flatnonzero(inner)))).scene
    settings = {"effort": "draft", "match": "none"}
    run, result = estimate(scene, CompactOptions().with_settings(settings)), compact(scene, **settings)
    rows = len(scene.gaussians)
    assert int(0.044 * rows) < len(result.gaussians) <= run["num_gaussians"] < 0.1 * rows
