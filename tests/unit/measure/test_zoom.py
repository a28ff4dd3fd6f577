"""Cameras, photos and masks at other sizes."""

from __future__ import annotations

import numpy as np
import pytest
import scenes

from gsmerge.measure.zoom import resize_mask, resize_photo, zoom_cameras


@pytest.mark.parametrize("size", [(24, 18), (96, 72), (31, 40), (48, 36), (1, 1)])
def test_a_pixel_counts_where_all_of_it_is_visible(size: tuple[int, int]) -> None:
    mask = np.random.default_rng(0).random((36, 48)) > 0.1
    width, height = size
    actual = resize_mask(mask, width, height)
    for y in range(height):
        for x in range(width):
            rows = slice(y * 36 // height, -(-(y + 1) * 36 // height))
            columns = slice(x * 48 // width, -(-(x + 1) * 48 // width))
            assert actual[y, x] == mask[rows, columns].all()


def test_photos_keep_their_range_and_mean() -> None:
    photo = np.random.default_rng(0).random((36, 48, 3)).astype(np.float32).round()
    large, small = resize_photo(photo, 96, 72), resize_photo(photo, 24, 18)
    assert (large.shape, small.shape) == ((72, 96, 3), (18, 24, 3))
    assert 0 <= large.min() <= large.max() <= 1
    np.testing.assert_allclose(small, photo.reshape(18, 2, 24, 2, 3).mean((1, 3)), atol=1e-6)


def test_intrinsics_go_with_the_size() -> None:
    cameras = scenes.arc(2)
    twice = zoom_cameras(cameras, 2)
    assert (twice.width, twice.height) == (96, 72)
    np.testing.assert_allclose(twice.Ks[:, :2], 2 * cameras.Ks[:, :2])
    assert zoom_cameras(cameras, 1 / 16).height == 2
