"""Gaussians for what cameras between the views see empty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsmerge.geometry import rgb_to_sh0
from gsmerge.raster import render
from gsmerge.stages.fill import MOST_VIEWS, fill_between
from gsmerge.types import Cameras, Gaussians


def sheet(left: float, right: float, depth: float, color: float) -> Gaussians:
    """A plane across the cameras' axis, from ``left`` to ``right``, of opaque Gaussians."""
    step = 0.004 * depth
    x, y = np.meshgrid(np.arange(left, right, step), np.arange(-0.5 * depth, 0.5 * depth, step))
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, depth)], 1).astype(np.float32)
    return Gaussians(
        means=means,
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1)),
        scales=np.full((len(means), 3), step, np.float32),
        opacities=np.full(len(means), 0.95, np.float32),
        sh0=rgb_to_sh0(np.full((len(means), 1, 3), color, np.float32)),
        shN=np.zeros((len(means), 0, 3), np.float32),
    )


def slit(*centres: float) -> tuple[Gaussians, Cameras]:
    """Two posts before a wall, of which is there what cameras at -0.6 and 0.6 see: nothing behind the slit."""
    wall = [(-4, -1.2), (-0.9, -0.3), (0.3, 0.9), (1.2, 4)]
    parts = [sheet(-0.9, -0.15, 3, 0.8), sheet(0.15, 0.9, 3, 0.8), *(sheet(*span, 6, 0.3) for span in wall)]
    viewmats = np.tile(np.eye(4), (len(centres), 1, 1))
    viewmats[:, 0, 3] = np.negative(centres)
    Ks = np.tile(np.array([[320.0, 0, 160], [0, 320, 120], [0, 0, 1]]), (len(centres), 1, 1))
    return Gaussians.concat(parts), Cameras(viewmats, Ks, 320, 240)


def with_faint(gaussians: Gaussians) -> Gaussians:
    """The same beside a tenth as many that nobody sees."""
    rows = np.arange(0, len(gaussians), 10)
    faint = replace(gaussians[rows], opacities=np.full(len(rows), 0.001, np.float32))
    return Gaussians.concat([gaussians, faint])


def test_what_a_camera_between_views_uncovers_is_filled_behind_what_they_see() -> None:
    gaussians, cameras = slit(-0.6, 0.6)
    between = slit(0.0)[1]
    before = with_faint(gaussians)
    after = fill_between(before, cameras, None)
    middle = np.s_[0, 60:180, 150:170, 0]
    assert render(before, between).alphas[middle].mean() < 0.1
    assert render(after, between).alphas[middle].mean() > 0.9
    assert len(after) == len(before)
    np.testing.assert_allclose(render(after, cameras).images, render(before, cameras).images, atol=0.06)
    new = after.means[len(gaussians) :][after.opacities[len(gaussians) :] > 0.5]
    assert (new[:, 2] > 3).all()


def test_views_that_look_elsewhere_have_nothing_between_them() -> None:
    """Half-way between views turned by a right angle nobody knows what is there."""
    gaussians, cameras = slit(-0.6, 0.6)
    turn = np.array([[0.0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    apart = replace(cameras, viewmats=np.stack([cameras.viewmats[0], turn @ cameras.viewmats[1]]))
    before = with_faint(gaussians)
    assert fill_between(before, apart, None) is before


def test_cameras_between_do_not_fill_the_same_twice() -> None:
    gaussians, cameras = slit(-0.6, -0.2, 0.2, 0.6)
    new = fill_between(with_faint(gaussians), cameras, None)[len(gaussians) :]
    new = new[new.opacities > 0.5]
    apart = np.linalg.norm(new.means[:, None] - new.means, axis=2) + np.diag(np.full(len(new), np.inf))
    assert len(new) > 50
    assert np.median(apart.min(1) / new.scales[:, 0]) > 1


def test_only_faint_gaussians_make_room() -> None:
    gaussians, cameras = slit(-0.6, 0.6)
    np.testing.assert_array_equal(fill_between(gaussians, cameras, None).means, gaussians.means)


def test_what_each_view_shows_as_empty_stays_empty() -> None:
    post = with_faint(sheet(-0.4, 0.4, 3, 0.8))
    filled = fill_between(post, slit(-0.6, 0.0, 0.6)[1], None)
    np.testing.assert_array_equal(np.sort(filled.opacities), np.sort(post.opacities))


@pytest.mark.parametrize("count", [1, MOST_VIEWS + 1])
def test_one_view_and_very_many_are_not_filled(count: int) -> None:
    gaussians, cameras = slit(*np.linspace(-0.6, 0.6, count))
    before = with_faint(gaussians)
    assert fill_between(before, cameras, None) is before
