"""Scenes without photos and pixels whose cameras are known: neighbours are merged, and fitted to renders."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
import unaligned_scenes

from gsmerge import Cameras, CompactOptions, Scene, compact, render
from gsmerge.compaction.estimate import estimate
from gsmerge.facts.place_cameras import FEW_VIEWS, OUTSIDE, between_cameras, draw_between, draw_pictures
from gsmerge.facts.scene_size import measure_size
from gsmerge.geometry import camera_centres
from gsmerge.plan import merges_pairs
from gsmerge.raster.metrics import psnr
from gsmerge.types import Gaussians


@pytest.fixture(scope="module")
def scene() -> Scene:
    made = scenes.make_scene(scenes.room(), scenes.arc(4, 64, 48), noise=0.01)
    return replace(unaligned_scenes.shuffled(made), images=None)


def distance(gaussians: Gaussians, scene: Scene, cameras: Cameras) -> np.ndarray:
    """PSNR (dB) of each view against the input."""
    after, before = (render(each, cameras).images.clip(0, 1) for each in (gaussians, scene.gaussians))
    return np.array([psnr(a, b) for a, b in zip(after, before, strict=True)])


@pytest.mark.parametrize(("effort", "gain"), [("draft", 0.3), ("default", 1)])
def test_nearer_to_the_input_than_superpixels_between_the_views(scene: Scene, effort: str, gain: float) -> None:
    between = between_cameras(scene.cameras, 0.25, 0.75)
    settings: dict[str, Any] = {"budget": "4%", "effort": effort}
    pairs = distance(compact(scene, **settings).gaussians, scene, between)
    superpixels = distance(compact(scene, max_color=0.11, **settings).gaussians, scene, between)
    assert pairs.mean() > superpixels.mean() + gain
    assert pairs.min() > superpixels.min() + gain


def test_a_fit_brings_them_nearer_where_few_are_left(scene: Scene) -> None:
    merged, fitted = (compact(scene, budget="2%", **more) for more in ({"fit": "none"}, {}))
    assert "fit" in fitted.report.choices
    assert "fit" not in merged.report.choices
    between = between_cameras(scene.cameras)
    assert distance(fitted.gaussians, scene, between).mean() > distance(merged.gaussians, scene, between).mean() + 2


def test_what_shows_the_input_already_is_not_fitted(scene: Scene) -> None:
    result = compact(scene, budget="60%")
    assert "fit" not in result.report.choices
    assert result.report.choices["fidelity"]["psnr"] > 36
    assert len(result.gaussians) == int(0.6 * len(scene.gaussians))


def test_a_view_that_shows_nothing_says_nothing_of_a_result(scene: Scene) -> None:
    turned = scene.cameras.viewmats.copy()
    turned[1] = np.diag([-1, 1, -1, 1]) @ turned[0]
    away = replace(scene, cameras=replace(scene.cameras, viewmats=turned))
    fidelity = compact(away, budget="2%", fit="none").report.choices["fidelity"]
    assert fidelity["views"] == 3
    assert 15 < fidelity["psnr"] < 35


def test_counts_and_cameras_are_as_asked_for(scene: Scene) -> None:
    for settings in ({"budget": 200}, {"superpixels": 25, "k": 2}):
        result = compact(scene, fit_steps=150, **settings)
        assert len(result.gaussians) == 200
        np.testing.assert_array_equal(result.cameras.viewmats, scene.cameras.viewmats)


def test_the_plan_and_its_estimate_say_so(scene: Scene) -> None:
    size = measure_size(scene)
    assert merges_pairs(size, CompactOptions())
    assert estimate(scene, CompactOptions())["superpixels_per_view"] == 0
    for settings in ({"max_color": 0.11}, {"segmentation": "slic"}, {"checkpoint": "shipped"}, {"method": "voxel"}):
        assert not merges_pairs(size, CompactOptions().with_settings(settings))
    assert not merges_pairs(replace(size, photos=True, drawn=False), CompactOptions())


def test_cameras_between_stand_half_way_and_look_at_the_same(scene: Scene) -> None:
    cameras = scene.cameras[:2]
    middle, outside_first, outside_second = between_cameras(cameras, OUTSIDE).centres
    first, second = camera_centres(cameras.viewmats.astype(np.float64))
    apart = np.linalg.norm(second - first)
    for centre in (first, second):
        assert np.linalg.norm(middle - centre) == pytest.approx(apart / 2, rel=0.05)
    assert np.linalg.norm(outside_first - first) == pytest.approx(-OUTSIDE * apart, rel=0.05)
    assert np.linalg.norm(outside_second - first) > apart


def test_few_views_see_what_lies_between_them(scene: Scene) -> None:
    drawn = draw_pictures(scene)
    more = draw_between(drawn)
    assert len(more) > len(scene)
    assert len(more.images) == len(more.cameras) == len(more.names) == len(set(more.names))
    np.testing.assert_array_equal(more.images[: len(scene)], drawn.images)
    assert np.abs(more.images - render(scene.gaussians, more.cameras).images.clip(0, 1)).mean() < 1e-4
    for count in (1, FEW_VIEWS + 1):
        views = [0] * count
        other = replace(drawn, cameras=drawn.cameras[views], images=drawn.images[views], names=("",) * count)
        assert draw_between(other) is other
