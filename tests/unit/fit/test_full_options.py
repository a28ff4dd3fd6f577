"""The full fit follows masks, drops Gaussians out, and moves cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from sweeps import sweep

from gsmerge import Gaussians, Scene
from gsmerge.fit import FitJob, FitOptions
from gsmerge.fit.fit_state import start_state
from gsmerge.fit.full import fit_full
from gsmerge.fit.schedule import DROPOUT, FEW_VIEWS, MANY_STEPS, Schedule, prepare_fit
from gsmerge.fit.steps import make_optimiser, start_poses
from gsmerge.geometry.transforms import motion_matrices, motion_vectors, project_points
from gsmerge.raster import tile_view
from gsmerge.raster.composite import blend, view_colors
from gsmerge.raster.gradient import gradients_of
from gsmerge.raster.photos import Photos
from gsmerge.settings.fit import GROW_STEPS, LONG_STEPS, USUAL_SHARE, Tuning


@sweep("coarse", [0.5, 1.0])
def test_a_fit_ignores_what_masks_leave_out(coarse: float, scene: Scene, truth: Gaussians) -> None:
    """Rubbish on the left third of every photo; at both sizes, and at half size alone."""
    start = scenes.spoil(truth)
    options = FitOptions(fit_steps=40, holdout=0.2, half_res_share=coarse, dropout=0.0)

    def spoilt(photos: Photos) -> Photos:
        images = photos.images.copy()
        images[:, :, : photos.width // 3] = (1, 0, 1)
        return replace(photos, images=images)

    rubbish = tuple(map(spoilt, scenes.pair_of(scene)))
    masks = tuple(np.ones(photos.images.shape[:3], np.float32) for photos in rubbish)
    for mask in masks:
        mask[:, :, : mask.shape[2] // 3] = 0
    whole, _ = fit_full(start, scenes.run_for(rubbish, options))
    weighed, even = (
        tuple(replace(photos, weights=np.maximum(mask, least)) for photos, mask in zip(rubbish, masks, strict=True))
        for least in np.array([0, 1], np.float32)
    )
    masked, report = fit_full(start, scenes.run_for(weighed, options))
    again, _ = fit_full(start, scenes.run_for(even, options))
    assert report.accepted
    assert scenes.psnr_of(masked, scene) > scenes.psnr_of(whole, scene) + 2  # dB: the rubbish is not learnt
    assert np.array_equal(again.means, whole.means)


QUICK = FitOptions(fit_steps=30, holdout=0.2)
LONG = FitOptions(fit_steps=160, holdout=0.2)


def test_dropout_is_used_where_there_are_few_views(photos: tuple[Photos, Photos]) -> None:
    many = Photos(*(np.concatenate([a, a]) for a in (photos[0].images, photos[0].viewmats, photos[0].Ks)), eps2d=0.3)
    pair = many, replace(photos[1], images=np.concatenate([photos[1].images] * 2))
    assert len(photos[0]) <= FEW_VIEWS < len(many)
    assert prepare_fit(FitJob(photos, LONG)).dropout == DROPOUT > 0
    assert prepare_fit(FitJob(photos, replace(LONG, fit_steps=MANY_STEPS - 1))).dropout == 0
    assert prepare_fit(FitJob(pair, LONG)).dropout == 0
    assert prepare_fit(FitJob(pair, replace(LONG, dropout=0.15))).dropout == 0.15
    assert prepare_fit(FitJob(photos, replace(LONG, dropout=0.0))).dropout == 0
    very_long = replace(LONG, fit_steps=LONG_STEPS)
    assert 0 < prepare_fit(FitJob(pair, very_long)).dropout < prepare_fit(FitJob(photos, very_long)).dropout


def test_shorter_runs_have_more_steps_on_half_size_photos() -> None:
    parts = [FitOptions(fit_steps=steps).half_res_part for steps in (10, 60, GROW_STEPS, 1000)]
    assert 1 == parts[0] > parts[1] == parts[2] > parts[3]
    assert replace(LONG, half_res_share=0.9).half_res_part == 0.9


def test_more_gaussians_have_fewer_steps_on_half_size_photos() -> None:
    parts = [replace(LONG, share=share).half_res_part for share in (0.01, USUAL_SHARE, 2 * USUAL_SHARE, 0.2)]
    assert parts[0] == parts[1] == LONG.half_res_part
    assert parts[1] > parts[2] > parts[3] > 0.3
    short = replace(QUICK, share=0.2)
    assert short.half_res_part == QUICK.half_res_part
    assert replace(LONG, share=0.2, half_res_share=0.9).half_res_part == 0.9


def test_dropout_leaves_its_share_of_gaussians_out_of_a_step(truth: Gaussians, photos: tuple[Photos, Photos]) -> None:
    """What is left out learns nothing from the step."""
    moved = []
    for share in (0.0, 0.5):
        state, run = start_state(truth), scenes.run_for(photos, replace(QUICK, dropout=share))
        make_optimiser(run).step(state, Schedule(run).draw(1, 0.0, len(truth)))
        moved.append(state.m.any(1).mean())
    assert moved[0] > 0.6
    assert moved[1] == pytest.approx(0.5 * moved[0], abs=0.1)


Pair = tuple[Photos, Photos]
FREE = FitOptions(fit_steps=120, holdout=0.2, move_cameras=True, dropout=0.0)


def spoil_poses(photos: Pair, size: float = 0.01) -> Pair:
    """Return photos whose poses are off; the mean of the motions is none."""
    motions = np.random.default_rng(0).normal(size=(len(photos[0]), 6)) * size
    viewmats = photos[0].viewmats @ motion_matrices(motions - motions.mean(0))
    return replace(photos[0], viewmats=viewmats), replace(photos[1], viewmats=viewmats)


def squared_error(truth: Gaussians, photos: Photos, view: int) -> tuple[float, np.ndarray]:
    """Return the squared error of a view, and its gradient by the viewmat."""
    drawn = tile_view(start_state(truth).splats, **photos.camera(view))
    colors = view_colors(drawn)
    image, left = blend(drawn, colors, np.zeros(3, np.float32))
    residual = image - photos.images[view]
    wanted = gradients_of(drawn, colors, image, left, 2 * residual, None, with_viewmat=True).viewmat
    return float((residual**2).sum()), wanted


@pytest.mark.parametrize("view", [0, 1])
def test_steps_of_a_pose_lower_the_loss(view: int, truth: Gaussians, photos: Pair) -> None:
    poses, (full, _) = start_poses(spoil_poses(photos))
    before = squared_error(truth, full, view)[0]
    rates = Tuning(poses_lr=0.1)
    for _ in range(10):
        poses.step(view, squared_error(truth, full, view)[1], rates, 0.0)
    assert squared_error(truth, full, view)[0] < 0.9 * before
    np.testing.assert_allclose(poses.x.mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(motion_vectors(poses.start, poses.viewmats), poses.x, atol=1e-9)


def test_a_fit_that_moves_cameras_finds_their_poses(truth: Gaussians, photos: Pair) -> None:
    wrong, start = spoil_poses(photos), scenes.spoil(truth)
    free, report = fit_full(start, scenes.run_for(wrong, FREE))
    fixed, other = fit_full(start, scenes.run_for(wrong, replace(FREE, move_cameras=False)))
    assert other.viewmats is None
    pixels = [project_points(truth.means, one, photos[0].Ks)[0] for one in (
        photos[0].viewmats, wrong[0].viewmats, report.viewmats,
    )]  # fmt: skip
    before, after = (float(np.median(np.linalg.norm(one - pixels[0], axis=-1))) for one in pixels[1:])
    assert after < 0.5 * before
    assert report.holdout_after > other.holdout_after + 0.5  # dB
    np.testing.assert_allclose(motion_vectors(wrong[0].viewmats, report.viewmats).mean(0), 0, atol=1e-9)
    assert len(free) == len(fixed)
