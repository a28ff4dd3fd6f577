"""How many views' results are in memory together changes memory alone: results are the same to the last bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scenes
import unaligned_scenes

from gsmerge import Scene, compact
from gsmerge.method.geometry.pooling import scene_members


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(5, 24, 18), noise=0.01)


@pytest.mark.parametrize(
    "settings",
    [
        {"fit": "none", "checkpoint": "none"},
        {"budget": "8%", "fit_steps": 30, "effort": "best"},  # grows
    ],
)
def test_results_of_one_view_at_a_time_are_those_of_all_at_once(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any]
) -> None:
    actual = []
    for at_once in (2, 100):
        monkeypatch.setattr("gsmerge.runtime.threads.AT_ONCE", at_once)
        actual.append(scenes.compacted(scene, **settings).gaussians)
    assert scenes.identical(*actual)


def test_higher_harmonics_are_not_copied() -> None:
    """Of degree 4 they are most of a scene."""
    g = scenes.make_scene(scenes.room(), scenes.arc(2, 32, 24), degree=3)
    members = scene_members(g)
    assert np.shares_memory(members.shN, g.gaussians.shN)


def test_many_gaussians_drawn_one_view_at_a_time_give_the_same_bits(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    actual = []
    for many in (0, 10**9):
        monkeypatch.setattr("gsmerge.method.raster.images.ONE_AT_A_TIME", many)
        unaligned = unaligned_scenes.without_order(scene)
        actual.append(compact(unaligned, fit="none", superpixels="10%").gaussians)
    assert scenes.identical(actual[0], actual[1])
