"""Exporters that merge Gaussians in voxels: no row belongs to a pixel."""

from __future__ import annotations

import torch
from torch import Tensor

from gsmerge.io.exporters.exporter import Exporter
from gsmerge.types import Gaussians

MIN_PADDING = 16  # equal rows at the origin: fewer may be Gaussians

ANYSPLAT = Exporter("anysplat", "AnySplat", "raw", "none")
WORLDMIRROR = Exporter("worldmirror", "WorldMirror", "raw", "none")


def is_padding(gaussians: Gaussians) -> Tensor:
    """``[n]`` bool: rows at the very origin that are all alike: VolSplat fills its files up with them."""
    rows = torch.nonzero((gaussians.means == 0).all(1))[:, 0]
    padding = torch.zeros(len(gaussians), dtype=torch.bool)
    if len(rows) < MIN_PADDING:
        return padding
    shape = torch.cat([gaussians.scales, gaussians.opacities[:, None], gaussians.sh0[:, 0]], 1)[rows]
    padding[rows[(shape == shape.median(0).values).all(1)]] = True
    return padding
