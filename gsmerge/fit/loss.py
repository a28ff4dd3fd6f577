"""The image loss of the full fit: L1 and structural similarity."""

from __future__ import annotations

import cv2
import numpy as np

from gsmerge.kernels.optimise import similarity_terms

WINDOW = (7, 7)


def _box(array: np.ndarray) -> np.ndarray:
    """Window means; zero beyond the border, so that the operator is its own transpose."""
    return cv2.blur(array, WINDOW, borderType=cv2.BORDER_CONSTANT)


def image_gradient(image: np.ndarray, photo: np.ndarray, weight: np.ndarray, dssim: float) -> np.ndarray:
    """Gradient of the loss (1 - dssim) |image - photo| + dssim (1 - SSIM), per pixel of the image.

    Args:
        image: ``[h,w,3]`` float32.
        photo: ``[h,w,3]`` float32.
        weight: ``[h,w]`` float32 weights of the pixels.
        dssim: Share of structural similarity (windows of 7 x 7).

    Returns:
        ``[h,w,3]`` float32, divided by the number of pixels, so that it means the same at every size.
    """
    mean, square, cross = np.empty_like(image), np.empty_like(image), np.empty_like(image)
    windows = [_box(image), _box(photo), _box(image * image), _box(photo * photo), _box(image * photo)]
    similarity_terms(*(w.reshape(-1) for w in windows), mean.reshape(-1), square.reshape(-1), cross.reshape(-1))
    channels = weight[..., None]
    similarity = _box(mean * channels) + 2 * image * _box(square * channels) + photo * _box(cross * channels)
    gradient = (1 - dssim) * channels * np.sign(image - photo) - dssim * similarity
    return (gradient / np.float32(image.shape[0] * image.shape[1])).astype(np.float32)
