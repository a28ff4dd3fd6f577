"""Budgets of nearly nothing and of everything, and views of hardly any pixels, give sound results."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
from sweeps import sweep

from gsmerge import Scene, compact
from gsmerge.errors import UsageError

VIEWS = 4
LONG = [(1024, 2), (4096, 1), (4096, 8), (8, 4096)]
PLAIN = {"fit": "none", "checkpoint": "none"}


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(VIEWS, 32, 24), noise=0.005)


def unaligned(scene: Scene) -> Scene:
    return Scene(scene.gaussians, scene.cameras, scene.images, None, scene.names)


@sweep("settings", [PLAIN, {"fit": "none"}, {"fit_steps": 20}, {"k": 4, **PLAIN}])
def test_budget_of_one_gaussian_for_each_view_is_met_in_the_scene_s_colours(
    room: Scene, settings: dict[str, Any]
) -> None:
    result = scenes.compacted(room, superpixels="auto", budget=VIEWS, **settings)
    assert len(result.gaussians) == VIEWS
    image, alpha = scenes.images_of(result.gaussians, room.cameras)
    assert alpha.mean() > 0.3
    shown = (image * alpha[..., None]).sum((0, 1, 2)) / alpha.sum()
    assert np.abs(shown - room.images.mean((0, 1, 2))).max() < 0.25


@sweep("settings", [PLAIN, {"fit": "none"}, {"fit_steps": 20}, {"k": 4, **PLAIN}])
def test_budget_below_one_gaussian_for_each_view_is_refused(room: Scene, settings: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="budget"):
        compact(room, budget=VIEWS - 1, **settings)


@sweep("settings", [PLAIN, {"fit": "none"}, {"fit_steps": 20}])
def test_budget_of_all_gaussians_keeps_the_input_s_quality(room: Scene, settings: dict[str, Any]) -> None:
    result = scenes.compacted(room, superpixels="auto", budget="100%", fill=True, match="none", **settings)
    assert len(result.gaussians) == room.num_gaussians
    assert scenes.psnr_of(result.gaussians, room) > scenes.psnr_of(room.gaussians, room) - 0.1


def test_budget_of_every_unaligned_gaussian_changes_none(room: Scene) -> None:
    result = compact(unaligned(room), budget="100%", **PLAIN)
    assert scenes.identical(result.gaussians, compact(unaligned(room), budget=room.num_gaussians, **PLAIN).gaussians)
    np.testing.assert_allclose(result.gaussians.means, room.gaussians.means, atol=1e-6)
    np.testing.assert_array_equal(result.gaussians.sh0, room.gaussians.sh0)


@sweep("aligned", [True, False], ids=["aligned", "unaligned"], often=2)
@sweep("budget", [5, 97, 500, 1501], ids="budget={}".format, often=2)
@sweep("settings", [{}, PLAIN, {"k": 2}, {"k": 8, **PLAIN}, {"segmentation": "grid"}], often=2)
def test_budgets_without_a_fit_are_met(room: Scene, budget: int, settings: dict[str, Any], aligned: bool) -> None:
    scene = room if aligned else unaligned(room)
    result = compact(scene, budget=budget, **{"fit": "none", **settings})
    assert len(result.gaussians) == result.report.num_output == budget
    scenes.assert_invariants(result.gaussians, room)


@pytest.mark.slow
@pytest.mark.parametrize("settings", [PLAIN, {"fit": "none"}, {"fit_steps": 10}])
def test_scene_of_four_hundred_tiny_views_is_compacted(settings: dict[str, Any]) -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(400, 8, 6))
    result = scenes.compacted(scene, **settings)
    assert 400 * 8 * 6 * 0.001 < len(result.gaussians) < 400 * 8 * 6 * 0.2
    few = scenes.take_views(scene, range(0, 400, 40))
    assert scenes.psnr_of(result.gaussians, few) > scenes.psnr_of(scene.gaussians, few) - 1


@sweep("size", LONG, ids=[f"{width} x {height}" for width, height in LONG])
@sweep("settings", [PLAIN, {"fit_steps": 10}])
def test_views_of_a_long_side_are_covered_to_their_ends(size: tuple[int, int], settings: dict[str, Any]) -> None:
    width, height = size
    cameras = scenes.arc(2, *size)
    if height > width:
        Ks = cameras.Ks.copy()
        Ks[:, [0, 1], [0, 1]] = height
        cameras = replace(cameras, Ks=Ks)
    scene = scenes.make_scene(scenes.wall(), cameras)
    result = scenes.compacted(scene, superpixels="2%", **settings)
    assert len(result.gaussians) <= 0.04 * scene.num_gaussians
    _, alpha = scenes.images_of(result.gaussians, scene.cameras)
    along = alpha.mean((0, 1)) if width > height else alpha.mean((0, 2))
    assert along[: len(along) // 16].mean() > 0.5
    assert along[-(len(along) // 16) :].mean() > 0.5
