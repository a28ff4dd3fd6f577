"""Cameras of a scene without cameras stand where its viewer stands, if it was made around one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import compact, render
from gsmerge.method.geometry.transforms import rgb_to_sh0
from gsmerge.method.kernels.elementary import cos, sin
from gsmerge.method.raster.metrics import psnr
from gsmerge.method.viewpoints.place_cameras import add_views, place_inside, place_viewpoints
from gsmerge.runtime.record import record_run
from gsmerge.types import NO_CAMERAS, Cameras, Gaussians, make_scene

PLACE = np.array([3.0, -2.0, 5.0])


def scene_around(share: float = 1.0, power: float = 1.0, count: int = 6000) -> Gaussians:
    """Make Gaussians in directions from a place, down to a height that leaves a ``share`` of them; sky and near ground.

    Sizes grow with the distance to a ``power``.
    """
    i = np.arange(count) + 0.5
    heights, angles = 1 - 2 * share * i / count, np.pi * (1 + 5**0.5) * i
    radii = np.sqrt(1 - heights**2)
    directions = np.stack([radii * cos(angles), -heights, radii * sin(angles)], 1)
    distances = np.where(heights > 0, 200.0, np.minimum(1.6 / np.maximum(-heights, 1e-3), 60.0))
    sizes = 0.01 * (distances if power else 1.0) * np.random.default_rng(0).uniform(0.8, 1.25, count)
    quats = np.tile(np.float32([1, 0, 0, 0]), (count, 1))
    scales = np.repeat(sizes[:, None], 3, 1).astype(np.float32)
    sh0 = np.random.default_rng(1).normal(0, 0.5, (count, 1, 3)).astype(np.float32)
    means = (PLACE + distances[:, None] * directions).astype(np.float32)
    return Gaussians(means, quats, scales, np.full(count, 0.9, np.float32), sh0, np.zeros((count, 0, 3), np.float32))


def test_cameras_look_to_all_sides_from_near_the_place_of_the_viewer() -> None:
    cameras = place_inside(scene_around())
    assert np.linalg.norm(cameras.centres - PLACE, axis=1).max() < 0.5  # what is nearest is 1.6 away
    forward = cameras.viewmats[:, 2, :3]
    assert np.linalg.norm(forward.mean(0)) < 0.1
    assert (place_viewpoints(scene_around()).viewmats == cameras.viewmats).all()


@pytest.mark.parametrize(
    ("share", "power"), [(0.3, 1.0), (1.0, 0.0)], ids=["a part of the directions", "sizes of one object"]
)
def test_no_cameras_are_placed_inside_other_scenes(share: float, power: float) -> None:
    assert place_inside(scene_around(share, power)) is None


def test_outliers_do_not_move_the_place() -> None:
    gaussians = scene_around()
    means = gaussians.means.copy()
    means[::20] += np.random.default_rng(2).normal(0, 500, (len(means[::20]), 3)).astype(np.float32)
    cameras = place_inside(Gaussians(**{**vars(gaussians), "means": means}))
    assert np.linalg.norm(cameras.centres - PLACE, axis=1).max() < 0.6


def test_placing_cameras_inside_is_noted_once() -> None:
    with record_run() as record:
        assert len(add_views(make_scene(scene_around(), NO_CAMERAS))) == 24
    assert len(record.notes) == 1
    assert "around a viewer" in record.notes[0]


@pytest.mark.slow
def test_a_result_looks_from_the_inside_of_a_world_as_the_world_does() -> None:
    world = scene_around(count=40_000)
    colors = scenes.waves(3, 1.0)((world.means - PLACE) / np.linalg.norm(world.means - PLACE, axis=1, keepdims=True))
    world = replace(world, sh0=rgb_to_sh0(colors[:, None].astype(np.float32)))
    result = compact(make_scene(world, NO_CAMERAS), budget="15%").gaussians
    eye, angles = PLACE + np.array([0.1, 0.05, -0.1]), np.arange(6.0)
    sights = PLACE + np.stack([cos(angles), 0.3 * sin(2 * angles), sin(angles)], 1)
    viewmats = np.stack([scenes.look_at(eye, sight) for sight in sights])
    cameras = Cameras(viewmats, scenes.intrinsics(6, 64, 64), 64, 64)
    psnrs = [psnr(*pair) for pair in zip(*(render(each, cameras).images for each in (world, result)), strict=True)]
    assert min(psnrs) > 46


def test_half_of_the_viewpoints_stand_around_the_scene() -> None:
    """So that an object is seen whole: a ball, whose inside shows as much of it."""
    rng, count = np.random.default_rng(0), 3000
    means = rng.normal(size=(count, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    quats, sh0 = np.tile([1.0, 0, 0, 0], (count, 1)), rng.normal(0, 0.5, (count, 1, 3))
    scales, opacities = np.full((count, 3), 0.03), np.full(count, 0.9)
    arrays = [array.astype(np.float32) for array in (means, quats, scales, opacities, sh0, np.zeros((count, 0, 3)))]
    ball = Gaussians(*arrays)
    cameras = place_viewpoints(ball)
    alphas = render(ball, cameras[: len(cameras) // 2]).alphas[..., 0]
    assert max(alphas[:, [0, -1]].max(), alphas[:, :, [0, -1]].max()) < 0.1
    assert (alphas.mean((1, 2)) > 0.2).all()
