"""The image loss of the full fit: L1 and structural similarity.

The structural similarity of the loss, :func:`loss_ssim`, is that of training too. It has uniform windows, which are
quick to differentiate, so its values differ from the measured ones of :func:`gsmerge.render.metrics.ssim`.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gsmerge.kernels.gaussians.optimise import C1, C2, similarity_terms
from gsmerge.runtime.threads import parallel_map

LOSS_WINDOW = 7  # pixels per side of the windows of loss_ssim


def _box(array: np.ndarray) -> np.ndarray:
    """Window means; zero beyond the border, so that the operator is its own transpose."""
    return cv2.blur(array, (LOSS_WINDOW, LOSS_WINDOW), borderType=cv2.BORDER_CONSTANT)


def loss_ssim(image: Tensor, photo: Tensor) -> Tensor:
    """``[h,w,3]`` structural similarity of the loss about every pixel of images ``[h,w,3]``, differentiable.

    Uniform windows of 7 x 7 pixels, zero beyond the border, population covariances, K1 = .01, K2 = .03.
    """
    stacked = torch.stack([image, photo, image * image, photo * photo, image * photo]).permute(0, 3, 1, 2)
    mx, my, xx, yy, xy = avg_pool2d(stacked, LOSS_WINDOW, 1, LOSS_WINDOW // 2).permute(0, 2, 3, 1)
    c1, c2 = float(C1), float(C2)
    above = (2 * mx * my + c1) * (2 * (xy - mx * my) + c2)
    return above / ((mx * mx + my * my + c1) * (xx - mx * mx + yy - my * my + c2))


def image_gradient(image: np.ndarray, photo: np.ndarray, weight: np.ndarray, ssim_lambda: float) -> np.ndarray:
    """Gradient of the loss (1 - dssim) |image - photo| + dssim (1 - SSIM), per pixel of the image.

    Args:
        image: ``[h,w,3]`` float32.
        photo: ``[h,w,3]`` float32.
        weight: ``[h,w]`` float32 weights of the pixels.
        ssim_lambda: Share of structural similarity, see :func:`loss_ssim`.

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
