"""Gaussians without a scene."""

from __future__ import annotations

import torch

from gsmerge import Gaussians


def some(count: int, seed: int = 0, degree: int = 1) -> Gaussians:
    """Random ones about the origin, of any shape, opacity and colour."""
    rng = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(count, 3, generator=rng),
        quats=torch.nn.functional.normalize(torch.randn(count, 4, generator=rng), dim=1),
        scales=torch.rand(count, 3, generator=rng) * 0.1 + 0.01,
        opacities=torch.rand(count, generator=rng) * 0.9 + 0.05,
        sh0=torch.randn(count, 1, 3, generator=rng),
        shN=torch.randn(count, (degree + 1) ** 2 - 1, 3, generator=rng),
    )
