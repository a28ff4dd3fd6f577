"""Few, repeated, disjoint, turned and misplaced views do little harm (stability.md, cases 21 to 27)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from sweeps import sweep

from gsmerge import Cameras, Scene
from gsmerge.method.geometry.views import concat_cameras
from gsmerge.method.kernels import elementary


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3), noise=0.005)


# 21: one view several times


@sweep("times", [3, 2, 6], ids="{} times".format)
def test_repeated_view_counts_once(room: Scene, times: int) -> None:
    single, repeated = scenes.take_views(room, [0]), scenes.take_views(room, [0] * times)
    one, many = scenes.plain(single), scenes.plain(repeated)
    assert len(many) <= 1.05 * len(one)
    assert scenes.psnr_of(many, single) > scenes.psnr_of(one, single) - 0.2


def test_repeated_view_counts_once_with_the_full_fit(room: Scene) -> None:
    """It grows to the number asked for, however few are left to begin with."""
    single, repeated = scenes.take_views(room, [0]), scenes.take_views(room, [0] * 3)
    one, many = (scenes.compacted(scene, fit_steps=60) for scene in (single, repeated))
    assert many.report.choices["clusters"] <= 1.05 * one.report.choices["clusters"]
    assert len(one.gaussians) <= len(many.gaussians) <= 3 * len(one.gaussians)
    assert scenes.psnr_of(many.gaussians, single) > scenes.psnr_of(one.gaussians, single) - 0.5


# 22: no baseline


def test_views_from_one_place_lose_little_quality() -> None:
    eye = np.zeros(3)
    viewmats = [scenes.look_at(eye, np.array([x, 0.0, 3.0])) for x in (-0.4, 0.0, 0.4)]
    cameras = Cameras(np.stack(viewmats), scenes.intrinsics(3, 48, 36), 48, 36)
    scene = scenes.make_scene(scenes.wall(), cameras)
    result = scenes.compacted(scene, fit_steps=60)
    assert result.report.choices["fit"]["accepted"]
    assert scenes.psnr_of(result.gaussians, scene) > scenes.psnr_of(scene.gaussians, scene) - 3


# 23: one view


def test_single_view_is_fitted_and_has_nothing_to_match(room: Scene) -> None:
    single = scenes.take_views(room, [1])
    matched, apart = (scenes.compacted(single, fit_steps=60, match=match) for match in ("overlap", "none"))
    for name in scenes.FIELDS:
        np.testing.assert_array_equal(getattr(matched.gaussians, name), getattr(apart.gaussians, name))
    fit = matched.report.choices["fit"]
    assert fit["holdout_after"] > fit["holdout_before"] > 10


# 24: views that share nothing


def test_disjoint_views_are_merged_like_single_ones() -> None:
    surfaces = scenes.wall()
    near = scenes.arc(1)
    shift = np.eye(4)
    shift[0, 3] = -30
    far = replace(near, viewmats=near.viewmats @ shift)
    both = concat_cameras(near, far)
    together = scenes.plain(scenes.make_scene(surfaces, both))
    scene = scenes.make_scene(surfaces, both)
    apart = [scenes.plain(scenes.take_views(scene, [view])) for view in (0, 1)]
    assert len(together) == len(apart[0]) + len(apart[1])
    left = together.means[:, 0] < 15
    scenes.assert_same_set(together[left], apart[0], atol=1e-4)
    scenes.assert_same_set(together[~left], apart[1], atol=1e-4)


# 25: order


def test_order_of_views_does_not_matter_to_the_choice_of_start(room: Scene) -> None:
    one, other = scenes.compacted(room, fit="none"), scenes.compacted(scenes.take_views(room, [2, 0, 1]), fit="none")
    assert ("networks" in one.report.choices) == ("networks" in other.report.choices)
    scenes.assert_same_set(one.gaussians, other.gaussians, atol=1e-3)


# 27: wrong poses


def misplaced(scene: Scene, degrees: float) -> Scene:
    """Turn views 1 and 2 with their Gaussians about their own eyes, one to either side."""
    means, viewmats = scene.gaussians.means.copy().reshape(3, -1, 3), scene.cameras.viewmats.copy()
    for view, sign in ((1, 1), (2, -1)):
        angle = np.deg2rad(sign * degrees)
        turn = np.eye(4)
        turn[0, 0] = turn[2, 2] = elementary.cos(angle)
        turn[0, 2], turn[2, 0] = elementary.sin(angle), -elementary.sin(angle)
        old = viewmats[view].copy()
        viewmats[view] = turn @ old
        camera = means[view] @ old[:3, :3].T + old[:3, 3]
        means[view] = (camera - viewmats[view, :3, 3]) @ viewmats[view, :3, :3]
    gaussians = replace(scene.gaussians, means=means.reshape(-1, 3))
    return replace(scene, gaussians=gaussians, cameras=replace(scene.cameras, viewmats=viewmats))


DEGREES = (0.0, 0.2, 1.0, 5.0, 20.0)


@pytest.mark.slow
def test_quality_falls_step_by_step_with_wrong_poses(room: Scene) -> None:
    wrong = [misplaced(room, degrees) for degrees in DEGREES[:4]]
    fixed, auto = (
        np.array([scenes.compacted(scene, poses=poses).report.psnr_after for scene in wrong], float)
        for poses in ("fixed", "auto")
    )
    assert (np.diff(fixed) < 0.5).all()
    assert (auto > fixed - 0.5).all()
    assert auto[-1] > fixed[-1] + 2


@sweep("degrees", DEGREES, ids="{} degrees off".format)
def test_fit_never_hurts_under_wrong_poses(room: Scene, degrees: float) -> None:
    scene = misplaced(room, degrees)
    fitted, unfitted = (scenes.compacted(scene, fit=fit) for fit in ("full", "none"))
    fit = fitted.report.choices["fit"]
    assert fit["accepted"] == (fit["holdout_after"] > fit["holdout_before"])
    assert fitted.report.psnr_after > unfitted.report.psnr_after - 0.1  # type: ignore[operator]


# more views of the same surfaces


@pytest.mark.slow
def test_more_views_keep_the_quality_between_views() -> None:
    """From a place between the views; matching makes one layer of the views' many, and it must still be closed."""
    between = scenes.make_scene(scenes.room(), scenes.arc(1, 64, 48, start=-0.23))
    actual = []
    for views in (3, 6):
        scene = scenes.make_scene(scenes.room(), scenes.arc(views, 64, 48), noise=0.01)
        actual.append(
            scenes.psnr_of(scenes.compacted(scene, superpixels="4.4%", fit_steps=60, poses="fixed").gaussians, between)
        )
    assert actual[1] > actual[0] - 0.5
