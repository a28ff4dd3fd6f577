"""The paper's visibility mask is that of one loop over all samples."""

from __future__ import annotations

import numpy as np
import pytest
import scenes

from gsmerge.method.geometry.views import resize_cameras, subset
from gsmerge.scoring import visibility
from gsmerge.scoring.visibility import context_points, visible_pixels
from gsmerge.types import Cameras, Scene


def slow_mask(points: np.ndarray, cameras: Cameras, view: int) -> np.ndarray:
    mask = np.zeros((cameras.height, cameras.width), bool)
    for point in points:
        x, y, z = cameras.Ks[view] @ (cameras.viewmats[view] @ np.append(point, 1))[:3]
        if z <= 0.01:
            continue
        column, row = int(np.floor(x / z)), int(np.floor(y / z))
        if 0 <= column < cameras.width and 0 <= row < cameras.height:
            mask[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = True
    return mask


@pytest.mark.parametrize("rows", [100, 1 << 18])
def test_visible_pixels_are_those_of_a_slow_loop(rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(visibility, "_CHUNK", rows)
    scene = scenes.make_scene(scenes.two_planes(), scenes.arc(2, 24, 18))
    held_out = scenes.arc(3, 24, 18, span=3.0)
    points = context_points(scene, 0.01)
    for cameras in (held_out, scene.cameras):  # the latter are full as soon as their own points are in
        masks = visible_pixels(points, cameras, 0.01)
        for view in range(len(cameras)):
            assert np.array_equal(masks[view], slow_mask(points, cameras, view))
        assert (0.2 < masks[0].mean() < 0.9) == (cameras is held_out)


@pytest.mark.parametrize("factor", [2, 3, 5, 8])
def test_larger_pictures_have_no_gaps_between_samples(factor: int) -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(1, 24, 18))
    points, cameras = context_points(scene, 0.01), scene.cameras
    large = resize_cameras(cameras, 24 * factor, 18 * factor)
    assert visible_pixels(points, large, 0.01, cameras).all()
    assert not visible_pixels(points, large, 0.01).all() or factor < 4
    small = resize_cameras(cameras, 12, 9)
    assert np.array_equal(visible_pixels(points, small, 0.01, cameras), visible_pixels(points, small, 0.01))


def test_pixels_without_a_gaussian_give_no_sample() -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(1, 24, 18))
    valid = scene.pixels.shown.copy()
    valid[0, :, 12:] = False
    masks = visible_pixels(context_points(scenes.shown_in(scene, valid), 0.01), scene.cameras, 0.01)
    assert masks[0, :, :13].all()  # a column more than there are samples: every sample marks its neighbours
    assert not masks[0, :, 13:].any()


def test_points_behind_the_camera_are_not_visible() -> None:
    camera = scenes.arc(1, 24, 18)
    behind = np.linalg.inv(camera.viewmats[0])[:3] @ np.array([0, 0, -2.0, 1.0])
    assert not visible_pixels(behind[None], camera, 0.01).any()


def test_a_scene_in_no_order_is_sampled_by_its_rendered_depth() -> None:
    scene = scenes.make_scene(scenes.wall(), scenes.arc(2, 32, 24), opacity=(0.95, 0.99))
    unaligned = Scene(scene.gaussians, scene.cameras, None, None, scene.names)
    points = context_points(unaligned, 0.01)
    assert len(points) > 0.9 * len(scene.gaussians)
    assert np.abs(points[:, 2] - 3.0).max() < 0.1  # the wall is at z = 3
    held_out = scenes.arc(1, 32, 24)
    agree = visible_pixels(points, held_out, 0.01) == visible_pixels(context_points(scene, 0.01), held_out, 0.01)
    assert agree.mean() > 0.98


def test_visible_pixels_are_the_same_far_from_the_origin() -> None:
    shift = np.array([4e5, 5e6, 100.0])
    here = scenes.make_scene(scenes.room(), scenes.arc(3, 24, 18, span=2.0))
    there = scenes.move(here, np.eye(3), 1.0, shift)
    masks = [visible_pixels(context_points(subset(s, [0]), 0.01), s.cameras, 0.01) for s in (here, there)]
    assert (masks[0] == masks[1]).mean() > 0.999  # rounding may move a sample to the next pixel
    assert 0.2 < masks[0][2].mean() < 0.98
