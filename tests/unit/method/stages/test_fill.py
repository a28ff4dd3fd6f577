"""Gaussians are added where cameras between the views see nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import compact
from gsmerge.method.geometry.transforms import is_inside, project, rgb_to_sh0
from gsmerge.method.raster import render
from gsmerge.method.stages.fill import MOST_FILLED_VIEWS, fill_between, lies_between
from gsmerge.types import Cameras, Gaussians


def sheet(left: float, right: float, depth: float, color: float) -> Gaussians:
    """Return a plane across the cameras' axis, from ``left`` to ``right``, of opaque Gaussians."""
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
    """Return two posts before a wall, of which is there what cameras at -0.6 and 0.6 see: nothing behind the slit."""
    wall = [(-4, -1.2), (-0.9, -0.3), (0.3, 0.9), (1.2, 4)]
    parts = [sheet(-0.9, -0.15, 3, 0.8), sheet(0.15, 0.9, 3, 0.8), *(sheet(*span, 6, 0.3) for span in wall)]
    viewmats = np.tile(np.eye(4), (len(centres), 1, 1))
    viewmats[:, 0, 3] = np.negative(centres)
    Ks = np.tile(np.array([[320.0, 0, 160], [0, 320, 120], [0, 0, 1]]), (len(centres), 1, 1))
    return Gaussians.concat(parts), Cameras(viewmats, Ks, 320, 240)


def fill(gaussians: Gaussians, cameras: Cameras, **settings: bool) -> Gaussians:
    """Return what is added where there is room for a tenth as many."""
    return fill_between(gaussians, cameras, None, len(gaussians) // 10, **settings)


def test_what_a_camera_between_views_uncovers_is_filled_behind_what_they_see() -> None:
    before, cameras = slit(-0.6, 0.6)
    between = slit(0.0)[1]
    added = fill(before, cameras)
    after = Gaussians.concat([before, added])
    middle = np.s_[0, 60:180, 150:170, 0]
    assert render(before, between).alphas[middle].mean() < 0.1
    assert render(after, between).alphas[middle].mean() > 0.9
    np.testing.assert_allclose(render(after, cameras).images, render(before, cameras).images, atol=0.06)
    assert (added.means[:, 2] > 3).all()


def test_what_lies_beyond_all_photos_is_filled_only_where_asked() -> None:
    """A wall that ends beside what the outer photos show: a camera beside them sees further."""
    gaussians, cameras = slit(-0.6, 0.6)
    inside, everywhere = fill(gaussians, cameras), fill(gaussians, cameras, beyond=True)

    def shown(some: Gaussians) -> np.ndarray:
        pixels, depths = project(some.means, cameras)
        return ((depths > 0) & is_inside(pixels, cameras)).any(0)

    assert shown(inside).all()
    assert len(everywhere) > len(inside) > 50
    assert not shown(everywhere).all()


def test_only_what_is_enclosed_is_filled() -> None:
    """A wall that ends behind a post has nothing on its other side that it could go on to."""
    whole, cameras = slit(-0.6, 0.6)
    right_of_it = whole[whole.means[:, 0] < 0.2]  # neither the right post nor the wall behind and beside it
    assert len(fill(whole, cameras)) > 50
    new = fill(right_of_it, cameras)
    assert not (new.means[:, 0] > 0.2).any()


def test_pixels_between_known_ones_of_a_row_or_column_lie_between() -> None:
    known = np.zeros((5, 7), bool)
    known[2, 1] = known[2, 4] = known[0, 6] = known[3, 6] = True
    expected = np.zeros((5, 7), bool)
    expected[2, 1:5] = expected[:4, 6] = True
    np.testing.assert_array_equal(lies_between(known), expected)


def test_views_that_look_elsewhere_have_nothing_between_them() -> None:
    """Half-way between views turned by a right angle nobody knows what is there."""
    gaussians, cameras = slit(-0.6, 0.6)
    turn = np.array([[0.0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    apart = replace(cameras, viewmats=np.stack([cameras.viewmats[0], turn @ cameras.viewmats[1]]))
    assert len(fill(gaussians, apart)) == 0


def test_cameras_between_do_not_fill_the_same_twice() -> None:
    new = fill(*slit(-0.6, -0.2, 0.2, 0.6))
    apart = np.linalg.norm(new.means[:, None] - new.means, axis=2) + np.diag(np.full(len(new), np.inf))
    assert len(new) > 50
    assert np.median(apart.min(1) / new.scales[:, 0]) > 1


@pytest.mark.parametrize("most", [0, 7])
def test_no_more_gaussians_are_filled_in_than_there_is_room_for(most: int) -> None:
    assert len(fill_between(*slit(-0.6, 0.6), None, most)) == most


def test_what_each_view_shows_as_empty_stays_empty() -> None:
    assert len(fill(sheet(-0.4, 0.4, 3, 0.8), slit(-0.6, 0.0, 0.6)[1])) == 0


@pytest.mark.parametrize("count", [1, MOST_FILLED_VIEWS + 1])
def test_scenes_of_one_or_very_many_views_are_not_filled(count: int) -> None:
    assert len(fill(*slit(*np.linspace(-0.6, 0.6, count)))) == 0


@pytest.mark.slow
def test_a_result_that_keeps_all_gaussians_is_filled_as_others_are() -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24), noise=0.01)
    usual, whole = (compact(scene, new_views=False, **more).report for more in ({}, {"min_contribution": 0.0}))
    assert whole.options["min_contribution"] == 0 < usual.options["min_contribution"]
    assert "fill" in usual.seconds
    assert "fill" in whole.seconds
