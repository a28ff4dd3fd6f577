"""Parts of an index of levels: sky that photos show is in none of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from sky_scenes import HAZE, ZENITH, painted

from gsmerge import CompactOptions, Gaussians, Scene
from gsmerge.compaction.report import CompactReport
from gsmerge.compaction.result import CompactResult
from gsmerge.compaction.streamed_parts import split_levels
from gsmerge.settings.budget import BudgetOptions
from gsmerge.settings.stages import CleanOptions


def result_of(scene: Scene) -> CompactResult:
    """Two levels: the scene itself, and every fourth of its Gaussians."""
    report = CompactReport(1, 1, {}, None, None, {"count": 1}, [], {}, 0)
    coarser = (CompactResult(scene.gaussians[::4], report, scene.cameras),)
    return CompactResult(scene.gaussians, report, scene.cameras, coarser)


def test_sky_is_in_no_level() -> None:
    scene, rows = painted(ZENITH, HAZE)
    parts = split_levels(result_of(scene), scene, CompactOptions(), None)
    assert parts.environment is not None
    assert rows.sum() * 0.8 < len(parts.environment) < rows.sum() * 1.05
    assert len(parts.levels[0]) + len(parts.environment) == len(scene.gaussians)
    assert len(parts.levels[1]) < 0.75 * len(scene.gaussians[::4])
    noted = parts.noted(result_of(scene)).report.choices
    assert noted == {"count": 1, "streamed": {"errors": True, "environment": len(parts.environment)}}


@pytest.mark.slow
@pytest.mark.parametrize("reason", ["dropped", "size", "photos"])
def test_it_stays_where_it_may(reason: str) -> None:
    """Where it has been dropped already, where the files would not have the bytes asked for, and without photos."""
    scene, _ = painted(ZENITH, HAZE)
    scene = replace(scene, images=None) if reason == "photos" else scene
    settings: dict[str, dict[str, Any]] = {
        "dropped": {"clean": CleanOptions(drop="sky")},
        "size": {"budget": BudgetOptions(budget="100MB", output="lod-meta.json", levels=2)},
        "photos": {},
    }
    parts = split_levels(result_of(scene), scene, CompactOptions(**settings[reason]), None)
    assert parts.environment is None
    assert len(parts.levels[0]) == len(scene.gaussians)


def test_without_cameras_there_are_no_errors() -> None:
    scene, _ = painted(ZENITH, HAZE)
    nowhere: Gaussians = scene.gaussians
    alone = Scene(nowhere, scene.cameras[np.arange(0)], None, None, ())
    parts = split_levels(replace(result_of(scene), cameras=alone.cameras), alone, CompactOptions(), None)
    assert parts.measure is None
