"""The losses: corrections compared with those of the fit, renders compared with photos, and regularizers.

A window of a photo is rendered from all Feature Gaussians that reach into it, each run through all networks (paper
section 4.6). Pixels that the scene does not cover have no loss, so that networks need not guess them. Regularizers keep
early training near the analytic result, which is the paper's teacher, and siblings apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from gsmerge.geometry import quat_to_rotmat
from gsmerge.measure.lpips import lpips_loss
from gsmerge.networks import Networks
from gsmerge.networks.residuals import RESIDUAL, ROTATION, residual_limits
from gsmerge.render.autograd import render_differentiable
from gsmerge.render.photos import NEAR
from gsmerge.research.training.examples import Example
from gsmerge.research.training.options import TrainOptions
from gsmerge.research.training.predict import Crop, predict, predict_corrections
from gsmerge.research.training.windows import Window
from gsmerge.stages.fit.loss import loss_ssim
from gsmerge.types import Gaussians

MAX_DEVIATIONS = 4.0  # standard deviations that targets are clamped to


def target_scales(examples: Sequence[Example]) -> dict[int, Tensor]:
    """``[13]`` standard deviation of every column of the targets of each K, at least a thousandth."""
    scales = {}
    for k in examples[0].levels:
        levels = [example.levels[k] for example in examples]
        targets = torch.cat([level.targets[level.mask] for level in levels])
        scales[k] = targets.std(0, correction=0).clamp_min(1e-3)
    return scales


def scaled_corrections(
    crop: Crop, networks: Networks, scales: Mapping[int, Tensor], options: TrainOptions, seed: int
) -> tuple[Tensor, Tensor]:
    """``[j,13]`` corrections and targets of the scored children, in standard deviations of the targets.

    Targets are clamped to the bounds of the networks, and to a few standard deviations.
    """
    return _scaled(crop, predict_corrections(crop, networks, seed), scales, options)


def _scaled(
    crop: Crop, corrections: Tensor, scales: Mapping[int, Tensor], options: TrainOptions
) -> tuple[Tensor, Tensor]:
    """:func:`scaled_corrections` of corrections ``[n,13]`` that are known."""
    targets = crop.example.levels[crop.k].targets[crop.children[crop.scored]]
    limits = 2 * residual_limits(options.network.bounds)  # of all stages together
    clamped = targets.clamp(-limits, limits) / scales[crop.k]
    return corrections[crop.scored] / scales[crop.k], clamped.clamp(-MAX_DEVIATIONS, MAX_DEVIATIONS)


def correction_loss(corrections: Tensor, targets: Tensor, options: TrainOptions) -> Tensor:
    """Mean smooth L1 of corrections ``[j,13]``; 0 of none."""
    weights = torch.ones(RESIDUAL)
    weights[ROTATION] = options.turn_weight
    losses = torch.nn.functional.smooth_l1_loss(corrections, targets, reduction="none") * weights
    return losses.sum() / (weights.sum() * max(1, len(targets)))


def window_loss(
    networks: Networks,
    window: Window,
    scales: Mapping[int, Tensor],
    options: TrainOptions,
    step: int,
    rng: np.random.Generator,
) -> Tensor:
    """Loss of a window of a photo: its render on a random background, and the regularizers of its Gaussians.

    ``scales`` are the standard deviations of the targets of each K, see :func:`target_scales`.
    """
    crop = window.crop
    prediction = predict(crop, networks, step)
    image = draw_window(prediction.gaussians, window, rng.random(3, dtype=np.float32))
    loss = photometric_loss(image, window, options)
    regression, teacher, diversity = options.regularizer_weights(step)
    if regression:
        loss = loss + regression * correction_loss(*_scaled(crop, prediction.corrections, scales, options), options)
    if teacher:
        loss = loss + teacher * teacher_loss(prediction.corrections)
    if diversity and crop.k > 1:
        loss = loss + diversity * diversity_loss(
            prediction.gaussians, crop.example.levels[crop.k].parents[crop.children]
        )
    return loss


MAX_DB = 100.0  # PSNR of windows without an error


def draw_window(gaussians: Gaussians, window: Window, background: np.ndarray) -> Tensor:
    """``[h,w,3]`` render of a window, differentiable."""
    eps2d = window.crop.example.photos.eps2d
    drawn = render_differentiable(
        gaussians, window.camera, background, with_depths=False, eps2d=eps2d, near=NEAR
    )  # fmt: skip
    return drawn.images[0]


def color_loss(image: Tensor, photo: Tensor, mask: Tensor, kind: str) -> Tensor:
    """Mean absolute (``"l1"``) or squared (``"mse"``) difference of images ``[h,w,3]`` within ``mask [h,w]``."""
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
    color = color_loss(image, photo, mask, options.photo_loss)
    similar = masked_ssim(image, photo, mask) if options.ssim_weight else torch.ones(())
    loss = options.photo_weight * color + options.ssim_weight * (1 - similar)
    return loss + options.lpips_weight * lpips_loss(image, photo, mask) if options.lpips_weight else loss


def render_window(window: Window, networks: Networks | None) -> Tensor:
    """``[h,w,3]`` render of a window on black within [0, 1]; None: of the analytic stages alone."""
    crop = window.crop
    with torch.no_grad():
        if networks is None:
            gaussians = crop.example.levels[crop.k].children[crop.children]
        else:
            gaussians = predict(crop, networks, 0).gaussians
        return draw_window(gaussians, window, np.zeros(3, np.float32)).clamp(0, 1)


def window_psnr(window: Window, networks: Networks | None) -> float:
    """PSNR (dB) of :func:`render_window` within the mask."""
    example = window.crop.example
    photo, mask = window.part(example.photos.images), window.part(example.masks)
    error = float(color_loss(render_window(window, networks), photo, mask, "mse"))
    return min(MAX_DB, -10 * float(np.log10(max(error, 1e-12))))


GOAL = 0.5  # overlap of the boxes of two children that has no loss
GEOMETRY, OPACITY = 0.75, 0.25  # weights of the two terms of the diversification


def teacher_loss(corrections: Tensor) -> Tensor:
    """Size of corrections ``[n,13]``: the angle of the rotation, and L1 of everything else.

    The analytic ones are the moment-matched teacher of the paper; corrections are the difference to it, in sizes of
    the Gaussian, logarithms and logits. The length of a rotation vector is the geodesic distance of the quaternions.
    """
    if len(corrections) == 0:
        return corrections.new_zeros(())
    rest = torch.cat([corrections[:, : ROTATION.start], corrections[:, ROTATION.stop :]], 1)
    return corrections[:, ROTATION].norm(dim=1).mean() + rest.abs().mean()


def diversity_loss(gaussians: Gaussians, parents: Tensor) -> Tensor:
    """Pairs of siblings (``parents [n]``) that overlap too much or too little, or differ in opacity (paper supplement).

    Pairs are weighted by their volumes, divided by their mean over all pairs and without gradient: otherwise the loss
    would depend on the scale of the world, and shrinking would be the easiest way to lower it.
    """
    one, other = sibling_pairs(parents)
    if len(one) == 0:
        return gaussians.means.new_zeros(())
    volumes = gaussians.scales.detach().prod(1)
    weights = (volumes[one] * volumes[other]).sqrt()
    weights = weights / weights.mean().clamp_min(1e-30)
    profile = overlap_profile(gaussians, one, other)
    opacity = (gaussians.opacities[one] - gaussians.opacities[other]).square()
    return (weights * (GEOMETRY * profile + OPACITY * opacity)).mean()


def sibling_pairs(parents: Tensor) -> tuple[Tensor, Tensor]:
    """Rows of all pairs of children with the same parent, each once."""
    count = int(torch.bincount(parents).max()) if len(parents) else 0
    rows = torch.arange(len(parents))
    firsts = [rows[: len(rows) - gap][parents[: len(rows) - gap] == parents[gap:]] for gap in range(1, count)]
    gaps = [torch.full_like(first, gap) for gap, first in enumerate(firsts, 1)]
    empty = rows[:0]
    one = torch.cat([empty, *firsts])
    return one, one + torch.cat([empty, *gaps])


def overlap_profile(gaussians: Gaussians, one: Tensor, other: Tensor) -> Tensor:
    """``[p]`` the paper's U-shaped profile of pairs: 0 where their boxes overlap by half.

    Boxes are those of one standard deviation along the world's axes, as in matching.
    """
    axes = quat_to_rotmat(gaussians.quats) * gaussians.scales[:, None]
    halves = axes.norm(dim=2)
    away = (gaussians.means[one] - gaussians.means[other]).abs()
    a, b = halves[one], halves[other]
    shared = torch.minimum(torch.minimum(a + b - away, 2 * a), 2 * b).clamp_min(0).prod(1)
    union = (8 * a.prod(1) + 8 * b.prod(1) - shared).clamp_min(1e-30)
    overlaps = shared / union
    contact = (a.norm(dim=1) + b.norm(dim=1)).clamp_min(1e-12)
    gaps = (away.norm(dim=1) - contact).clamp_min(0) / contact
    apart = 0.5 * ((GOAL - overlaps) / GOAL) ** 3 + 0.5 * (1 - torch.exp(-3 * gaps))
    return torch.where(overlaps >= GOAL, ((overlaps - GOAL) / (1 - GOAL)) ** 3, apart)
