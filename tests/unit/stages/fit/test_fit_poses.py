"""The full fit moves cameras where it may, by a gradient that lowers the loss."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import Gaussians
from gsmerge.geometry import motion_matrices, motion_vectors, project_points
from gsmerge.render import plan_view
from gsmerge.render.composite import blend, view_colors
from gsmerge.render.gradient import gradients_of
from gsmerge.render.photos import Photos
from gsmerge.stages.fit import FitOptions
from gsmerge.stages.fit.fit_options import Tuning
from gsmerge.stages.fit.fit_state import start_state
from gsmerge.stages.fit.full import NO_LOSS, fit_full, start_poses

Pair = tuple[Photos, Photos]
FREE = FitOptions(fit_steps=120, holdout=0.2, move_cameras=True, dropout=0.0)


def spoil(photos: Pair, size: float = 0.01) -> Pair:
    """Photos whose poses are off; the mean of the motions is none."""
    motions = np.random.default_rng(0).normal(size=(len(photos[0]), 6)) * size
    viewmats = photos[0].viewmats @ motion_matrices(motions - motions.mean(0))
    return replace(photos[0], viewmats=viewmats), replace(photos[1], viewmats=viewmats)


def squared_error(truth: Gaussians, photos: Photos, view: int) -> tuple[float, np.ndarray]:
    """Of a view, and its gradient by the viewmat."""
    drawn = plan_view(start_state(truth).splats, **photos.camera(view))
    colors = view_colors(drawn)
    image, left = blend(drawn, colors, np.zeros(3, np.float32))
    residual = image - photos.images[view]
    wanted = gradients_of(drawn, colors, image, left, 2 * residual, NO_LOSS, with_viewmat=True).viewmat
    assert wanted is not None
    return float((residual**2).sum()), wanted


@pytest.mark.parametrize("view", [0, 1])
def test_steps_of_a_pose_lower_the_loss(view: int, truth: Gaussians, photos: Pair) -> None:
    poses, (full, _) = start_poses(spoil(photos))
    before = squared_error(truth, full, view)[0]
    rates = Tuning(poses_lr=0.1)
    for _ in range(10):
        poses.step(view, squared_error(truth, full, view)[1], rates, 0.0)
    assert squared_error(truth, full, view)[0] < 0.9 * before
    np.testing.assert_allclose(poses.x.mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(motion_vectors(poses.start, poses.viewmats), poses.x, atol=1e-9)


def test_the_fit_finds_the_cameras(truth: Gaussians, photos: Pair) -> None:
    wrong, start = spoil(photos), scenes.spoil(truth)
    free, report = fit_full(start, wrong, FREE)
    fixed, other = fit_full(start, wrong, replace(FREE, move_cameras=False))
    assert other.viewmats is None
    assert report.viewmats is not None
    pixels = [project_points(truth.means, one, photos[0].Ks)[0] for one in (
        photos[0].viewmats, wrong[0].viewmats, report.viewmats,
    )]  # fmt: skip
    before, after = (float(np.median(np.linalg.norm(one - pixels[0], axis=-1))) for one in pixels[1:])
    assert after < 0.5 * before
    assert report.holdout_after > other.holdout_after + 0.5
    np.testing.assert_allclose(motion_vectors(wrong[0].viewmats, report.viewmats).mean(0), 0, atol=1e-9)
    assert len(free) == len(fixed)
