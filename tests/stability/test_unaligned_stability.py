"""Gaussians in no order may lack finite values, views, photos, cameras, or anything to see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
import unaligned_scenes
from messages import noted, refuses
from sweeps import sweep

from gsmerge import Gaussians, Scene, compact, render
from gsmerge.results.result import CompactResult
from gsmerge.types import NO_CAMERAS, make_scene


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(4, 40, 30), noise=0.005)


def compacted(scene: Scene, **settings: Any) -> CompactResult:
    """Compact to a tenth of the pixels, and check what must hold of every result."""
    result = compact(scene, **{"superpixels": "10%", "fit_steps": 10, **settings})
    for name in scenes.FIELDS:
        assert np.isfinite(getattr(result.gaussians, name)).all(), name
    assert 0 < len(result.gaussians) <= max(len(scene.gaussians), 1)
    assert (result.report.num_input, result.report.num_output) == (len(scene.gaussians), len(result.gaussians))
    return result


SETTINGS = [
    {}, {"budget": 150}, {"k": 2}, {"fit": "none"}, {"budget": 150, "fit_steps": 160}, {"budget": "auto"},
    {"match": "none"}, {"match": "aabb"}, {"budget": "12KB"},
]  # fmt: skip


@sweep("settings", SETTINGS, often=2)
def test_every_setting_reaches_the_floor(room: Scene, settings: dict, floor: Callable[..., None]) -> None:
    result = compacted(unaligned_scenes.shuffled(room), **settings)
    if settings.get("budget") == 150:
        assert len(result.gaussians) == 150
    if not {"fit", "fit_steps"} & settings.keys():
        floor(scenes.psnr_of(result.gaussians, room))


def test_rows_that_are_not_finite_cost_less_than_a_decibel(room: Scene) -> None:
    g = unaligned_scenes.shuffled(room).gaussians
    columns = {name: getattr(g, name).copy() for name in scenes.FIELDS}
    columns["means"][::50, 1] = np.nan
    columns["scales"][1::50, 0] = np.inf
    columns["quats"][2::50] = np.nan
    columns["opacities"][3::50] = np.nan
    columns["sh0"][4::50] = -np.inf
    spoilt = Scene(Gaussians(**columns), room.cameras, room.images, None, room.names)
    result = compacted(spoilt)
    assert noted(result.report.choices["changes"], "finite")
    assert (
        abs(
            scenes.psnr_of(result.gaussians, room)
            - scenes.psnr_of(compacted(unaligned_scenes.without_order(room)).gaussians, room)
        )
        < 1
    )


def test_scene_without_a_finite_row_is_refused(room: Scene) -> None:
    g = room.gaussians
    spoilt = replace(unaligned_scenes.without_order(room), gaussians=replace(g, means=np.full_like(g.means, np.nan)))
    with refuses(ValueError, "", "finite", "none"):
        compact(spoilt)


def test_few_gaussians_that_no_view_sees_change_nothing(room: Scene) -> None:
    alone = unaligned_scenes.without_order(room)
    hidden = unaligned_scenes.far_behind(room.gaussians, 20)
    both = replace(alone, gaussians=Gaussians.concat([room.gaussians, hidden]))
    one, other = (compacted(scene, superpixels=100).gaussians for scene in (alone, both))
    assert abs(scenes.psnr_of(one, room) - scenes.psnr_of(other, room)) < 0.3
    assert other.means[:, 2].min() > 0


@pytest.mark.parametrize("fit", ["none", "full"], ids="fit={}".format)
def test_one_view_reaches_the_floor(room: Scene, fit: str, floor: Callable[..., None]) -> None:
    single = scenes.take_views(room, [1])
    result = compacted(unaligned_scenes.shuffled(single), fit=fit, fit_steps=20)
    floor(scenes.psnr_of(result.gaussians, single))


def test_one_gaussian_stays_one(room: Scene) -> None:
    middle = room.gaussians[15 * 40 + 20 : 15 * 40 + 21]
    assert len(compacted(replace(unaligned_scenes.without_order(room), gaussians=middle), fit="none").gaussians) == 1


def test_scene_without_photos_reaches_the_floor(room: Scene, floor: Callable[..., None]) -> None:
    blind = replace(unaligned_scenes.shuffled(room), images=None)
    result = compacted(blind, fit_steps=60)
    assert noted(result.report.notes, "no", "photos")
    assert result.report.psnr_before is None
    assert result.report.psnr_after is None
    own = render(room.gaussians, room.cameras).images.clip(0, 1)
    floor(scenes.psnr_of(result.gaussians, replace(room, images=own)))


def test_scene_without_cameras_reaches_the_floor(room: Scene, floor: Callable[..., None]) -> None:
    blind = make_scene(unaligned_scenes.shuffled(room).gaussians, NO_CAMERAS)
    result = compacted(blind, fit_steps=60)
    assert noted(result.report.notes, "no", "cameras")
    own = render(room.gaussians, room.cameras).images.clip(0, 1)
    floor(scenes.psnr_of(result.gaussians, replace(room, images=own)))


@pytest.mark.slow
def test_cameras_are_placed_as_well_far_from_the_origin(room: Scene) -> None:
    """In geographic coordinates cameras are placed as well as at home."""
    g, shift = room.gaussians, np.array([1e6, -3e6, 400.0])
    there = replace(g, means=g.means + shift)
    one, other = (compacted(make_scene(x, NO_CAMERAS), fit="none") for x in (g, there))
    assert abs(len(one.gaussians) - len(other.gaussians)) <= 0.1 * len(one.gaussians)
    middle = other.gaussians.means.mean(0, np.float64) - shift
    assert np.abs(middle - one.gaussians.means.mean(0, np.float64)).max() < 0.3


@pytest.mark.slow
def test_count_keeps_to_its_share_with_few_gaussians_for_each_view() -> None:
    scene = scenes.make_scene(scenes.wall(), scenes.arc(30, 16, 12))
    few = replace(unaligned_scenes.without_order(scene), gaussians=scene.gaussians[::30])
    result = compacted(few, superpixels="30%", fit="none", poses="fixed")
    assert len(result.gaussians) <= 0.3 * len(few.gaussians) + 30


@pytest.mark.parametrize("degree", [1, 3], ids="degree {}".format)
def test_harmonics_keep_their_degree(degree: int) -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24), degree=degree)
    result = compacted(unaligned_scenes.shuffled(scene))
    assert result.gaussians.sh_degree == degree
    assert np.abs(result.gaussians.shN).max() > 0


@pytest.mark.parametrize("threads", [1, 2], ids="threads={}".format)
def test_layers_in_one_place_reach_the_floor(room: Scene, threads: int, floor: Callable[..., None]) -> None:
    """Every Gaussian four times at one place, fainter: layers that hide nothing and are hidden by nothing."""
    g = room.gaussians
    layers = Gaussians.concat([replace(g, opacities=1 - (1 - g.opacities) ** 0.25)] * 4)
    result = compacted(replace(unaligned_scenes.without_order(room), gaussians=layers), threads=threads)
    floor(scenes.psnr_of(result.gaussians, room))


def test_no_gaussians_are_put_into_empty_sky() -> None:
    """Superpixels without a Gaussian are left out, and their share is spent on the ball."""
    scene = scenes.make_scene(scenes.room(), scenes.arc(3, 48, 36))
    near = scene.gaussians.means[:, 2] < 3.3
    masks = near.reshape(scene.pixels.shown.shape)  # or the sky would be filled
    ball = replace(unaligned_scenes.without_order(scene), gaussians=scene.gaussians[near], masks=masks)
    result = compacted(ball, fit="none")
    assert (result.gaussians.means[:, 2] < 3.3).all()
    assert np.isfinite(result.report.psnr_after)
