"""PSNR and SSIM match known values and scikit-image's."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from messages import refuse_all, refuses
from skimage.metrics import structural_similarity

from gsmerge.method.kernels import elementary
from gsmerge.method.raster.metrics import psnr, ssim

RNG = np.random.default_rng(0)
PHOTO = np.clip(RNG.normal(0.5, 0.2, (40, 50, 3)), 0, 1).astype(np.float32)
NOISY = np.clip(PHOTO + RNG.normal(0, 0.1, PHOTO.shape), 0, 1).astype(np.float32)


def test_psnr_of_a_known_error_is_as_by_hand() -> None:
    assert psnr(np.full((4, 4, 3), 0.6), np.full((4, 4, 3), 0.5)) == pytest.approx(20)


def test_psnr_of_equal_images_is_infinite() -> None:
    assert psnr(PHOTO, PHOTO) == math.inf


def test_psnr_counts_only_the_mask() -> None:
    image, mask = np.zeros((2, 2, 3)), np.array([[True, False], [False, False]])
    image[0, 0] = 0.1
    assert psnr(image, np.zeros((2, 2, 3)), mask) == pytest.approx(20)
    assert psnr(image, np.zeros((2, 2, 3)), ~mask) == math.inf
    assert psnr(image, np.zeros((2, 2, 3)), mask[..., None]) == pytest.approx(20)


def test_metrics_of_tensors_are_those_of_arrays(torch: Any) -> None:
    tensors = torch.from_numpy(PHOTO), torch.from_numpy(NOISY)
    assert psnr(*tensors) == psnr(PHOTO, NOISY)
    assert ssim(*tensors) == ssim(PHOTO, NOISY)


def reference_ssim(image: np.ndarray, photo: np.ndarray) -> float:
    """Return scikit-image's SSIM, with the windows of the literature; it crops the border itself."""
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return structural_similarity(
        image.astype(np.float64), photo.astype(np.float64), channel_axis=-1, data_range=1, **settings
    )


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_ssim_matches_scikit_image_s(channels: int) -> None:
    first, second = np.concatenate([PHOTO, PHOTO], 2)[..., :channels], np.concatenate([NOISY, PHOTO], 2)[..., :channels]
    assert ssim(first, second) == pytest.approx(reference_ssim(first, second), abs=1e-5)


@pytest.mark.parametrize("noise", [0.001, 0.01, 0.1])
def test_ssim_matches_scikit_image_s_where_images_are_smooth(noise: float) -> None:
    """Small variances, which float32 loses first."""
    y, x = np.mgrid[:60, :70] / 60
    smooth = np.stack([0.9 + 0.05 * x, 0.5 + 0.4 * elementary.sin(2 * x + y), x * 0 + 0.02], -1).astype(np.float32)
    noisy = np.clip(smooth + np.random.default_rng(1).normal(0, noise, smooth.shape), 0, 1).astype(np.float32)
    assert ssim(smooth, noisy) == pytest.approx(reference_ssim(smooth, noisy), abs=1e-5)


def test_ssim_of_the_smallest_image_is_that_of_one_window() -> None:
    first, second = PHOTO[:11, :11], NOISY[:11, :11]
    assert ssim(first, second) == pytest.approx(reference_ssim(first, second), abs=1e-5)


def test_ssim_of_a_mask_is_the_mean_of_its_windows() -> None:
    """One window: that about the middle of an image of its own."""
    mask = np.zeros(PHOTO.shape[:2], bool)
    mask[20, 30] = True
    part = slice(15, 26), slice(25, 36)
    assert ssim(PHOTO, NOISY, mask) == pytest.approx(reference_ssim(PHOTO[part], NOISY[part]), abs=1e-5)


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_metrics_refuse_images_and_masks_that_do_not_fit(metric: object) -> None:
    assert callable(metric)
    refuse_all(ValueError, [
        (lambda: metric(PHOTO, PHOTO[:-1]), "", [40, 50, 3], [39, 50, 3]),
        (lambda: metric(PHOTO[..., 0], PHOTO[..., 0]), "", "[h,w,c]", [40, 50]),
        (lambda: metric(PHOTO, PHOTO, np.ones((3, 3))), "mask", [40, 50], [3, 3]),
        (lambda: metric(PHOTO, PHOTO, np.zeros(PHOTO.shape[:2])), "mask", "pixel", "none"),
    ])  # fmt: skip


def test_ssim_refuses_images_smaller_than_its_window() -> None:
    with refuses(ValueError, "", "11 x 11", [10, 50]):
        ssim(PHOTO[:10], PHOTO[:10])
