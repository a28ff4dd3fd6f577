"""Blurred photos are left out where sharper ones show the same surfaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import Scene
from gsmerge.method.geometry.frame import canonicalise
from gsmerge.method.geometry.transforms import rgb_to_sh0
from gsmerge.method.kernels.pictures import blur
from gsmerge.prepare.blurred import leave_out_blurred
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.prepare.true_pixels import with_pixels
from gsmerge.types import PicturedScene

VIEWS, WIDTH, HEIGHT = 6, 120, 90
SHAKEN = (1, 4)


@pytest.fixture(scope="module")
def room() -> Scene:
    scene = canonicalise(scenes.make_scene(scenes.room(), scenes.arc(VIEWS, WIDTH, HEIGHT)))[0]
    grain = np.random.default_rng(0).uniform(-0.15, 0.15, (len(scene.gaussians), 1, 1)).astype(np.float32)
    sh0 = scene.gaussians.sh0 + grain
    images = (scene.images + 0.28 * grain.reshape(*scene.images.shape[:3], 1)).clip(0, 1)
    return replace(scene, gaussians=replace(scene.gaussians, sh0=sh0), images=images)


def shaken(room: Scene, *, rows: bool = True, views: tuple[int, ...] = SHAKEN, gain: float = 1.0) -> PicturedScene:
    """Return the scene with blurred photos; with ``rows``, a model made its Gaussians of these photos."""
    images = room.images.copy()
    for view in views:
        images[view] = gain * blur(room.images[view], 2.5)
    scene = replace(room, images=images)
    if rows:
        scene = replace(scene, gaussians=replace(room.gaussians, sh0=rgb_to_sh0(images.reshape(-1, 1, 3))))
    return PicturedScene.with_pictures(with_pixels(scene), images, None)


@pytest.mark.parametrize("gain", [1.0, 0.6])
def test_blurred_photos_are_left_out_with_their_gaussians(room: Scene, gain: float) -> None:
    scene, gone, change = leave_out_blurred(shaken(room, gain=gain))
    assert gone is not None
    assert "2 of 6 photos are blurred" in change
    assert "001.png, 004.png" in change
    assert gone[list(SHAKEN)].mean() > 0.7
    assert not gone[[0, 2, 3, 5]].any()
    assert len(scene.gaussians) == len(room.gaussians) - gone.sum()
    assert not scene.masks[gone].any()


def test_sharp_gaussians_of_blurred_photos_stay(room: Scene) -> None:
    scene, gone, _ = leave_out_blurred(shaken(room, rows=False))
    assert gone is not None
    assert len(scene.gaussians) == len(room.gaussians)


def test_gaussians_that_are_no_pixels_stay(room: Scene) -> None:
    images = shaken(room).images
    points = with_pixels(replace(room, pixels=None, images=images))
    scene, gone, _ = leave_out_blurred(PicturedScene.with_pictures(points, images, None))
    assert gone is not None
    assert len(scene.gaussians) == len(room.gaussians)


@pytest.mark.parametrize("views", [(), (0, 1, 2, 3, 4, 5)])
def test_photos_that_are_equally_sharp_stay(room: Scene, views: tuple[int, ...]) -> None:
    scene = shaken(room, views=views)
    assert leave_out_blurred(scene) == (scene, None, "")


def test_a_run_says_which_photos_are_blurred(room: Scene) -> None:
    assert any("are blurred" in change for change in prepare(shaken(room)).changes)
