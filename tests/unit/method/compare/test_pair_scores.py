"""Scores of pairs match slow, obvious twins."""

from __future__ import annotations

import numpy as np
import pytest
from panoramas import cut_views, show, take_photos

from gsmerge.method.compare.similarity import (
    NOISE_MARGIN,
    SCORE_PIXELS,
    Comparer,
    find_contrast,
    fisher_z,
    measure_noise,
    signed_ranks,
    stands_out,
)
from gsmerge.method.compare.view_pictures import ViewPictures, average, fit_size
from gsmerge.method.kernels.pictures import ORIENTATIONS, turn_back, turn_picture
from gsmerge.method.raster.photos import shrink_pictures


def correlate_slowly(shown: ViewPictures, view: int, upright: np.ndarray) -> float:
    """Return the weighted correlation of local contrasts, the mean of all sizes, pixel by pixel."""
    out, most = [], fit_size(upright.shape[1::-1], SCORE_PIXELS[-1])
    for side in SCORE_PIXELS:
        small = shown.shrink(side)
        picture, weight = small.pictures[view], small.weights[view]
        height, width = weight.shape
        near = find_contrast(shrink_pictures(shrink_pictures(upright[None], *most), width, height)[0])
        own = find_contrast(picture, weight)
        sums = np.zeros(3)
        for y in range(height):
            for x in range(width):
                a, b, w = near[y, x].astype(float), own[y, x].astype(float), float(weight[y, x])
                sums += w * np.array([a @ b, a @ a, b @ b])
        out.append(sums[0] / np.sqrt(sums[1] * sums[2]))
    return float(np.mean(out))


@pytest.mark.parametrize("turn", [0, 2, 4, 6])
def test_correlations_are_those_of_upright_photos(turn: int) -> None:
    views = cut_views(2)
    weights = np.ones(views.shape[:3], np.float32)
    weights[0, :60] = 0.2
    shown, photos = show(views, 256, weights), take_photos(views)
    actual = Comparer(shown).correlate([np.ascontiguousarray(turn_back(photos[1], turn))])[0]
    for view in range(2):
        expected = correlate_slowly(shown, view, np.ascontiguousarray(photos[1]))
        assert actual[view, turn] == pytest.approx(expected, abs=1e-5)
    assert np.nanargmax(actual[1]) == turn


def test_a_photo_that_lies_can_only_stand_turned() -> None:
    scores = Comparer(show(cut_views(2), 256)).correlate(
        [np.ascontiguousarray(np.rot90(take_photos(cut_views(2))[0]))]
    )[0]
    assert np.isnan(scores[:, [0, 2, 4, 6]]).all()
    assert np.isfinite(scores[:, [1, 3, 5, 7]]).all()
    turn = int(np.nanargmax(scores[0]))
    upright = turn_picture(np.rot90(take_photos(cut_views(2))[0]), turn)
    np.testing.assert_array_equal(upright, take_photos(cut_views(2))[0])
    assert ORIENTATIONS == 8


def test_transparency_changes_no_score() -> None:
    views = cut_views(2)
    faint = show(views, 256, np.full(views.shape[:3], 0.05, np.float32))
    photo = take_photos(views)[0]
    np.testing.assert_allclose(
        Comparer(faint).correlate([photo]), Comparer(show(views, 256)).correlate([photo]), atol=1e-4
    )


def test_views_that_show_nothing_have_no_score() -> None:
    views, weights = cut_views(2), np.ones((2, 192, 256), np.float32)
    weights[1] = 0
    scores = Comparer(show(views, 256, weights)).correlate(take_photos(views)[:1])[0]
    assert np.isnan(scores[1]).all()
    middle, noise = measure_noise(fisher_z(scores)[:, None], 0.01)
    assert np.isfinite(middle).all()
    assert noise > 0


def test_noise_of_scores_is_measured_on_most_pairs() -> None:
    rng = np.random.default_rng(0)
    z = rng.normal(0.3, 0.1, (8, 40, 8))
    z[range(8), range(8), 0] += 2  # the right ones
    middle, noise = measure_noise(z, 0.01)
    np.testing.assert_allclose(middle, 0.3, atol=0.03)
    assert noise == pytest.approx(0.1, rel=0.1)
    assert measure_noise(np.zeros((2, 3, 8)), 0.05)[1] == 0.05  # as of pixels that have nothing in common


@pytest.mark.parametrize("shift", [-0.3, 0.0, 0.1, 0.5])
def test_signed_ranks_match_scipy_s_wilcoxon(shift: float) -> None:
    from scipy.stats import wilcoxon  # which takes a second to load in each process of a run

    gains = np.random.default_rng(1).standard_normal(200) + shift
    expected = wilcoxon(gains, method="asymptotic", alternative="greater").zstatistic
    assert signed_ranks(gains) == pytest.approx(expected, abs=1e-9)
    assert stands_out(gains) == (expected > NOISE_MARGIN)
    assert signed_ranks(np.concatenate([gains, [np.nan, 0.0]])) == signed_ranks(gains)
    assert signed_ranks(np.array([np.nan, 0.0])) == 0


def test_averaged_pixels_are_weighted_by_what_is_shown() -> None:
    pictures = np.array([[[[1.0, 0, 0], [0, 1, 0]], [[0, 0, 1], [0.5, 0.5, 0.5]]]], np.float32)
    weights = np.array([[[1.0, 0], [0.5, 0.5]]], np.float32)
    small = average(pictures, weights, np.array([[[0.5]]], np.float32))
    np.testing.assert_allclose(small[0, 0, 0], [0.625, 0.125, 0.375], atol=1e-6)
