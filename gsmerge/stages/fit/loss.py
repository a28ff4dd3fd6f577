"""The image loss of the full fit: L1 and structural similarity."""

from __future__ import annotations

import cv2
import numpy as np

from gsmerge.kernels.gaussians.optimise import similarity_terms
from gsmerge.runtime.threads import parallel_map

WINDOW = (7, 7)


def _box(array: np.ndarray) -> np.ndarray:
    """Window means; zero beyond the border, so that the operator is its own transpose."""
    return cv2.blur(array, WINDOW, borderType=cv2.BORDER_CONSTANT)


def image_gradient(image: np.ndarray, photo: np.ndarray, weight: np.ndarray, ssim_lambda: float) -> np.ndarray:
    """Gradient of the loss (1 - dssim) |image - photo| + dssim (1 - SSIM), per pixel of the image.

    Args:
        image: ``[h,w,3]`` float32.
        photo: ``[h,w,3]`` float32.
        weight: ``[h,w]`` float32 weights of the pixels.
        ssim_lambda: Share of structural similarity (windows of 7 x 7).

    Returns:
        ``[h,w,3]`` float32, divided by the number of pixels, so that it means the same at every size.
    """
    mean, square, cross = np.empty_like(image), np.empty_like(image), np.empty_like(image)
    windows = parallel_map(lambda pair: _box(pair[0] if pair[1] is None else pair[0] * pair[1]), _pairs(image, photo))
    similarity_terms(*(w.reshape(-1) for w in windows), mean.reshape(-1), square.reshape(-1), cross.reshape(-1))
    channels = weight[..., None]
    from_mean, from_square, from_cross = parallel_map(lambda a: _box(a * channels), (mean, square, cross))
    from_square *= image
    from_cross *= photo
    similarity = from_mean + 2 * from_square + from_cross
    gradient = np.float32(1 - ssim_lambda) * channels * np.sign(image - photo) - np.float32(ssim_lambda) * similarity
    gradient /= np.float32(image.shape[0] * image.shape[1])
    return gradient


def _pairs(image: np.ndarray, photo: np.ndarray) -> list[tuple[np.ndarray, np.ndarray | None]]:
    """What structural similarity takes window means of: both, their squares and their product."""
    return [(image, None), (photo, None), (image, image), (photo, photo), (image, photo)]
