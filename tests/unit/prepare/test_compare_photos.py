"""Changes of colours are told from noise; results look as their Gaussians do unless the look of photos is asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scenes
import unaligned_scenes
from messages import noted
from panoramas import cut_views, shrunk
from sweeps import sweep

from gsmerge import CompactResult, Scene, compact, render
from gsmerge.method.compare.colors import (
    Blocks,
    cut_blocks,
    explains,
    fit_map,
    fit_tones,
    is_visible,
    map_blocks,
    map_colors,
    map_tones,
    tone_blocks,
    vary_in_hue,
)
from gsmerge.method.compare.view_pictures import Pairs, ViewPictures
from gsmerge.method.facts.pictures import PHOTOS, ROW_COLORS
from gsmerge.method.geometry.transforms import rgb_to_sh0, sh0_to_rgb
from gsmerge.method.geometry.views import take_rows
from gsmerge.prepare.compare_photos import are_exchanged, compare_photos, find_grey, have_other_tones
from gsmerge.prepare.photo_change import LUMA, PhotoChange
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.prepare.true_pixels import with_pixels
from gsmerge.runtime.record import record_run
from gsmerge.types import PicturedScene

Colors = np.ndarray
FIT = {"superpixels": 200, "fit_steps": 30, "checkpoint": "none", "poses": "fixed", "new_views": False}


def grey(colors: Colors) -> Colors:
    return np.repeat((colors @ np.array([0.3, 0.59, 0.11]))[..., None], 3, -1)


def false_colors(colors: Colors) -> Colors:
    return np.stack([1 - colors[..., 2], colors[..., 0], (2 * colors[..., 1]) % 1], -1)


def styled(colors: Colors) -> Colors:
    """Draw in green inks on pale paper."""
    light = grey(colors)[..., 0]
    return np.stack([1 - 0.9 * light, 0.9 - 0.4 * light**2, 0.3 + 0.6 * np.abs(2 * light - 1)], -1).clip(0, 1)


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(4, 96, 72))


def with_look(scene: Scene, look: Callable[[Colors], Colors]) -> Scene:
    """Return the scene with other colours of its Gaussians beside the same photos."""
    colors = look(sh0_to_rgb(scene.gaussians.sh0[:, 0]).clip(0, 1).astype(np.float64))
    return replace(scene, gaussians=replace(scene.gaussians, sh0=rgb_to_sh0(colors.astype(np.float32))[:, None]))


def distances(result: CompactResult, scene: Scene) -> tuple[float, float]:
    """Return the mean difference of colours from the scene's own Gaussians and from its photos."""
    shown, own = (render(each, scene.cameras).images for each in (result.gaussians, scene.gaussians))
    return float(np.abs(shown - own).mean()), float(np.abs(shown - scene.images).mean())


@pytest.mark.parametrize("side", [24, 3])
def test_photos_that_differ_are_told_with_their_share(side: int, room: Scene) -> None:
    images = room.images.copy()
    images[0, 20 : 20 + side, 30 : 30 + side] = (1, 0, 1)
    with record_run() as record:
        _, _, changes = compare_photos(PicturedScene.with_pictures(replace(room, images=images), images, None))
    assert "photos_changed" in record.choices
    (change,) = filter(None, changes)
    assert "1 of 4 photos differ in part" in change


def test_a_stray_row_does_not_judge_the_pixels_that_have_lost_theirs(room: Scene) -> None:
    """Of the second view, a strip is left, and one row far from it that shows something else."""
    kept = np.ones(room.images.shape[:3], bool)
    kept[1, 12:] = False
    kept[1, 50, 40] = True
    sh0 = room.gaussians.sh0.copy()
    sh0[room.pixels.fronts[1, 50, 40]] *= -1
    scene = scenes.shown_in(replace(room, gaussians=replace(room.gaussians, sh0=sh0)), kept)
    compared, views, _ = compare_photos(PicturedScene.with_pictures(scene, room.images, None))
    assert views == (0, 1, 2, 3)
    assert (compared.images[1] != room.images[1]).any(-1).sum() <= 1


