"""Exposure, flat and noisy pictures, shine and motion do little harm (stability.md, cases 29 to 31, 40, 54)."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import scenes
from sweeps import sweep

from gsmerge import Gaussians, Scene, render
from gsmerge.types import SH_C0

compacted = partial(scenes.compacted, poses="fixed")


def novel_psnr(gaussians: Gaussians, surfaces: list[scenes.Surface], start: float = -0.25) -> float:
    return scenes.psnr_of(gaussians, scenes.make_scene(surfaces, scenes.arc(1, start=start)))


def painted(scene: Scene, images: np.ndarray) -> Scene:
    """Return the scene with other photos, and Gaussians of their colours."""
    sh0 = ((images.reshape(-1, 1, 3) - 0.5) / SH_C0).astype(np.float32)
    return replace(scene, images=images.astype(np.float32), gaussians=replace(scene.gaussians, sh0=sh0))


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(4), noise=0.005)


# 29: exposure


def test_fit_evens_out_the_exposure_of_photos_and_gaussians(room: Scene) -> None:
    factors = np.array([0.8, 1.2, 1 / 1.2, 1.25], np.float32)[:, None, None, None]
    scene = painted(room, 0.8 * room.images * factors)
    surfaces = [scenes.Surface(s.shape, lambda p, s=s: 0.8 * s.texture(p)) for s in scenes.room()]
    before = novel_psnr(compacted(scene, fit="none").gaussians, surfaces)
    assert novel_psnr(compacted(scene, fit_steps=60).gaussians, surfaces) > before + 1.5


# 30, 31: nothing to see, and too much


@sweep("grey", [0.0, 0.5, 1.0], ids=["black", "grey", "white"])
@sweep("segmentation", ["rdseg", "bass-st"])
def test_flat_photos_are_shown_in_their_colour(room: Scene, grey: float, segmentation: str) -> None:
    flat = painted(room, np.full_like(room.images, grey))
    result = compacted(flat, segmentation=segmentation, superpixels=60, fit_steps=10)
    assert 1 <= len(result.gaussians) <= 4 * 60
    assert result.report.psnr_after is None
    assert "one flat colour" in (result.report.worse or "")
    drawn = np.asarray(render(result.gaussians, room.cameras).images).clip(0, 1)
    assert np.square(drawn - np.float32(grey)).mean() < 10**-2.5


@sweep("segmentation", ["rdseg", "bass-st"])
def test_photos_of_noise_make_few_gaussians(room: Scene, segmentation: str) -> None:
    noise = np.random.default_rng(0).random(room.images.shape, np.float32)
    result = compacted(painted(room, noise), segmentation=segmentation, superpixels=60, fit_steps=10)
    assert len(result.gaussians) <= 4 * 60


# 40: view-dependent colour


def shiny(scene: Scene, strength: float) -> Scene:
    """Return the scene with the same strong harmonics of degree 3 everywhere, and photos rendered from them."""
    coefficients = np.random.default_rng(1).normal(0, strength, (1, 15, 3)).astype(np.float32)
    shN = coefficients.repeat(len(scene.gaussians), 0)
    made = replace(scene, gaussians=replace(scene.gaussians, shN=shN))
    images = scenes.images_of(made.gaussians, scene.cameras)[0].clip(0, 1)
    return replace(made, images=images.astype(np.float32))


@sweep("settings", [{"fit_steps": 10}, {}, {"fit": "none"}, {"k": 2}])
def test_strong_harmonics_stay_in_the_result(room: Scene, settings: dict) -> None:
    scene = shiny(room, 0.3)
    actual = compacted(scene, **settings).gaussians
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
    result, usual = (compacted(s, fit="none") for s in (offset, scene))
    assert result.report.psnr_after > usual.report.psnr_after - 1.0  # type: ignore[operator]
    full = compacted(offset, fit_steps=30)
    assert full.report.choices["fit"]["method"] == "full"
    assert full.report.psnr_after > result.report.psnr_after + 1.0  # type: ignore[operator]


# 54: something that moves


def test_passer_by_in_one_view_does_not_show_in_the_others(room: Scene) -> None:
    """A red patch in the photo of view 1 and on its Gaussians."""
    images = room.images.copy()
    images[1, 10:24, 14:28] = [1.0, 0.0, 0.0]
    haunted, clean = (compacted(scene, fit_steps=40).gaussians for scene in (painted(room, images), room))
    others = room.cameras[[0, 2, 3]]
    a, b = (scenes.images_of(g, others)[0].clip(0, 1) for g in (haunted, clean))
    ghost = np.abs(a - b)[:, 8:28, 10:34].mean()
    unfitted = compacted(painted(room, images), fit="none").gaussians
    assert ghost <= 0.1
    before = np.abs(scenes.images_of(unfitted, others)[0].clip(0, 1) - b)[:, 8:28, 10:34].mean()
    assert ghost <= before + 0.01
