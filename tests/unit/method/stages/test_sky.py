"""Gaussians of sky are found where photos show one, and nowhere else."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scenes
from messages import noted
from sky_scenes import CEILING, HAZE, HEIGHT, HORIZON, OVERCAST, WIDTH, ZENITH, painted

from gsmerge import compact, render
from gsmerge.method.stages.sky import sky, sky_region, sky_regions

QUICK: dict[str, Any] = {"effort": "draft", "superpixels": 120, "fit_steps": 10, "poses": "fixed"}


@pytest.mark.parametrize(
    ("top", "bottom", "depth"), [(ZENITH, HAZE, 1.0), (ZENITH, HAZE, 8.0), (OVERCAST, OVERCAST, 8.0)]
)
def test_sky_is_found(top: np.ndarray, bottom: np.ndarray, depth: float) -> None:
    scene, rows = painted(top, bottom, depth)
    found = sky(scene.gaussians, scene.cameras, scene.images)
    assert found[rows].mean() > 0.8
    assert found[~rows].mean() < 0.02


@pytest.mark.parametrize(("top", "bottom"), [(CEILING, CEILING), (OVERCAST, OVERCAST), (HAZE, ZENITH)])
def test_ceilings_and_walls_are_not_found_as_sky(top: np.ndarray, bottom: np.ndarray) -> None:
    """Warm white, cold white as near as the rest, and blue that grows paler upwards."""
    scene, _ = painted(top, bottom)
    assert not sky(scene.gaussians, scene.cameras, scene.images).any()


def test_sky_in_one_photo_alone_is_not_believed() -> None:
    scene, _ = painted(ZENITH, HAZE)
    indoors = scenes.make_scene(scenes.room(), scenes.arc(4, WIDTH, HEIGHT)).images
    photos = np.concatenate([scene.images[:1], indoors[1:]])
    assert not sky(scene.gaussians, scene.cameras, photos).any()


def test_region_of_sky_begins_at_the_upper_edge() -> None:
    photo = np.full((HEIGHT, WIDTH, 3), (0.4, 0.3, 0.2), np.float32)
    photo[:20] = ZENITH
    photo[40:60] = ZENITH
    photo[:, : WIDTH // 3] = (0.4, 0.3, 0.2)
    region = sky_region(photo)
    assert region[:16, WIDTH // 3 + 4 :].all()
    assert not region[24:].any()
    assert not region[:, : WIDTH // 3].any()
    noise = np.random.default_rng(0).normal(0, 0.4, (360, 480, 3)).astype(np.float32)
    assert not sky_region((ZENITH + noise).clip(0, 1)).any()  # as leaves in blue light


def test_compact_leaves_out_and_counts_the_sky() -> None:
    scene, _ = painted(ZENITH, HAZE, 4.0)
    whole, without = compact(scene, **QUICK), compact(scene, **QUICK, drop="sky")
    count = without.report.choices["clean"]["sky"]
    assert count > 0.1 * len(whole.gaussians)  # large ones
    assert len(without.gaussians) == len(whole.gaussians) - count
    assert noted(without.report.notes, f"{count:,} sky")
    assert noted(without.report.notes, "PSNR", "errors")
    shown = render(without.gaussians, scene.cameras).alphas[..., 0]
    assert shown[:, : HORIZON - 4].mean() < 0.3
    assert shown[:, HORIZON + 4 :].mean() > 0.9


def test_leaving_out_sky_changes_nothing_indoors() -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(4, WIDTH, HEIGHT))
    whole, same = compact(scene, **QUICK), compact(scene, **QUICK, drop="sky")
    np.testing.assert_array_equal(whole.gaussians.means, same.gaussians.means)
    assert same.report.choices["clean"] == {"sky": 0}


def test_views_that_show_sky_are_found() -> None:
    """For ``inspect``."""
    indoors = scenes.make_scene(scenes.room(), scenes.arc(4, WIDTH, HEIGHT))
    for scene, views in ((painted(ZENITH, HAZE)[0], [0, 1, 2, 3]), (indoors, [])):
        assert list(sky_regions(scene.gaussians.means, scene.cameras, scene.images)) == views
