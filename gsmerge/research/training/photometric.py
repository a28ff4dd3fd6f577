"""The loss on renders: what the networks make of a scene against photos of it (paper section 4.6).

A window of a photo is rendered from all Feature Gaussians that reach into it, each taken through all networks. Pixels
that the scene has nothing to show for do not count, so that nothing is drawn to where only a guess could be.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsmerge.measure.lpips import lpips_loss
from gsmerge.networks import Networks
from gsmerge.render.autograd import render_differentiable
from gsmerge.render.photos import NEAR
from gsmerge.research.training.options import TrainOptions
from gsmerge.research.training.predict import foreseen
from gsmerge.research.training.windows import Window
from gsmerge.stages.fit.loss import loss_ssim
from gsmerge.types import Gaussians

BEST = 100.0  # dB: PSNR of windows without an error


def draw_window(gaussians: Gaussians, window: Window, background: np.ndarray) -> Tensor:
    """``[h,w,3]`` render of a window, differentiable."""
    eps2d = window.crop.example.photos.eps2d
    drawn = render_differentiable(
        gaussians, window.camera, background, with_depths=False, eps2d=eps2d, near=NEAR
    )  # fmt: skip
    return drawn.images[0]


def color_difference(image: Tensor, photo: Tensor, mask: Tensor, kind: str) -> Tensor:
    """Mean absolute (``"l1"``) or squared (``"mse"``) difference of images ``[h,w,3]`` where ``mask [h,w]`` is."""
    difference = (image - photo).abs() if kind == "l1" else (image - photo).square()
    return (difference * mask[..., None]).sum() / (3 * mask.sum()).clamp_min(1)


def masked_ssim(image: Tensor, photo: Tensor, mask: Tensor) -> Tensor:
    """Mean :func:`gsmerge.stages.fit.loss.loss_ssim` of images ``[h,w,3]`` where ``mask [h,w]`` is; 1 where nowhere."""
    if not bool(mask.any()):
        return torch.ones(())
    return (loss_ssim(image, photo).mean(-1) * mask).sum() / mask.sum()


def photometric_loss(image: Tensor, window: Window, options: TrainOptions) -> Tensor:
    """Weighted sum of the difference of colours, 1 - SSIM and, if it has a weight, LPIPS (VGG)."""
    example = window.crop.example
    photo, mask = window.part(example.photos.images), window.part(example.masks)
    color = color_difference(image, photo, mask, options.photo_loss)
    similar = masked_ssim(image, photo, mask) if options.ssim_weight else torch.ones(())
    loss = options.photo_weight * color + options.ssim_weight * (1 - similar)
    return loss + options.lpips_weight * lpips_loss(image, photo, mask) if options.lpips_weight else loss


def plain_render(window: Window, networks: Networks | None) -> Tensor:
    """``[h,w,3]`` render of a window on black within [0, 1]; None: of what the analytic stages alone make."""
    crop = window.crop
    with torch.no_grad():
        if networks is None:
            gaussians = crop.example.levels[crop.k].children[crop.children]
        else:
            gaussians = foreseen(crop, networks, 0).gaussians
        return draw_window(gaussians, window, np.zeros(3, np.float32)).clamp(0, 1)


def window_psnr(window: Window, networks: Networks | None) -> float:
    """PSNR (dB) of :func:`plain_render` where the mask is."""
    example = window.crop.example
    photo, mask = window.part(example.photos.images), window.part(example.masks)
    error = float(color_difference(plain_render(window, networks), photo, mask, "mse"))
    return min(BEST, -10 * float(np.log10(max(error, 1e-12))))
