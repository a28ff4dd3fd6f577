"""The image loss of the full fit: L1, structural similarity, and L1 of the differences between neighbouring pixels.

The structural similarity of the loss, :func:`loss_ssim`, is that of training too. It has uniform windows, which are
quick to differentiate, so its values differ from the measured ones of :func:`gsmerge.raster.metrics.ssim`.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy import float32 as f4

from gsmerge.kernels.raster import image_loss
from gsmerge.kernels.raster.image_loss import C1, C2
from gsmerge.runtime.threads import parallel_map, use_threads

if TYPE_CHECKING:
    from torch import Tensor

LOSS_WINDOW = image_loss.SIDE  # pixels per side of the windows of loss_ssim


def loss_ssim(image: Tensor, photo: Tensor) -> Tensor:
    """Compute the structural similarity ``[h,w,3]`` around every pixel, differentiable, as the loss uses it.

    Uniform windows of 7 x 7 pixels, zero beyond the border, population covariances, K1 = .01, K2 =
    .03.
    """
    import torch
    from torch.nn.functional import avg_pool2d

    stacked = torch.stack([image, photo, image * image, photo * photo, image * photo]).permute(0, 3, 1, 2)
    mx, my, xx, yy, xy = avg_pool2d(stacked, LOSS_WINDOW, 1, LOSS_WINDOW // 2).permute(0, 2, 3, 1)
    c1, c2 = float(C1), float(C2)
    above = (2 * mx * my + c1) * (2 * (xy - mx * my) + c2)
    return above / ((mx * mx + my * my + c1) * (xx - mx * mx + yy - my * my + c2))


def image_gradient(
    image: np.ndarray, photo: np.ndarray, weight: np.ndarray, ssim_lambda: float, edge_weight: float = 0.0
) -> tuple[np.ndarray, float]:
    """Return the gradient of (1 - l) |e| + l (1 - SSIM) + d (|right - e| + |below - e|), and the squared error.

    e is ``image - photo``, right and below its neighbours, l is ``ssim_lambda`` and d is
    ``edge_weight``. Images are ``[h,w,3]`` float32, pixels weigh ``weight [h,w]`` float32, and a
    pair of pixels the lesser weight. The gradient ``[h,w,3]`` is divided by the number of pixels, so
    that it means the same at every size; the squared errors are summed over all channels.
    """
    height, width = weight.shape
    gradient, errors = np.empty((height, 3 * width), np.float32), np.empty(height, np.float32)
    flat, goal = (np.ascontiguousarray(a, np.float32).reshape(height, -1) for a in (image, photo))
    with use_threads() as threads:
        cuts = [height * i // threads for i in range(threads + 1)]
        parallel_map(
            lambda span: image_loss.image_gradient(
                flat, goal, weight, f4(ssim_lambda), f4(edge_weight), *span, gradient, errors
            ),
            list(pairwise(cuts)),
        )
    return gradient.reshape(height, width, 3), float(errors.sum(dtype=np.float64))
