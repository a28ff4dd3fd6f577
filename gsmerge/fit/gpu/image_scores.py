"""Image loss with gradient, exposures, and PSNR of held-out blocks on a device.

The gradient is written out, as in the kernel ``image_gradient``: half as many launches as through
autograd, and what depends on the photo alone is computed once.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gsmerge.kernels.raster.image_loss import C1, C2, SIDE


def window_means(planes: Tensor) -> Tensor:
    """Average over windows of 7 x 7 pixels around every pixel of planes ``[...,h,w]``; zero outside the planes."""
    return avg_pool2d(planes, SIDE, 1, SIDE // 2)


def photo_means(images: Tensor) -> Tensor:
    """Compute the window means ``[v,2,3,h,w]`` of photos ``[v,h,w,3]`` and of their squares."""
    planes = images.permute(0, 3, 1, 2)
    return torch.stack([window_means(planes), window_means(planes * planes)], 1)


def loss_gradient(
    image: Tensor, photo: Tensor, means: Tensor, weight: Tensor, ssim_lambda: float, edge_weight: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Return the gradient of :func:`gsmerge.fit.loss.image_gradient`'s loss, and the sum of squared errors.

    SSIM's windows are uniform, of 7 x 7 pixels, with population covariances, K1 = .01, K2 = .03
    (Wang et al. 2004). Images are ``[h,w,3]``, ``means [2,3,h,w]`` those of :func:`photo_means`,
    ``weight [h,w]`` weighs pixels. The gradient is divided by the number of pixels.
    """
    off = image - photo
    wide, pixels = weight[..., None], weight.numel()
    gradient = (1 - ssim_lambda) / pixels * wide * off.sign()
    if ssim_lambda > 0:
        similar = ssim_lambda / pixels * _ssim_gradient(image.permute(2, 0, 1), photo.permute(2, 0, 1), means, weight)
        gradient = gradient - similar.permute(1, 2, 0)
    if edge_weight > 0:
        _add_edges(gradient, off, wide, edge_weight / pixels)
    return gradient, (wide * off * off).sum()


def _add_edges(gradient: Tensor, off: Tensor, wide: Tensor, each: float) -> None:
    """Add to a gradient ``[h,w,3]`` that of the L1 of the differences of ``off`` to the right and below."""
    for axis in (0, 1):
        size = off.shape[axis] - 1
        pull = off.diff(dim=axis).sign() * each * wide.narrow(axis, 0, size).minimum(wide.narrow(axis, 1, size))
        gradient.narrow(axis, 1, size).add_(pull)
        gradient.narrow(axis, 0, size).sub_(pull)


def _ssim_gradient(x: Tensor, y: Tensor, means: Tensor, weight: Tensor) -> Tensor:
    """Differentiate the weighted sum of SSIM over the windows in the planes ``x [3,h,w]``."""
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


def score_blocks(images: Tensor, photos: Tensor, weights: Tensor, min_gain: float) -> float:
    """Return the PSNR (dB) on held-out blocks, as :func:`gsmerge.fit.photo_sizes.holdout_psnr` does on the CPU."""
    clipped = images.clamp(0, 1)
    gains = match_exposures(clipped, photos, weights, min_gain)
    mask = weights == 0
    squares = ((clipped * gains[:, None, None] - photos) ** 2).sum(-1) * mask
    error, count = squares.sum(dtype=torch.float64), mask.sum()
    return float(-10 * (error / (3 * count).clamp_min(1)).clamp_min(1e-12).log10())


def match_exposures(images: Tensor, photos: Tensor, weights: Tensor, min_gain: float, max_gain: float = 2.0) -> Tensor:
    """Return exposure factors ``[v,3]``, as :func:`gsmerge.fit.photo_sizes.exposure_gains` does on the CPU."""
    weighted = weights[..., None] * images
    with_photo, with_image = ((weighted * other).sum((1, 2), dtype=torch.float64) for other in (photos, images))
    gains = (with_photo / with_image.clamp_min(1e-9)).clamp(1 / max_gain, max_gain)
    gains = gains / gains.log().mean(0).exp()
    differs = gains.log().abs().max() >= math.log(min_gain)
    return torch.where(differs, gains, 1.0).float()
