"""Exposure, flat and noisy pictures, shine, and what moves (method reference, cases 29 to 31, 40, 54)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from sweeps import sweep

from gsmerge import Gaussians, Scene
from gsmerge.fit import FitOptions
from gsmerge.fit.color import draw, fit_colors
from gsmerge.raster.photos import scene_photos
from gsmerge.types import SH_C0


def novel_psnr(gaussians: Gaussians, surfaces: list[scenes.Surface], start: float = -0.25) -> float:
    camera = scenes.arc(1, start=start)
    truth = scenes.trace(surfaces, camera)[2].reshape(36, 48, 3)
    image = np.clip(scenes.images_of(gaussians, camera)[0][0], 0, 1)
    return float(-10 * np.log10(((image - truth) ** 2).mean()))


def painted(scene: Scene, images: np.ndarray) -> Scene:
    """With other photos, and Gaussians of their colours."""
    sh0 = ((images.reshape(-1, 1, 3) - 0.5) / SH_C0).astype(np.float32)
    return replace(scene, images=images.astype(np.float32), gaussians=replace(scene.gaussians, sh0=sh0))


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(4), noise=0.005)


# 29: exposure


def test_exposure_that_changes_between_views(room: Scene) -> None:
    """The fit compensates; factors with geometric mean one, one merge for both."""
    factors = np.array([0.8, 1.2, 1 / 1.2, 1.25], np.float32)[:, None, None, None]
    merged = scenes.compacted(painted(room, 0.8 * room.images), fit="none").gaussians
    actual = []
    for images in (0.8 * room.images, 0.8 * room.images * factors):
        photos = scene_photos(replace(room, images=images), 2)
        actual.append(fit_colors(merged, draw(merged, photos), photos, FitOptions())[0])
    surfaces = [scenes.Surface(s.shape, lambda p, s=s: 0.8 * s.texture(p)) for s in scenes.room()]
    steady, varied = (novel_psnr(g, surfaces) for g in actual)
    assert steady > novel_psnr(merged, surfaces) + 1
    assert varied > steady - 0.2


def test_exposure_of_photos_and_gaussians(room: Scene) -> None:
    factors = np.array([0.8, 1.2, 1 / 1.2, 1.25], np.float32)[:, None, None, None]
    scene = painted(room, 0.8 * room.images * factors)
    surfaces = [scenes.Surface(s.shape, lambda p, s=s: 0.8 * s.texture(p)) for s in scenes.room()]
    before = novel_psnr(scenes.compacted(scene, fit="none").gaussians, surfaces)
    after = [novel_psnr(scenes.compacted(scene, seed=seed).gaussians, surfaces) for seed in range(3)]
    assert min(after) >= before
    assert np.mean(after) > before + 1.5


# 30, 31: nothing to see, and too much


@sweep("grey", [0.0, 0.5, 1.0])
@sweep("segmentation", ["rdseg", "bass-st"])
def test_flat_pictures(room: Scene, grey: float, segmentation: str) -> None:
    flat = painted(room, np.full_like(room.images, grey))
    result = scenes.compacted(flat, segmentation=segmentation, superpixels=60)
    assert 1 <= len(result.gaussians) <= 4 * 60
    assert result.report.psnr_after > 25  # type: ignore[operator]


@sweep("segmentation", ["rdseg", "bass-st"])
def test_noise_does_not_explode(room: Scene, segmentation: str) -> None:
    noise = np.random.default_rng(0).random(room.images.shape, np.float32)
    result = scenes.compacted(painted(room, noise), segmentation=segmentation, superpixels=60)
    assert len(result.gaussians) <= 4 * 60


# 40: view-dependent colour


def shiny(scene: Scene, strength: float) -> Scene:
    """Degree 3, the same strong harmonics everywhere, photos rendered from the Gaussians."""
    coefficients = np.random.default_rng(1).normal(0, strength, (1, 15, 3)).astype(np.float32)
    shN = coefficients.repeat(len(scene.gaussians), 0)
    made = replace(scene, gaussians=replace(scene.gaussians, shN=shN))
    images = scenes.images_of(made.gaussians, scene.cameras)[0].clip(0, 1)
    return replace(made, images=images.astype(np.float32))


@sweep("settings", [{}, {"fit": "none"}, {"k": 2}], ids=str)
def test_harmonics_survive(room: Scene, settings: dict) -> None:
    scene = shiny(room, 0.3)
    actual = scenes.compacted(scene, **settings).gaussians
    assert actual.sh_degree == 3
    stripped = replace(actual, shN=np.zeros_like(actual.shN))
    assert scenes.psnr_of(actual, scene) > scenes.psnr_of(stripped, scene) + 3


def test_equal_harmonics_stay_equal(room: Scene) -> None:
    scene = shiny(room, 0.3)
    actual = scenes.plain(scene)
    np.testing.assert_allclose(actual.shN, scene.gaussians.shN[:1].repeat(len(actual), 0), atol=1e-5)


def test_base_colours_outside_the_range_are_kept(room: Scene) -> None:
    """A base colour below 0 or above 1 that the harmonics bring back."""
    scene = shiny(room, 0.0)
    sh0 = scene.gaussians.sh0 - 1.5
    shN = scene.gaussians.shN.copy()
    shN[:, 1] = 1.5 * SH_C0 / 0.48860251190292  # z is about 1 towards all views
    offset = replace(scene, gaussians=replace(scene.gaussians, sh0=sh0, shN=shN))
    images = scenes.images_of(offset.gaussians, offset.cameras)[0].clip(0, 1)
    offset = replace(offset, images=images.astype(np.float32))
    result, usual = (scenes.compacted(s, fit="none") for s in (offset, scene))
    assert result.report.psnr_after > usual.report.psnr_after - 1.0  # type: ignore[operator]
    full = scenes.compacted(offset)
    assert full.report.choices["fit"]["method"] == "full"
    assert full.report.psnr_after > result.report.psnr_after + 1.0  # type: ignore[operator]


# 54: something that moves


def test_passer_by_in_one_view_does_not_haunt_the_others(room: Scene) -> None:
    """A red patch in the photo of view 1 and on its Gaussians."""
    images = room.images.copy()
    images[1, 10:24, 14:28] = [1.0, 0.0, 0.0]
    haunted, clean = (scenes.compacted(scene).gaussians for scene in (painted(room, images), room))
    others = room.cameras[[0, 2, 3]]
    a, b = (scenes.images_of(g, others)[0].clip(0, 1) for g in (haunted, clean))
    ghost = np.abs(a - b)[:, 8:28, 10:34].mean()
    unfitted = scenes.compacted(painted(room, images), fit="none").gaussians
    assert ghost <= 0.1
    before = np.abs(scenes.images_of(unfitted, others)[0].clip(0, 1) - b)[:, 8:28, 10:34].mean()
    assert ghost <= before + 0.01
