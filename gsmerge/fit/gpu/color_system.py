"""The least-squares system of the colours on a device; :mod:`gsmerge.fit.color` solves it.

The matrix of a view, applied to colours, is an image, and its transpose the gradient of an image: each view
is drawn once, and its transpose kept for as long as it is used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsmerge.fit.color import color_weights
from gsmerge.fit.gpu.device_photos import (
    DevicePhotos,
    draw_and_transpose,
    draw_black,
    draw_gaussians,
    shape_of,
)
from gsmerge.fit.gpu.image_scores import match_exposures, score_blocks
from gsmerge.settings.fit import FitOptions
from gsmerge.types import Gaussians


def color_system(gaussians: Gaussians, photos: DevicePhotos, options: FitOptions, seed: int) -> _DeviceSystem:
    """Make the least-squares system of the base colours; ``seed`` chooses the held-out blocks."""
    device = gaussians.means.device
    weights = torch.from_numpy(np.stack(color_weights(photos.host, options, seed))).to(device)
    images = torch.stack([draw_gaussians(gaussians, photos, view) for view in range(len(photos))])
    return _DeviceSystem(
        gaussians, photos, options, images, weights, weights, torch.ones(len(photos), 3, device=device)
    )


@dataclass(frozen=True, eq=False)
class _DeviceSystem:
    """Colour system of tensors, see :class:`gsmerge.fit.color.ColorSystem`."""

    gaussians: Gaussians  # n Gaussians, whose geometry stays
    photos: DevicePhotos  # V photos
    options: FitOptions  # The solver's settings
    images: Tensor  # [v,h,w,3] renders with the colours as they were
    train: Tensor  # [v,h,w] 0 on the held-out blocks, 1 elsewhere
    weights: Tensor  # [v,h,w] of the pixels
    gains: Tensor  # [v,3] exposures
    precision: float = 0.0

    def _fitted(self, x: Tensor) -> Tensor:
        """Render all photos ``[v,h,w,3]`` with offsets."""
        shape, colors = shape_of(self.gaussians), x.float()
        return torch.stack([image + draw_black(shape, colors, self.photos, i) for i, image in enumerate(self.images)])

    def score(self, x: Tensor | None = None) -> float:
        images = self.images if x is None else self._fitted(x)
        return score_blocks(images, self.photos.images, self.train, self.options.tuning.min_gain)

    def residual(self, x: Tensor) -> tuple[Tensor, Tensor]:
        mass, gradient = torch.zeros_like(x), torch.zeros_like(x)
        for view, image in enumerate(self.images):
            weight, gain = self.weights[view][..., None], self.gains[view]
            added, transpose, _ = draw_and_transpose(shape_of(self.gaussians), x.float(), self.photos, view)
            residual = weight * (self.photos.images[view] - gain * (image + added))
            mass += transpose(weight.expand_as(image)) * gain**2
            gradient += transpose(residual) * gain
        return mass, gradient

    def normal(self, x: Tensor) -> Tensor:
        total = torch.zeros_like(x)
        for view in range(len(self.images)):
            image, transpose, _ = draw_and_transpose(shape_of(self.gaussians), x.float(), self.photos, view)
            total += transpose(image * self.weights[view][..., None]) * self.gains[view] ** 2
        return total

    def reweigh(self, x: Tensor, *, everywhere: bool = False) -> _DeviceSystem:
        images, photos, tuning = self._fitted(x), self.photos.images, self.options.tuning
        base = torch.where(self.train == 0, 1.0, self.train) if everywhere else self.train
        error = ((photos - images) ** 2).mean(-1).sqrt()
        robust = base * (tuning.huber / error.clamp_min(1e-6)).clamp_max(1)
        calm = base * (error < 2 * tuning.huber)
        gains = match_exposures(images, photos, calm, tuning.min_gain, tuning.max_gain)
        return replace(self, weights=robust, gains=gains)
