"""Cameras, photos and masks are resized together."""

from __future__ import annotations

import numpy as np
import pytest
import scenes

from gsmerge.scoring.sizes import fill_cameras, fill_photo, resize_mask, resize_photo, shrink_cameras, shrink_views
from gsmerge.types import Views


@pytest.mark.parametrize("size", [(96, 54), (40, 80), (49, 36), (20, 9), (48, 36)])
def test_photos_that_fill_a_frame_are_cut_as_their_cameras_are(size: tuple[int, int]) -> None:
    """A photo whose colours are its positions shows that its camera's pixels still are where they were."""
    cameras, (width, height) = scenes.arc(2, 48, 36), size
    rows, columns = np.mgrid[:36, :48] + 0.5
    photo = np.stack([columns / 48, rows / 36, 0 * rows], 2).astype(np.float32)
    filled, cut = fill_cameras(cameras, width, height), fill_photo(photo, width, height)
    assert cut.shape == (height, width, 3)
    assert (filled.width, filled.height) == size
    (fx, fy), (cx, cy) = filled.Ks[0, [0, 1], [0, 1]], filled.Ks[0, :2, 2]
    assert fx == pytest.approx(fy, rel=0.02)
    np.testing.assert_allclose([cx, cy], [width / 2, height / 2], atol=0.51)
    rays = (np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy  # of the new pixels
    old = cameras.Ks[0]
    inner = slice(4, -4), slice(4, -4)  # enlarging flattens the borders
    shown = cut[inner][..., 0] * 48, cut[inner][..., 1] * 36
    np.testing.assert_allclose(shown[0], np.tile((rays[0] * old[0, 0] + old[0, 2])[4:-4], (height - 8, 1)), atol=0.3)
    np.testing.assert_allclose(shown[1].T, np.tile((rays[1] * old[1, 1] + old[1, 2])[4:-4], (width - 8, 1)), atol=0.3)


@pytest.mark.parametrize("size", [(24, 18), (96, 72), (31, 40), (48, 36), (1, 1)])
def test_a_resized_mask_marks_pixels_that_are_visible_as_a_whole(size: tuple[int, int]) -> None:
    mask = np.random.default_rng(0).random((36, 48)) > 0.1
    width, height = size
    actual = resize_mask(mask, width, height)
    for y in range(height):
        for x in range(width):
            rows = slice(y * 36 // height, -(-(y + 1) * 36 // height))
            columns = slice(x * 48 // width, -(-(x + 1) * 48 // width))
            assert actual[y, x] == mask[rows, columns].all()


def test_resized_photos_keep_their_range_and_mean() -> None:
    photo = np.random.default_rng(0).random((36, 48, 3)).astype(np.float32).round()
    large, small = resize_photo(photo, 96, 72), resize_photo(photo, 24, 18)
    assert (large.shape, small.shape) == ((72, 96, 3), (18, 24, 3))
    assert 0 <= large.min() <= large.max() <= 1
    np.testing.assert_allclose(small, photo.reshape(18, 2, 24, 2, 3).mean((1, 3)), atol=1e-6)


@pytest.mark.parametrize(
    ("width", "height", "side", "expected"),
    [
        (48, 36, 24, (24, 18)),
        (504, 378, 476, (476, 357)),
        (256, 480, 476, (254, 476)),  # upright
        (480, 2, 16, (16, 1)),
        (48, 36, 48, (48, 36)),
        (48, 36, 476, (48, 36)),  # never larger
        (48, 36, 0, (48, 36)),
    ],
)
def test_photos_and_cameras_shrink_together(width: int, height: int, side: int, expected: tuple[int, int]) -> None:
    cameras = scenes.arc(2, width, height)
    photos = np.random.default_rng(0).random((2, height, width, 3)).astype(np.float32)
    small = shrink_views(Views(cameras, photos, ("a", "b")), side)
    assert (small.cameras.width, small.cameras.height) == expected
    assert small.images.shape == (2, expected[1], expected[0], 3)
    assert small.names == ("a", "b")
    assert np.array_equal(small.cameras.Ks, shrink_cameras(cameras, side).Ks)
    assert np.array_equal(small.cameras.viewmats, cameras.viewmats)
    corner = cameras.Ks @ np.array([0.3, -0.2, 1])  # where a ray meets the picture, as a share of its sides
    moved = small.cameras.Ks @ np.array([0.3, -0.2, 1])
    np.testing.assert_allclose(moved[:, :2] / expected, corner[:, :2] / (width, height), rtol=1e-6)
    assert small.images.mean() == pytest.approx(photos.mean(), abs=1e-5)
