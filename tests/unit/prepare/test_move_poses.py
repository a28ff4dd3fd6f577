"""Views that do not agree with each other are found and moved; those that agree are left alone."""

from __future__ import annotations

from dataclasses import replace

import motions
import numpy as np
import pytest
import scenes

from gsmerge import CompactOptions, Scene, compact
from gsmerge.counts.clean_up import build_cleaned
from gsmerge.method.fit import Fitted
from gsmerge.method.geometry.transforms import (
    evaluate_harmonics,
    motion_matrices,
    motion_vectors,
    normalize,
    pose_changes,
    project,
    quat_to_rotmat,
)
from gsmerge.method.geometry.transforms import without_common_motion as without_common
from gsmerge.method.raster import render
from gsmerge.method.raster.metrics import psnr
from gsmerge.plan.make_plan import make_plan
from gsmerge.prepare.move_poses import CHANCE, move_poses
from gsmerge.prepare.prepare_scene import prepare

VIEWS = range(5)
GLOSS = 0.2  # strength of a highlight's harmonics


@pytest.fixture(scope="module")
def scene() -> Scene:
    made = scenes.make_scene(scenes.room(), scenes.arc(5, 160, 120))
    back = -np.median(made.gaussians.means[:, 2])  # the canonical frame is about the scene's middle
    return scenes.move(made, np.eye(3), 0.5, np.array([0, 0, 0.5 * back]))


@pytest.fixture(scope="module")
def small() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3))


def worst_error(scene: Scene, truth: Scene) -> tuple[float, float]:
    """Return the largest degrees and distances between relative poses."""
    relative = [one.cameras.viewmats @ np.linalg.inv(one.cameras.viewmats[2]) for one in (scene, truth)]
    degrees, distances = pose_changes(*relative)
    return float(degrees.max()), float(distances.max())


def with_highlight(scene: Scene) -> Scene:
    """Return the scene with harmonics of degree 3, brightest where a wall at right angles to z mirrors a lamp."""
    g, eyes = scene.gaussians, scene.cameras.centres.repeat(scene.pixels_per_view, 0)
    lamp = np.array([0.0, -0.2, 2 * np.median(g.means[:, 2]) - np.median(eyes[:, 2])])  # in the mirror
    lobes, seen = (evaluate_harmonics(normalize(away), 15) for away in (lamp - g.means, g.means - eyes))
    lobes *= GLOSS
    bright = (lobes * seen).sum(1).reshape(*scene.images.shape[:3], 1)
    shiny = replace(g, shN=lobes[:, :, None].repeat(3, 2).astype(np.float32))
    return replace(scene, gaussians=shiny, images=(scene.images + bright).clip(0, 1).astype(np.float32))


def test_gaussians_moved_with_their_view_stay_at_their_pixels(scene: Scene) -> None:
    moved = motions.disagreeing(scene)
    for view in VIEWS:
        rows = slice(view * scene.pixels_per_view, (view + 1) * scene.pixels_per_view)
        (before,), _ = project(scene.gaussians.means[rows], scene.cameras[[view]])
        (after,), _ = project(moved.gaussians.means[rows], moved.cameras[[view]])
        np.testing.assert_allclose(before, after, atol=1e-2)
        axes = [
            one.cameras.viewmats[view, :3, :3] @ quat_to_rotmat(one.gaussians.quats[rows]) for one in (scene, moved)
        ]
        np.testing.assert_allclose(*axes, atol=1e-5)


def test_views_that_agree_are_not_moved(scene: Scene) -> None:
    assert move_poses(scene, VIEWS) is None


