"""The image loss of the full fit and its gradient, on a device: :mod:`gsmerge.stages.fit.loss`.

The gradient is written out, as in the kernel ``image_gradient``: half as many launches as through autograd, and what
depends on the photo alone is computed once.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gsmerge.kernels.raster.image_loss import C1, C2, SIDE


@dataclass(frozen=True, eq=False)
class PhotoMeans:
    """Means over the windows about every pixel of V photos.

    Args:
        first: ``[v,3,h,w]`` of the values.
        square: ``[v,3,h,w]`` of their squares.
    """

    first: Tensor
    square: Tensor


def window_means(planes: Tensor) -> Tensor:
    """Means over the windows of 7 x 7 pixels about every pixel of planes ``[c,h,w]``, zero beyond the border."""
    return avg_pool2d(planes, SIDE, 1, SIDE // 2)


def photo_means(images: Tensor) -> PhotoMeans:
    """Means of photos ``[v,h,w,3]``."""
    planes = images.permute(0, 3, 1, 2)
    first, square = (torch.stack([window_means(one) for one in both]) for both in (planes, planes * planes))
    return PhotoMeans(first, square)


def loss_gradient(
    image: Tensor, photo: Tensor, means: tuple[Tensor, Tensor], weight: Tensor, ssim_lambda: float
) -> tuple[Tensor, Tensor]:
    """Gradient of (1 - l) |image - photo| + l (1 - SSIM), l = ``ssim_lambda``, and the weighted squared error.

    SSIM's windows are uniform, of 7 x 7 pixels, with population covariances, K1 = .01, K2 = .03 (Wang et al. 2004).

    Args:
        image: ``[h,w,3]``.
        photo: ``[h,w,3]``.
        means: ``[3,h,w]`` first and square of the photo's :class:`PhotoMeans`.
        weight: ``[h,w]`` weights of the pixels.
        ssim_lambda: Share of structural similarity.

    Returns:
        ``[h,w,3]`` divided by the number of pixels, and a number: the sum over all channels.
    """
    off = image - photo
    wide, pixels = weight[..., None], weight.numel()
    gradient = (1 - ssim_lambda) / pixels * wide * off.sign()
    if ssim_lambda > 0:
        similar = ssim_lambda / pixels * _ssim_gradient(image.permute(2, 0, 1), photo.permute(2, 0, 1), means, weight)
        gradient = gradient - similar.permute(1, 2, 0)
    return gradient, (wide * off * off).sum()


def _ssim_gradient(x: Tensor, y: Tensor, means: tuple[Tensor, Tensor], weight: Tensor) -> Tensor:
    """Gradient ``[3,h,w]`` of the weighted sum of SSIM over the windows in the planes ``x [3,h,w]``."""
    a, xx, xy = window_means(torch.cat([x, x * x, x * y])).split(3)
    b, yy = means
    c1, c2 = float(C1), float(C2)
    ab = a * b
    n1, n2 = 2 * ab + c1, 2 * (xy - ab) + c2
    squares = a * a + b * b
    d1, d2 = squares + c1, xx + yy - squares + c2
    q = weight / (d1 * d2)
    ssim = n1 * n2 / (d1 * d2)
    square, cross = -ssim * d1 * q, 2 * n1 * q
    plain = 2 * q * (b * n2 - a * ssim * d2) - 2 * a * square - b * cross
    # the transpose of a mean over windows with zeros beyond the border is the same mean
    by_mean, by_square, by_product = window_means(torch.cat([plain, square, cross])).split(3)
    return by_mean + 2 * by_square * x + by_product * y
