"""Structural similarity in the loss of training, by the formula that the full fit uses.

The windows are uniform, which makes the gradient quick. The SSIM of reports, :func:`gsmerge.raster.metrics.ssim`, has
Gaussian windows, so its values differ. The full fit takes its loss and gradient from
``gsmerge/kernels/raster/step``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gsmerge.kernels.raster.step import C1, C2, WINDOW_SIDE

if TYPE_CHECKING:
    from torch import Tensor

LOSS_WINDOW = WINDOW_SIDE  # pixels per side of the windows of loss_ssim


def loss_ssim(image: Tensor, photo: Tensor) -> Tensor:
    """Compute the structural similarity ``[h,w,3]`` of image and photo around every pixel, differentiable by torch.

    Windows are uniform, and have ``LOSS_WINDOW`` pixels per side. Pixels beyond the border are zero. Covariances are
    sums divided by the number of pixels. The constants of SSIM are K1 = .01 and K2 = .03.
    """
    import torch
    from torch.nn.functional import avg_pool2d

    stacked = torch.stack([image, photo, image * image, photo * photo, image * photo]).permute(0, 3, 1, 2)
    mx, my, xx, yy, xy = avg_pool2d(stacked, LOSS_WINDOW, 1, LOSS_WINDOW // 2).permute(0, 2, 3, 1)
    c1, c2 = float(C1), float(C2)
    numerator = (2 * mx * my + c1) * (2 * (xy - mx * my) + c2)
    return numerator / ((mx * mx + my * my + c1) * (xx - mx * mx + yy - my * my + c2))
