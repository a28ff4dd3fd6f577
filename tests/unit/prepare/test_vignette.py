"""Photos that end in a dark ring are divided by the light that the surfaces which they share show; others stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import Scene
from gsmerge.method.geometry.frame import canonicalise
from gsmerge.method.geometry.transforms import rgb_to_sh0, sh0_to_rgb
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.prepare.true_pixels import with_pixels
from gsmerge.prepare.vignette import BLACK, divide_by_vignette
from gsmerge.settings.stages import PrepareOptions
from gsmerge.types import PicturedScene

VIEWS, WIDTH, HEIGHT = 6, 120, 90


@pytest.fixture(scope="module")
def room() -> Scene:
    return canonicalise(scenes.make_scene(scenes.room(), scenes.arc(VIEWS, WIDTH, HEIGHT)))[0]


def falloff(reach: float, power: float = 4.0) -> np.ndarray:
    """Return light ``[h,w]`` that falls to 0 at ``reach`` half pictures from the middle."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    radius = np.sqrt((2 * x / WIDTH - 1) ** 2 + (2 * y / HEIGHT - 1) ** 2)
    return np.asarray((1 - (radius / reach) ** power).clip(0, 1), np.float32)


def darkened(room: Scene, light: np.ndarray) -> PicturedScene:
    """Return the scene as a model makes it of photos with this light: each row has the colour of its pixel."""
    images = room.images * light[..., None]
    rows = replace(room.gaussians, sh0=rgb_to_sh0(images.reshape(-1, 1, 3)))
    return PicturedScene.with_pictures(with_pixels(replace(room, gaussians=rows, images=images)), images, room.masks)


def test_photos_and_gaussians_are_divided_by_the_light_of_a_ring(room: Scene) -> None:
    light = falloff(1.35)
    scene, black, change = divide_by_vignette(darkened(room, light))
    assert black is not None
    bright = light > 0.5
    before = np.abs(room.images * light[..., None] - room.images)[:, bright].mean()
    after = np.abs(scene.images - room.images)[:, bright].mean()
    assert after < before / 3
    assert "dark ring" in change
    assert len(scene.gaussians) == len(room.gaussians) - black.sum()
    assert not scene.masks[black].any()
    colors = sh0_to_rgb(scene.gaussians.sh0[:, 0]).clip(0, 1)
    np.testing.assert_allclose(colors, scene.images[~black], atol=1e-4)


def test_what_is_nearly_black_is_left_out(room: Scene) -> None:
    scene, black, change = divide_by_vignette(darkened(room, falloff(1.1)))
    assert black is not None
    assert black[:, falloff(1.1) < BLACK / 4].mean() > 0.9
    assert "left out" in change
    assert scene.masks[:, falloff(1.1) > 0.5].all()


@pytest.mark.parametrize("reach", [np.inf, 1.9])
def test_the_falloff_of_a_lens_stays(room: Scene, reach: float) -> None:
    scene = darkened(room, falloff(reach))
    same, black, change = divide_by_vignette(scene)
    assert same is scene
    assert black is None
    assert change == ""


def test_a_ring_of_the_scene_that_moves_in_the_photos_stays(room: Scene) -> None:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    images = room.images.copy()
    for view, image in enumerate(images):  # a dark frame in the room, at another place in each photo
        image[(x < 8 + 4 * view) | (y < 6 + 2 * view)] *= 0.2
    scene = darkened(replace(room, images=images), np.ones((HEIGHT, WIDTH), np.float32))
    assert divide_by_vignette(scene)[1] is None


def test_dark_corners_without_shared_surfaces_are_no_ring(room: Scene) -> None:
    light = np.ones((HEIGHT, WIDTH), np.float32)
    light[:30, :30] = 0.1  # one dark corner is no falloff that is the same on all sides
    assert divide_by_vignette(darkened(room, light))[1] is None


def test_the_step_keeps_the_photos_if_it_is_asked_to(room: Scene) -> None:
    scene = darkened(room, falloff(1.35))
    done = prepare(scene, PrepareOptions())
    assert any("dark ring" in change for change in done.changes)
    kept = prepare(scene, PrepareOptions(look="photos"))
    assert not any("dark ring" in change for change in kept.changes)
