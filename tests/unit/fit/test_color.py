from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import Gaussians, Scene
from gsmerge.fit import FitOptions, FitReport
from gsmerge.fit.color import draw, fit_colors
from gsmerge.raster.photos import Photos, scene_photos
from gsmerge.types import SH_C0

FEW = FitOptions(holdout=0.25)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.wall(), scenes.arc(3, 64, 48))


@pytest.fixture(scope="module")
def gaussians(scene: Scene) -> Gaussians:
    return scenes.plain(scene)


@pytest.fixture(scope="module")
def photos(scene: Scene, gaussians: Gaussians) -> Photos:
    """What the Gaussians themselves show: their own colours are the answer."""
    images = scenes.images_of(gaussians, scene.cameras)[0].astype(np.float32)
    return scene_photos(replace(scene, images=images))


def fitted(gaussians: Gaussians, photos: Photos, options: FitOptions = FEW) -> tuple[Gaussians, FitReport]:
    return fit_colors(gaussians, draw(gaussians, photos), photos, options)


def recolored(gaussians: Gaussians, offset: float) -> Gaussians:
    return replace(gaussians, sh0=gaussians.sh0 + offset / SH_C0)


def test_wrong_colours_come_back(gaussians: Gaussians, photos: Photos) -> None:
    noise = 0.1 * np.random.default_rng(0).normal(size=gaussians.sh0.shape).astype(np.float32)
    spoilt = replace(gaussians, sh0=gaussians.sh0 + noise / SH_C0)
    # one patch in twenty is held out
    result, report = fitted(
        spoilt, photos, scenes.tuned(replace(FEW, holdout=0.0125), prior_weight=0.01, iterations=18)
    )
    assert report.accepted
    assert report.holdout_after > report.holdout_before + 6
    error = SH_C0 * (result.sh0 - gaussians.sh0)
    assert (error**2).mean() < 0.1 * (noise**2).mean()


def test_only_base_colours_change(gaussians: Gaussians, photos: Photos) -> None:
    result, report = fitted(recolored(gaussians, 0.1), photos)
    assert report.accepted
    for name in ("means", "quats", "scales", "opacities", "shN"):
        assert np.array_equal(getattr(result, name), getattr(gaussians, name)), name
    assert not np.array_equal(result.sh0, gaussians.sh0)


def test_right_colours_are_kept(gaussians: Gaussians, photos: Photos) -> None:
    result, _ = fitted(gaussians, photos)
    assert float(np.abs(SH_C0 * (result.sh0 - gaussians.sh0)).max()) < 0.02


def test_fit_that_makes_it_worse_is_refused(gaussians: Gaussians, photos: Photos) -> None:
    """Photos of noise: nothing that is learned holds elsewhere."""
    rng = np.random.default_rng(0)
    noise = replace(photos, images=rng.choice([0.0, 1.0], photos.images.shape).astype(np.float32))
    grey = replace(gaussians, sh0=np.zeros_like(gaussians.sh0))
    result, report = fitted(grey, noise, scenes.tuned(FEW, prior_weight=1e-6, iterations=60, huber=10.0))
    assert not report.accepted
    assert report.method == "none"
    assert report.holdout_after <= report.holdout_before
    assert np.array_equal(result.sh0, grey.sh0)


def test_unseen_ones_keep_their_colour(gaussians: Gaussians, photos: Photos) -> None:
    """Also where it is outside the range that the fit keeps to: high harmonics may bring it back."""
    behind = replace(gaussians[:3], means=gaussians.means[:3] - 100, sh0=np.full((3, 1, 3), 4.0, np.float32))
    behind.sh0[1] = -4.0
    result, report = fitted(recolored(Gaussians.concat([gaussians, behind]), 0.05), photos)
    assert report.accepted
    np.testing.assert_allclose(result.sh0[-3:], behind.sh0 + 0.05 / SH_C0, rtol=1e-5)


def test_colours_stay_near_the_range(gaussians: Gaussians, photos: Photos) -> None:
    extreme = replace(photos, images=np.where(photos.images > 0.5, np.float32(1), np.float32(0)))
    result, _ = fitted(gaussians, extreme)
    colors = 0.5 + SH_C0 * result.sh0
    assert float(colors.min()) >= -0.0501
    assert float(colors.max()) <= 1.0501


def test_exposure_of_one_view_does_not_bake_in(gaussians: Gaussians, photos: Photos) -> None:
    images = photos.images.copy()
    images[1] *= 0.8
    dark, _ = fitted(recolored(gaussians, 0.1), replace(photos, images=images))
    plain, _ = fitted(recolored(gaussians, 0.1), photos)
    ratio = (0.5 + SH_C0 * dark.sh0).mean() / (0.5 + SH_C0 * plain.sh0).mean()
    assert float(ratio) == pytest.approx(0.8 ** (1 / 3), abs=0.02)  # gains have geometric mean one


def test_pull_holds_the_colours(gaussians: Gaussians, photos: Photos) -> None:
    start = recolored(gaussians, 0.1)
    moves = []
    for prior_weight in (0.01, 1.0, 100.0):
        result, _ = fitted(start, photos, scenes.tuned(FEW, prior_weight=prior_weight))
        moves.append(float(np.abs(SH_C0 * (result.sh0 - start.sh0)).mean()))
    assert moves[0] > moves[1] > moves[2]
    assert moves[2] < 0.005


@pytest.mark.parametrize("size", [(8, 6), (32, 24), (40, 40)])
def test_small_photos_still_have_a_held_out_patch(size: tuple[int, int]) -> None:
    """Whatever the seed draws, acceptance must rest on some pixel."""
    scene = scenes.make_scene(scenes.wall(), scenes.arc(2, *size))
    photos = scene_photos(scene)
    spoilt = recolored(scene.gaussians, 0.2)
    drawn = draw(spoilt, photos)
    for seed in range(4):
        _, report = fit_colors(spoilt, drawn, photos, FitOptions(), seed)
        assert report.accepted
        assert report.holdout_before < 40
