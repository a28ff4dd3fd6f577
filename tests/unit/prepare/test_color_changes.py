"""Changes of colours are fitted to half of the blocks, and judged on the others."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from panoramas import cut_views, shrunk

from gsmerge.prepare.compare_photos import are_exchanged, find_grey
from gsmerge.prepare.photo_change import LUMA, PhotoChange
from gsmerge.reading.photos.colors import (
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
from gsmerge.reading.photos.view_pictures import Pairs, ViewPictures

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


def grey(photos: np.ndarray) -> np.ndarray:
    return (photos * LUMA).sum(-1, keepdims=True).repeat(3, -1)


def half_grey(photos: np.ndarray) -> np.ndarray:
    return (grey(photos) + photos) / 2


@pytest.mark.parametrize(
    ("change", "is_grey"),
    [
        (grey, True),
        (lambda photos: (grey(photos) * np.float32([1.35, 1.2, 0.94])).clip(0, 1), True),
        (half_grey, False),
        (mix, False),
    ],
    ids=["grey", "sepia", "half grey", "mixed"],
)
def test_photos_without_hues_are_told_from_others(change: Change, is_grey: bool) -> None:
    """Of the Gaussians, since grey Gaussians need no other photos."""
    pairs = pair(lambda photos: photos)
    photos = change(pairs.photos)
    assert list(find_grey(pairs.with_photos(photos), range(4))) == ([0, 1, 2, 3] if is_grey else [])
    assert not find_grey(pair(change).with_photos(photos), range(4))
    weights = np.ones(photos[0].size // 3, np.float32)
    assert (vary_in_hue(photos[0].reshape(-1, 3), weights) < 0.01) == is_grey


def test_change_that_keeps_brightness_takes_hues_alone() -> None:
    photos = shrunk(cut_views(1), 96) * np.float32(0.5) + np.float32(0.25)
    dark = grey(photos[0]) * np.float32(0.9)
    cover = np.full(dark.shape[:2], True)
    cover[:5] = False
    changed = PhotoChange(cover=cover, colors=photos[0], keeps_brightness=True)(dark)
    np.testing.assert_allclose(grey(changed), dark, atol=1e-4)
    np.testing.assert_allclose((changed - grey(changed))[5:], (photos[0] - grey(photos[0]))[5:], atol=1e-4)
    np.testing.assert_array_equal(changed[:5], dark[:5])


def test_exchanged_red_and_blue_are_told_from_other_maps() -> None:
    assert are_exchanged(pair(lambda photos: photos[..., ::-1], noise=0.02))
    for change in (mix, gamma, half_grey):
        assert not are_exchanged(pair(change, noise=0.02))
