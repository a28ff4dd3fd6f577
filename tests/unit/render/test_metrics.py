from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from gsmerge.render.metrics import psnr, ssim

RNG = np.random.default_rng(0)
PHOTO = np.clip(RNG.normal(0.5, 0.2, (40, 50, 3)), 0, 1).astype(np.float32)
NOISY = np.clip(PHOTO + RNG.normal(0, 0.1, PHOTO.shape), 0, 1).astype(np.float32)


def test_psnr_of_a_known_error() -> None:
    assert psnr(np.full((4, 4, 3), 0.6), np.full((4, 4, 3), 0.5)) == pytest.approx(20)


def test_psnr_of_equal_images_is_infinite() -> None:
    assert psnr(PHOTO, PHOTO) == math.inf


def test_psnr_counts_only_the_mask() -> None:
    image, mask = np.zeros((2, 2, 3)), np.array([[True, False], [False, False]])
    image[0, 0] = 0.1
    assert psnr(image, np.zeros((2, 2, 3)), mask) == pytest.approx(20)
    assert psnr(image, np.zeros((2, 2, 3)), ~mask) == math.inf
    assert psnr(image, np.zeros((2, 2, 3)), mask[..., None]) == pytest.approx(20)


def test_tensors_and_arrays_give_the_same() -> None:
    tensors = torch.from_numpy(PHOTO), torch.from_numpy(NOISY)
    assert psnr(*tensors) == psnr(PHOTO, NOISY)
    assert ssim(*tensors) == ssim(PHOTO, NOISY)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_ssim_is_scikit_images(channels: int) -> None:
    first, second = np.concatenate([PHOTO, PHOTO], 2)[..., :channels], np.concatenate([NOISY, PHOTO], 2)[..., :channels]
    wanted = structural_similarity(first.astype(np.float64), second.astype(np.float64), channel_axis=2, data_range=1)
    assert ssim(first, second) == pytest.approx(wanted, abs=1e-12)


def test_ssim_of_the_smallest_image() -> None:
    first, second = PHOTO[:7, :7].astype(np.float64), NOISY[:7, :7].astype(np.float64)
    wanted = structural_similarity(first, second, channel_axis=2, data_range=1)
    assert ssim(first, second) == pytest.approx(wanted, abs=1e-12)


def test_ssim_of_flat_images_is_one() -> None:
    assert ssim(np.full((9, 9, 3), 0.7), np.full((9, 9, 3), 0.7)) == pytest.approx(1)


def test_ssim_counts_only_windows_of_the_mask() -> None:
    image, mask = PHOTO.copy(), np.zeros(PHOTO.shape[:2], bool)
    image[:, 30:] = 0
    mask[:, :20] = True
    assert ssim(image, PHOTO, mask) == pytest.approx(1)
    assert ssim(image, PHOTO, ~mask) < 0.8


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_messages(metric: object) -> None:
    assert callable(metric)
    with pytest.raises(ValueError, match="expected two images"):
        metric(PHOTO, PHOTO[:-1])
    with pytest.raises(ValueError, match="expected two images"):
        metric(PHOTO[..., 0], PHOTO[..., 0])
    with pytest.raises(ValueError, match=r"mask: expected shape \[40, 50\]"):
        metric(PHOTO, PHOTO, np.ones((3, 3)))
    with pytest.raises(ValueError, match="at least one pixel"):
        metric(PHOTO, PHOTO, np.zeros(PHOTO.shape[:2]))


def test_ssim_refuses_images_smaller_than_its_window() -> None:
    with pytest.raises(ValueError, match="at least 7 x 7"):
        ssim(PHOTO[:6], PHOTO[:6])