@pytest.mark.parametrize("known", [True, False], ids=["harmonics", "none"])
def test_highlights_are_not_taken_for_wrong_poses(known: bool, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The wall mirrors a lamp, whose image moves with the camera; only detail tells if Gaussians have no harmonics."""
    glossy = with_highlight(scene)
    seen = glossy if known else replace(glossy, gaussians=replace(glossy.gaussians, shN=scene.gaussians.shN))
    monkeypatch.setattr("gsmerge.prepare.move_poses.CHANCE", np.inf if known else CHANCE)
    assert move_poses(seen, VIEWS) is None


def test_wrong_poses_of_views_with_highlights_are_mended(scene: Scene) -> None:
    wrong = motions.disagreeing(with_highlight(scene))
    assert worst_error(move_poses(wrong, VIEWS), scene)[0] < 0.1 * worst_error(wrong, scene)[0]


@pytest.mark.parametrize("views", [slice(None), slice(1, 2)], ids=["all", "one"])
def test_views_with_wrong_poses_are_moved_to_where_they_agree(views: slice, scene: Scene) -> None:
    wrong = motions.disagreeing(scene, views=views)
    before = worst_error(wrong, scene)
    found = move_poses(wrong, VIEWS)
    degrees, distance = worst_error(found, scene)
    assert degrees < 0.25 * before[0]  # most of the error is gone
    assert distance < 0.25 * before[1]
    common = motion_vectors(wrong.cameras.viewmats, found.cameras.viewmats)
    np.testing.assert_allclose(np.median(common, 0), 0, atol=2e-3)


def test_views_that_are_left_out_are_not_moved(scene: Scene) -> None:
    wrong = motions.disagreeing(scene)
    found = move_poses(wrong, range(4))
    last = slice(4 * scene.pixels_per_view, None)
    np.testing.assert_allclose(found.cameras.viewmats[4], wrong.cameras.viewmats[4], atol=1e-12)
    np.testing.assert_allclose(found.gaussians.means[last], wrong.gaussians.means[last], atol=1e-6)
    common = motion_vectors(wrong.cameras.viewmats, found.cameras.viewmats)
    np.testing.assert_allclose(np.median(common[:4], 0), 0, atol=2e-3)


def test_repeated_views_share_the_camera_that_was_moved(small: Scene) -> None:
    viewmats = small.cameras.viewmats.copy()
    viewmats[1] = viewmats[0]  # of other Gaussians and another photo
    shared = scenes.take_views(replace(small, cameras=replace(small.cameras, viewmats=viewmats)), [0, 1, 0, 2])
    options = CompactOptions().with_settings({"fit": "none", "poses": "fixed", "effort": "best"})
    prepared = prepare(shared, options.prepare)
    assert prepared.repeated == (0, 1, 0, 2)
    assert prepared.final_cameras() is shared.cameras
    placed = motions.random_motions(3, 1.0, 0.1) @ prepared.scene.cameras.viewmats
    found = prepared.with_cameras(replace(prepared.scene.cameras, viewmats=placed)).final_cameras()
    np.testing.assert_allclose(prepared.frame.enter_cameras(found).viewmats, placed[[0, 1, 0, 2]], atol=1e-9)
    some = replace(prepared, reference=replace(prepared.reference, score_views=(0, 2)))
    assert make_plan(some, options).score.views == (0, 2, 3)


@pytest.mark.parametrize("cameras", [True, False])
def test_nothing_is_moved_without_photos(cameras: bool, small: Scene) -> None:
    places, names = (small.cameras, small.names) if cameras else (small.cameras[[]], ())
    unaligned = Scene(small.gaussians[::2], places, None, None, names)
    result = compact(unaligned, poses="free", budget=200, fit_steps=4)
    assert "poses" not in result.report.choices
    np.testing.assert_array_equal(result.cameras.viewmats, places.viewmats)


def test_coarser_levels_have_the_cameras_of_the_finest(small: Scene) -> None:
    result = compact(small, poses="free", fit_steps=12, superpixels="2%", levels=2)
    assert np.abs(result.cameras.viewmats - small.cameras.viewmats).max() > 0
    np.testing.assert_array_equal(result.coarser[0].cameras.viewmats, result.cameras.viewmats)


def test_clean_up_keeps_the_poses_of_the_fit(small: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    moved = replace(small.cameras, viewmats=small.cameras.viewmats + 0.01)
    fitted = Fitted(small.gaussians, moved, None)
    monkeypatch.setattr("gsmerge.counts.clean_up.build", lambda *_: fitted)
    options, prepared = CompactOptions().with_settings({"drop": "floaters"}), prepare(small)
    assert build_cleaned(prepared, make_plan(prepared, options), None).cameras is moved


@pytest.mark.parametrize("size", [(12, 8), (40, 1)])
def test_nothing_is_moved_by_tiny_photos(size: tuple[int, int]) -> None:
    tiny = scenes.make_scene(scenes.room(), scenes.arc(3, *size))
    assert move_poses(tiny, range(3), always=True) is None


def test_a_single_view_is_not_moved(scene: Scene) -> None:
    assert move_poses(scenes.take_views(scene, [0]), [0], always=True) is None


def test_a_motion_that_all_views_have_in_common_is_taken_out() -> None:
    start = np.tile(np.eye(4), (3, 1, 1))
    together = start @ motion_matrices(np.tile([0.1, 0.2, -0.1, 1.0, 2.0, 3.0], (3, 1)))
    np.testing.assert_allclose(without_common(start, together, np.mean), start, atol=1e-12)


@pytest.mark.slow
def test_compacting_notes_the_views_that_it_moved(scene: Scene) -> None:
    wrong, settings = motions.disagreeing(scene), {"effort": "draft", "superpixels": "2%", "match": "overlap"}
    fixed, auto = (compact(wrong, **settings, poses=poses) for poses in ("fixed", "auto"))
    assert "poses" not in fixed.report.choices
    np.testing.assert_array_equal(fixed.cameras.viewmats, wrong.cameras.viewmats)
    assert [move["view"] for move in auto.report.choices["poses"]] == list(wrong.names)
    assert sum("moved" in note for note in auto.report.notes) == 1
    assert worst_error(replace(wrong, cameras=auto.cameras), scene)[0] < 0.25 * worst_error(wrong, scene)[0]
    assert len(auto.gaussians) < 0.7 * len(fixed.gaussians)  # what two views show is merged where they agree on it
    pictures = [render(result.gaussians, result.cameras).images.clip(0, 1) for result in (fixed, auto)]
    before, after = (np.mean([psnr(*pair) for pair in zip(images, wrong.images, strict=True)]) for images in pictures)
    assert after > before + 1  # over all views: a draft's report is of two


@pytest.mark.slow
def test_a_run_with_right_poses_gives_the_result_of_fixed_poses(scene: Scene) -> None:
    settings = {"fit_steps": 12, "superpixels": "2%"}
    fixed, auto = (compact(scene, **settings, poses=poses) for poses in ("fixed", "auto"))
    np.testing.assert_array_equal(fixed.gaussians.means, auto.gaussians.means)
    np.testing.assert_array_equal(fixed.gaussians.sh0, auto.gaussians.sh0)
    np.testing.assert_array_equal(auto.cameras.viewmats, scene.cameras.viewmats)
