"""Corners match OpenCV's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsmerge.kernels.superpixels import bass

SIZES = ((1, 1), (1, 2), (2, 1), (1, 9), (9, 1), (2, 2), (3, 3), (37, 53))


def noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(height).random((height, width, 3), dtype=np.float32)


@pytest.mark.parametrize("size", SIZES)
def test_corners_match_opencv_s(size: tuple[int, int]) -> None:
    pixels = noise(*size)
    expected = cv2.cornerMinEigenVal(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), 3, ksize=3)
    response = bass.corner_response(pixels)
    assert response == pytest.approx(np.maximum(expected, 0), abs=1e-6)
    assert (response >= 0).all()


def test_flat_pictures_have_no_corners() -> None:
    assert not bass.corner_response(np.full((7, 9, 3), 0.3, np.float32)).any()


@pytest.mark.parametrize("shape", [(0, 3), (3, 0), (0, 0)])
def test_picture_without_pixels_has_no_corners(shape: tuple[int, int]) -> None:
    assert bass.corner_response(np.empty((*shape, 3), np.float32)).shape == shape


def test_nan_changes_no_corner_far_from_it() -> None:
    pixels = noise(12, 12)
    pixels[6, 6] = np.nan
    clean, response = bass.corner_response(noise(12, 12)), bass.corner_response(pixels)
    assert np.array_equal(response[:4], clean[:4])
