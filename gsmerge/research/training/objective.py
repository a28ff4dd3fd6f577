"""What a step makes smaller: corrections as the fit has them, or renders against photos and what goes with them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from gsmerge.networks import Networks
from gsmerge.networks.residuals import RESIDUAL, ROTATION, residual_limits
from gsmerge.research.training.examples import Example
from gsmerge.research.training.options import TrainOptions
from gsmerge.research.training.photometric import draw_window, photometric_loss
from gsmerge.research.training.predict import Crop, foreseen, predicted
from gsmerge.research.training.regularizers import diversity_loss, teacher_loss
from gsmerge.research.training.windows import Window

MANY = 4.0  # targets are held within so many standard deviations


def target_scales(examples: Sequence[Example]) -> dict[int, Tensor]:
    """``[13]`` standard deviation of every column of the targets of each K, at least a thousandth."""
    found = {}
    for k in examples[0].levels:
        levels = [example.levels[k] for example in examples]
        targets = torch.cat([level.targets[level.mask] for level in levels])
        found[k] = targets.std(0, correction=0).clamp_min(1e-3)
    return found


def compared(
    crop: Crop, networks: Networks, scales: Mapping[int, Tensor], options: TrainOptions, seed: int
) -> tuple[Tensor, Tensor]:
    """``[j,13]`` corrections and targets of the judged children, in standard deviations of the targets.

    Targets are held within what the networks can say, and within a few standard deviations.
    """
    return _scaled(crop, predicted(crop, networks, seed), scales, options)


def _scaled(
    crop: Crop, corrections: Tensor, scales: Mapping[int, Tensor], options: TrainOptions
) -> tuple[Tensor, Tensor]:
    """:func:`compared` of corrections ``[n,13]`` that are known."""
    targets = crop.example.levels[crop.k].targets[crop.children[crop.judged]]
    most = 2 * residual_limits(options.network.bounds)  # of all stages together
    found = corrections[crop.judged]
    return found / scales[crop.k], (targets.clamp(-most, most) / scales[crop.k]).clamp(-MANY, MANY)


def correction_loss(found: Tensor, wanted: Tensor, options: TrainOptions) -> Tensor:
    """Mean smooth L1 of corrections ``[j,13]``; 0 of none."""
    weights = torch.ones(RESIDUAL)
    weights[ROTATION] = options.turn_weight
    losses = torch.nn.functional.smooth_l1_loss(found, wanted, reduction="none") * weights
    return losses.sum() / (weights.sum() * max(1, len(wanted)))


def window_loss(
    networks: Networks,
    window: Window,
    scales: Mapping[int, Tensor],
    options: TrainOptions,
    step: int,
    rng: np.random.Generator,
) -> Tensor:
    """Loss of a window of a photo: its render on a random background, and what holds the Gaussians in it.

    Args:
        networks: All of them.
        window: What is rendered.
        scales: Standard deviations of the targets of each K.
        options: Weights.
        step: Tells those that fall.
        rng: Chooses the background.
    """
    crop = window.crop
    found = foreseen(crop, networks, step)
    image = draw_window(found.gaussians, window, rng.random(3, dtype=np.float32))
    loss = photometric_loss(image, window, options)
    regression, teacher, diversity = options.held_by(step)
    if regression:
        loss = loss + regression * correction_loss(*_scaled(crop, found.corrections, scales, options), options)
    if teacher:
        loss = loss + teacher * teacher_loss(found.corrections)
    if diversity and crop.k > 1:
        loss = loss + diversity * diversity_loss(found.gaussians, crop.example.levels[crop.k].parents[crop.children])
    return loss
