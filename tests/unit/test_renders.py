"""Scenes without photos and pixels whose cameras are known: neighbours are merged, and fitted to renders."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scenes
import unaligned_scenes

from gsmerge import Cameras, CompactOptions, Scene, compact, render
from gsmerge.jobs.estimate import estimate
from gsmerge.method.facts.scene_size import measure_size
from gsmerge.method.fit import Fitted
from gsmerge.method.fit.outside import STEP_BACK_HIGH, STEP_BACK_LOW, outside_cameras
from gsmerge.method.fit.report import FitReport
from gsmerge.method.geometry.transforms import camera_centres
from gsmerge.method.pipelines.bare_rows import BARE_ROWS
from gsmerge.method.pipelines.build import build
from gsmerge.method.pipelines.pixel_rows import PIXEL_ROWS
from gsmerge.method.raster.metrics import psnr
from gsmerge.method.viewpoints.place_cameras import (
    FEW_RENDERED_VIEWS,
    MOST_OUTSIDE,
    OUTSIDE_SHARE,
    between_cameras,
    draw_around,
    draw_pictures,
)
from gsmerge.plan.make_plan import make_plan, plan_scene
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.types import Decoded, Gaussians, Region


@pytest.fixture(scope="module")
def scene() -> Scene:
    made = scenes.make_scene(scenes.room(), scenes.arc(4, 64, 48), noise=0.05)
    return replace(unaligned_scenes.shuffled(made), images=None)


def distance(gaussians: Gaussians, scene: Scene, cameras: Cameras) -> np.ndarray:
    """PSNR (dB) of each view against the input."""
    after, before = (render(each, cameras).images.clip(0, 1) for each in (gaussians, scene.gaussians))
    return np.array([psnr(a, b) for a, b in zip(after, before, strict=True)])


@pytest.mark.slow
def test_nearer_to_the_input_than_superpixels(scene: Scene) -> None:
    """Two fits to renders, which take half a second each."""
    pairs, superpixels = (compact(scene, budget="4%", **more).gaussians for more in ({}, {"max_color": 0.11}))
    for cameras, gain in (
        (between_cameras(scene.cameras, 0.25, 0.75), 0.7),
        (outside_cameras(scene.gaussians.means, scene.cameras, 8, STEP_BACK_LOW, STEP_BACK_HIGH), 4),
    ):
        ours, theirs = (distance(each, scene, cameras) for each in (pairs, superpixels))
        assert ours.mean() > theirs.mean() + gain
        assert ours.min() > theirs.min()


def test_what_is_empty_stays_empty(scene: Scene) -> None:
    """Renders have no opacity: on a background other than black, a fit would cover what is empty with black."""
    half = replace(scene, gaussians=scene.gaussians[scene.gaussians.means[:, 0] > 0])
    result = compact(half, budget="8%").gaussians
    alphas = [render(g, scene.cameras).alphas[..., 0] for g in (half.gaussians, result)]
    empty = alphas[0] < 0.02
    assert empty.mean() > 0.2
    assert alphas[1][empty].mean() < 0.05


@pytest.mark.slow
def test_what_lies_around_does_not_refuse_a_fit(scene: Scene) -> None:
    """A fit that shows the given views better is kept, whatever it does to the others."""
    prepared = prepare(scene)
    around = prepared.scene_around
    noise = np.random.default_rng(0).random(around.images.shape, dtype=np.float32)
    noise[: len(scene)] = around.images[: len(scene)]
    object.__setattr__(prepared, "scene_around", replace(around, images=noise))
    plan = make_plan(prepared, CompactOptions().with_settings({"budget": "4%"}))
    fitted = build(prepared, plan, 400)
    assert fitted.report.accepted


def test_a_refused_fit_leaves_all_that_was_merged(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(decoded: Decoded, around: Scene, *_: object, **__: object) -> Fitted:
        report = FitReport("none", False, 1, math.nan, math.nan, "worse")
        return Fitted(decoded.gaussians[:10], around.cameras, report)

    monkeypatch.setattr("gsmerge.method.stages.fit_pairs.fit_scene", fail)
    assert len(compact(scene, budget=300).gaussians) == 300


def test_all_of_the_input_is_left_as_it_is_by_superpixels_too(scene: Scene) -> None:
    result = compact(scene, budget="100%", max_color=0.11)
    assert "fit" not in result.report.choices
    assert len(result.gaussians) == len(scene.gaussians)


@pytest.mark.slow
def test_a_fit_brings_them_nearer_where_few_are_left(scene: Scene) -> None:
    merged, fitted = (compact(scene, budget="2%", **more) for more in ({"fit": "none"}, {}))
    assert "fit" in fitted.report.choices
    assert "fit" not in merged.report.choices
    between = between_cameras(scene.cameras)
    assert distance(fitted.gaussians, scene, between).mean() > distance(merged.gaussians, scene, between).mean() + 2


@pytest.mark.slow
def test_what_looks_like_the_input_already_gains_by_a_fit_as_well(scene: Scene) -> None:
    fitted, unfitted = (compact(scene, budget="60%", fit=fit).report.choices["fidelity"] for fit in ("full", "none"))
    assert unfitted["psnr"] > 36
    assert fitted["psnr"] > unfitted["psnr"] + 1


def test_a_view_that_shows_nothing_says_nothing_of_a_result(scene: Scene) -> None:
    turned = scene.cameras.viewmats.copy()
    turned[1] = np.diag([-1, 1, -1, 1]) @ turned[0]
    away = replace(scene, cameras=replace(scene.cameras, viewmats=turned))
    fidelity = compact(away, budget="2%", fit="none", effort="best").report.choices["fidelity"]
    assert fidelity["views"] == 3
    assert 15 < fidelity["psnr"] < 35


@pytest.mark.parametrize("settings", [{"budget": 200}, {"superpixels": 25, "k": 2}])
def test_counts_and_cameras_are_as_asked_for(settings: dict[str, object], scene: Scene) -> None:
    result = compact(scene, fit_steps=15, **settings)
    assert len(result.gaussians) == 200
    np.testing.assert_array_equal(result.cameras.viewmats, scene.cameras.viewmats)


def test_the_plan_and_its_estimate_say_so(scene: Scene) -> None:
    size = measure_size(scene)
    assert plan_scene(size, CompactOptions()).pipeline == BARE_ROWS
    assert estimate(scene, CompactOptions())["superpixels_per_view"] == 0
    for settings in ({"max_color": 0.11}, {"segmentation": "grid"}, {"checkpoint": "shipped"}, {"method": "greedy"}):
        assert plan_scene(size, CompactOptions().with_settings(settings)).pipeline == PIXEL_ROWS
    assert plan_scene(replace(size, rendered=False), CompactOptions()).pipeline == PIXEL_ROWS


def test_cameras_between_stand_half_way_and_look_at_the_same(scene: Scene) -> None:
    cameras = scene.cameras[:2]
    middle, outside_first, outside_second = between_cameras(cameras, -0.3).centres
    first, second = camera_centres(cameras.viewmats.astype(np.float64))
    apart = np.linalg.norm(second - first)
    for centre in (first, second):
        assert np.linalg.norm(middle - centre) == pytest.approx(apart / 2, rel=0.05)
    assert np.linalg.norm(outside_first - first) == pytest.approx(0.3 * apart, rel=0.05)
    assert np.linalg.norm(outside_second - first) > apart


def test_a_fit_sees_what_lies_around_its_views(scene: Scene) -> None:
    region = Region(np.zeros(3), np.full(3, 50.0), np.eye(3), is_sphere=False)
    drawn = draw_pictures(replace(scene, region=region))
    more = draw_around(drawn)
    assert more.region is region
    assert len(more) > len(scene) + int(OUTSIDE_SHARE * len(scene))
    assert len(more.images) == len(more.cameras) == len(more.names) == len(set(more.names))
    np.testing.assert_array_equal(more.images[: len(scene)], drawn.images)
    assert np.abs(more.images - render(scene.gaussians, more.cameras).images.clip(0, 1)).mean() < 1e-4


@pytest.mark.parametrize(("count", "outside"), [(1, 0), (FEW_RENDERED_VIEWS + 1, 12), (4 * MOST_OUTSIDE, MOST_OUTSIDE)])
def test_of_many_views_nothing_between_is_drawn(scene: Scene, count: int, outside: int) -> None:
    drawn, views = draw_pictures(scene), [0] * count
    several = replace(drawn, cameras=drawn.cameras[views], images=drawn.images[views], names=("",) * count)
    assert len(draw_around(several)) == count + outside