def test_a_photo_is_not_left_out_by_a_view_that_has_lost_its_rows(room: Scene) -> None:
    """The few that are left in the third view belong to another one, and show something else."""
    kept = np.ones(room.images.shape[:3], bool)
    kept[2] = False
    kept[2, 40, 30:40] = True
    sh0 = room.gaussians.sh0.copy()
    sh0[room.pixels.fronts[2, 40, 30:40]] = np.random.default_rng(0).normal(size=(10, 1, 3))
    scene = scenes.shown_in(replace(room, gaussians=replace(room.gaussians, sh0=sh0)), kept)
    with record_run() as record:
        compared, views, _ = compare_photos(PicturedScene.with_pictures(scene, room.images, None))
    assert views == (0, 1, 2, 3)
    assert "photos_left_out" not in record.choices
    np.testing.assert_array_equal(compared.images[2], room.images[2])


@sweep(
    "look",
    [grey, false_colors, styled, lambda colors: colors[..., ::-1]],
    ids=["grey", "false colours", "styled", "BGR"],
)
def test_a_scene_keeps_its_look_beside_other_photos(look: Callable[[Colors], Colors], room: Scene) -> None:
    scene = with_look(room, look)
    result = compact(scene, **FIT)
    assert result.report.psnr_reference == ROW_COLORS
    assert len([note for note in result.report.notes if "--set look=photos" in note]) == 1
    own, photos = distances(result, scene)
    assert own < 0.6 * photos  # clearly nearer to its own look


@sweep("look", [styled, grey, false_colors])
def test_the_look_of_photos_is_taken_where_that_is_asked_for(look: Callable[[Colors], Colors], room: Scene) -> None:
    scene = with_look(room, look)
    result = compact(scene, **FIT, look="photos")
    assert result.report.psnr_reference == PHOTOS
    assert not noted(result.report.notes, "look")
    own, photos = distances(result, scene)
    assert photos < 0.6 * own  # clearly nearer to the look of the photos


def test_photos_of_another_scene_are_noted_as_no_look(room: Scene) -> None:
    other = scenes.make_scene(scenes.wall(9), scenes.arc(4, 96, 72)).images
    notes = compact(replace(room, images=other), **FIT).report.notes
    assert noted(notes, "4 of 4", "do not show what the Gaussians show")
    assert not [note for note in notes if "look=photos" in note]


def test_photos_of_a_mildly_different_grade_are_followed(room: Scene) -> None:
    result = compact(with_look(room, lambda colors: 0.95 * colors**0.93 + 0.01), **FIT)
    assert result.report.psnr_reference == PHOTOS
    assert not [note for note in result.report.notes if "look" in note]


@pytest.mark.parametrize("change", [None, lambda photo: 0.8 * photo, lambda photo: photo**1.5], ids=["none", "*", "^"])
def test_the_tone_of_gaussians_does_not_depend_on_what_hides_them(change: Callable | None) -> None:
    """A dark wall in front of every view darkens drawings; the colours of all Gaussians are those of the photos."""
    scene = scenes.make_scene(scenes.room(), scenes.arc(4, 48, 36))
    pictured = PicturedScene.with_pictures(unaligned_scenes.shuffled(scene), scene.images, None)
    dark = np.flatnonzero(pictured.gaussians.sh0.mean((1, 2)) < np.quantile(pictured.gaussians.sh0.mean((1, 2)), 0.2))
    means = pictured.gaussians.means.copy()
    means[dark] = scene.cameras.centres.mean(0) + 0.5 * (means[dark] - scene.cameras.centres.mean(0))
    near = replace(pictured, gaussians=replace(pictured.gaussians, means=means))
    near = near if change is None else replace(near, images=change(scene.images))
    assert have_other_tones(near, range(4)) == (change is not None)
    nothing = replace(near, gaussians=near.gaussians[:0])
    assert have_other_tones(nothing, range(4))  # which says nothing against what drawings say


Change = Callable[[np.ndarray], np.ndarray]


def pair(change: Change, noise: float = 0.0) -> Pairs:
    """Return photos of four views, which ``change`` brings to what the Gaussians show, but for noise of pixels."""
    photos = shrunk(cut_views(4), 96)
    grain = noise * np.random.default_rng(0).standard_normal(photos.shape)
    pictures = (change(photos) + grain).clip(0, 1).astype(np.float32)
    return Pairs(photos, ViewPictures(pictures, np.ones(photos.shape[:3], np.float32), drawn=True))


