"""Filters and lookups in pictures match SciPy's and slow loops."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import ndimage

from gsmerge.method.kernels.pictures import blur, convolve, enlarge, sample_bilinear, sobel

RNG = np.random.default_rng(0)
SHAPES = [(20, 31, 3), (20, 31), (1, 1), (1, 7, 2), (9, 1), (2, 2, 4), (3, 200)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("taps", [(1, 1), (3, 5), (11, 3)])
def test_convolutions_are_scipys(each_target, shape, taps):
    picture, across, down = RNG.random(shape).astype(np.float32), *(RNG.normal(size=n) for n in taps)
    (actual,) = each_target(lambda: (convolve(picture, across, down),))
    exact = picture.astype(np.float64)
    for axis, one in ((1, across), (0, down)):
        exact = ndimage.correlate1d(exact, one, axis, mode="mirror") if exact.shape[axis] > 1 else exact * one.sum()
    assert (actual.dtype, actual.shape) == (np.float32, picture.shape)
    np.testing.assert_allclose(actual, exact, atol=3e-5)


@pytest.mark.parametrize(("sigma", "size"), [(0.7, None), (1.5, 11), (3.0, None)])
def test_blurs_are_opencvs(sigma, size):
    picture = RNG.random((40, 60, 3)).astype(np.float32)
    slow = cv2.GaussianBlur(picture, (size or 0, size or 0), sigma)
    np.testing.assert_allclose(blur(picture, sigma, size), slow, atol=1e-6)


def test_derivatives_are_opencvs():
    picture = RNG.random((40, 60, 3)).astype(np.float32)
    for actual, way in zip(sobel(picture), ((1, 0), (0, 1)), strict=True):
        np.testing.assert_allclose(actual, cv2.Sobel(picture, cv2.CV_32F, *way, ksize=3), atol=2e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_bilinear_lookups_match_a_loop(each_target, shape):
    picture = RNG.random(shape).astype(np.float32)
    height, width = shape[:2]
    x, y = (RNG.uniform(-2, n + 1, 60).astype(np.float32) for n in (width, height))
    x[:4], y[:4] = (0, width - 1, np.inf, -np.inf), (height - 1, 0, 0, np.nan)
    (actual,) = each_target(lambda: (sample_bilinear(picture, x, y),))
    for row, u, v in zip(actual, x, np.nan_to_num(y), strict=True):
        u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
        i, j = min(int(u), max(width - 2, 0)), min(int(v), max(height - 2, 0))
        corners = picture[j : j + 2, i : i + 2].astype(np.float64)
        weights = np.outer([1 - (v - j), v - j][: len(corners)], [1 - (u - i), u - i][: corners.shape[1]])
        np.testing.assert_allclose(row, np.tensordot(weights, corners, 2), atol=1e-6)


def test_lookups_have_the_shape_of_their_places():
    picture, places = np.ones((4, 5, 3), np.float32), np.zeros((2, 7))
    assert sample_bilinear(picture, places, places).shape == (2, 7, 3)
    assert sample_bilinear(picture[..., 0], places[:0], places[:0]).shape == (0, 7)
    with pytest.raises(ValueError, match="indices"):
        sample_bilinear(picture[:0], places, places)


def test_convolved_empty_pictures_keep_their_shape():
    assert convolve(np.empty((0, 4, 3), np.float32), np.ones(3), np.ones(3)).shape == (0, 4, 3)
    assert convolve(np.empty((4, 0), np.float32), np.ones(3), np.ones(3)).shape == (4, 0)
    with pytest.raises(ValueError, match="indices"):
        convolve(np.ones((4, 4)), np.ones(2), np.ones(3))


@pytest.mark.parametrize("shape", [(20, 31, 3), (20, 31), (1, 4, 3)])
def test_enlarged_pictures_are_opencvs(shape):
    picture = RNG.random(shape).astype(np.float32)
    slow = cv2.resize(picture, (67, 41), interpolation=cv2.INTER_CUBIC)
    np.testing.assert_allclose(enlarge(picture, 67, 41), slow, atol=2e-6)