def gamma(photos: np.ndarray) -> np.ndarray:
    return photos ** np.float32(1.8)


def mix(photos: np.ndarray) -> np.ndarray:
    return np.asarray(0.1 + photos @ np.array([[0.2, 0.5, 0.1], [0.3, 0.1, 0.6], [0.4, 0.2, 0.1]], np.float32))


GROUPS = [[0, 1, 2, 3]]


def test_a_curve_joins_quantiles() -> None:
    pairs = pair(gamma)
    colors, targets = pairs.photos.reshape(-1, 3), pairs.shown.pictures.reshape(-1, 3)
    curve = fit_tones(colors, targets, np.ones(len(colors)))
    np.testing.assert_allclose(curve[:, 40:216], np.tile((np.arange(40, 216) / 255) ** 1.8, (3, 1)), atol=0.01)
    inner = (pairs.photos > 0.15) & (pairs.photos < 0.85)  # beyond the outer quantiles it is proportional
    away = map_tones(curve, pairs.photos) - pairs.shown.pictures
    assert np.abs(away[inner]).max() < 0.01
    slow = np.array(
        [[np.interp(value * 255, np.arange(256), curve[c]) for c, value in enumerate(row)] for row in colors]
    )
    np.testing.assert_allclose(map_tones(curve, colors), slow, atol=1e-5)


def test_faint_pixels_do_not_choose_a_curve() -> None:
    pairs = pair(gamma)
    colors, targets = pairs.photos.reshape(-1, 3).copy(), pairs.shown.pictures.reshape(-1, 3).copy()
    weights = np.ones(len(colors))
    plain = fit_tones(colors, targets, weights)
    half = len(colors) // 2
    both = fit_tones(np.tile(colors, (2, 1)), np.concatenate([targets, targets[::-1] * 0]), np.repeat([1, 0], 2 * half))
    np.testing.assert_array_equal(both, plain)


def test_a_map_is_least_squares() -> None:
    pairs = pair(mix)
    colors, targets = pairs.photos.reshape(-1, 3), pairs.shown.pictures.reshape(-1, 3)
    matrix = fit_map(colors, targets, np.ones(len(colors)))
    expected = np.linalg.lstsq(np.c_[colors, np.ones(len(colors))].astype(float), targets.astype(float), rcond=None)[0]
    np.testing.assert_allclose(matrix, expected, atol=1e-3)
    np.testing.assert_allclose(map_colors(matrix, pairs.photos), pairs.shown.pictures, atol=1e-2)


@pytest.mark.parametrize("change", [gamma, mix])
def test_fitted_change_explains_the_change_that_was_made(change: Change) -> None:
    pairs = pair(change, noise=0.02)
    stored = cut_blocks(pairs)
    after = tone_blocks(pairs, GROUPS) if change is gamma else map_blocks(stored)
    assert is_visible(stored.errors())
    assert explains(stored.errors(), after.errors())
    assert not is_visible(after.errors())
    if change is mix:
        assert is_visible(tone_blocks(pairs, GROUPS).errors())


def test_noise_is_explained_by_nothing() -> None:
    """What is fitted to some blocks gains nothing on the others."""
    same = cut_blocks(pair(lambda photos: photos, noise=0.05))
    assert not explains(same.errors(), map_blocks(same).errors())
    assert not is_visible(same.errors())


def test_faint_blocks_are_not_compared() -> None:
    pairs = pair(gamma)
    weights = np.ones(pairs.photos.shape[:3], np.float32)
    weights[:, :36] = 0.01
    blocks: Blocks = cut_blocks(Pairs(pairs.photos, ViewPictures(pairs.shown.pictures, weights, drawn=True)))
    errors = blocks.errors().reshape(blocks.solid.shape)
    assert np.isnan(errors[:, :4]).all()
    assert np.isfinite(errors[:, 5:]).all()


def plain_grey(photos: np.ndarray) -> np.ndarray:
    return (photos * LUMA).sum(-1, keepdims=True).repeat(3, -1)


def half_grey(photos: np.ndarray) -> np.ndarray:
    return (plain_grey(photos) + photos) / 2


@pytest.mark.parametrize(
    ("change", "is_grey"),
    [
        (plain_grey, True),
        (lambda photos: (plain_grey(photos) * np.float32([1.35, 1.2, 0.94])).clip(0, 1), True),
        (half_grey, False),
        (mix, False),
    ],
    ids=["plain_grey", "sepia", "half plain_grey", "mixed"],
)
def test_photos_without_hues_are_told_from_others(change: Change, is_grey: bool) -> None:
    """Of the Gaussians, since plain_grey Gaussians need no other photos."""
    pairs = pair(lambda photos: photos)
    photos = change(pairs.photos)
    assert list(find_grey(pairs.with_photos(photos), range(4))) == ([0, 1, 2, 3] if is_grey else [])
    assert not find_grey(pair(change).with_photos(photos), range(4))
    weights = np.ones(photos[0].size // 3, np.float32)
    assert (vary_in_hue(photos[0].reshape(-1, 3), weights) < 0.01) == is_grey


def test_change_that_keeps_brightness_takes_hues_alone() -> None:
    photos = shrunk(cut_views(1), 96) * np.float32(0.5) + np.float32(0.25)
    dark = plain_grey(photos[0]) * np.float32(0.9)
    cover = np.full(dark.shape[:2], True)
    cover[:5] = False
    changed = PhotoChange(cover=cover, colors=photos[0], keeps_brightness=True)(dark)
    np.testing.assert_allclose(plain_grey(changed), dark, atol=1e-4)
    np.testing.assert_allclose((changed - plain_grey(changed))[5:], (photos[0] - plain_grey(photos[0]))[5:], atol=1e-4)
    np.testing.assert_array_equal(changed[:5], dark[:5])


def test_exchanged_red_and_blue_are_told_from_other_maps() -> None:
    assert are_exchanged(pair(lambda photos: photos[..., ::-1], noise=0.02))
    for change in (mix, gamma, half_grey):
        assert not are_exchanged(pair(change, noise=0.02))


@pytest.mark.parametrize(("opacity", "size"), [(0.5, 1.0), (1.0, 0.35)], ids=["thin", "sparse"])
def test_photos_stay_beside_gaussians_that_draw_them_dark(opacity: float, size: float, room: Scene) -> None:
    """Light passes through thin Gaussians and between sparse ones, whose colours are those of the photos."""
    scene = unaligned_scenes.voxels(room, 0.06)
    g = scene.gaussians
    dark = replace(scene, gaussians=replace(g, opacities=opacity * g.opacities, scales=np.float32(size) * g.scales))
    assert render(dark.gaussians, dark.cameras).images.mean() < 0.8 * room.images.mean()
    with record_run() as record:
        prepared = prepare(dark)
    assert prepared.reference.name == PHOTOS
    assert prepared.reference.score_views == (0, 1, 2, 3)
    assert not noted(record.notes, "tone")
    assert np.abs(prepared.scene.images - room.images).mean() < 0.01


def test_photos_that_are_larger_and_sharper_than_those_of_the_model_show_the_scene(room: Scene) -> None:
    """Rows lie in the middle of 3 x 3 pixels, and have their mean colour."""
    grain = np.random.default_rng(0).uniform(-0.3, 0.3, (*room.images.shape[:3], 1)).astype(np.float32)
    images = (0.25 + 0.5 * room.images + grain).clip(0, 1)
    means = images.reshape(4, 24, 3, 32, 3, 3).mean((2, 4))
    rows = np.arange(4 * 72 * 96).reshape(4, 72, 96)[:, 1::3, 1::3].reshape(-1)
    few = take_rows(with_pixels(replace(room, images=images)), rows)
    sparse = replace(few, gaussians=replace(few.gaussians, sh0=rgb_to_sh0(means.reshape(-1, 1, 3))))
    with record_run():
        scene, views, changes = compare_photos(PicturedScene.with_pictures(sparse, images, None))
    assert views == (0, 1, 2, 3)
    assert not any(changes)
    np.testing.assert_array_equal(scene.images, images)
    report = compact(sparse, effort="draft").report
    assert report.covered is None  # the pixels around a row are covered as well
    assert noted(report.notes, "9 times as many pixels", "--budget 4.4%")
