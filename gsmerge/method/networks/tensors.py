"""Apply corrections to tensors with gradients, as :mod:`gsmerge.method.networks.corrections` does to arrays."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsmerge.method.geometry.transforms import rotation_entries
from gsmerge.method.networks.corrections import (
    COLOR_COLUMNS,
    LOGIT_COLUMN,
    MEAN_COLUMNS,
    ROTATION_COLUMNS,
    SIZE_COLUMNS,
)
from gsmerge.types import SH_C0, Gaussians


def gaussian_sizes(scales: Tensor) -> Tensor:
    """Return the size ``[n]`` of each Gaussian, which is the geometric mean of its two largest ``scales [n,3]``."""
    top = scales.sort(-1).values
    return (top[..., 1] * top[..., 2]).sqrt()


def quat_to_rotmat(quats: Tensor) -> Tensor:
    """Convert quaternions ``[...,4]`` to rotation matrices ``[...,3,3]``, with gradients."""
    entries = rotation_entries(*normalize(quats, dim=-1).unbind(-1))
    return torch.stack(entries, -1).reshape(*quats.shape[:-1], 3, 3)


def rotate_quats(vectors: Tensor, quats: Tensor) -> Tensor:
    """Rotate quaternions ``[n,4]`` by rotation vectors ``[n,3]`` in world axes."""
    half = (vectors.square().sum(-1, keepdim=True) + 1e-20).sqrt() / 2  # the addend makes the gradient at zero finite
    w = half.cos()[:, 0]
    x, y, z = (half.sin() / (2 * half) * vectors).unbind(-1)
    a, b, c, d = quats.unbind(-1)
    return torch.stack(
        [w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c,
         w * c - x * d + y * a + z * b, w * d + x * c - y * b + z * a], -1,
    )  # fmt: skip


def rotate_vectors(frames: Tensor, vectors: Tensor) -> Tensor:
    """Rotate ``vectors [n,3]`` from their ``frames [n,3,3]``, whose columns are the axes, into the world."""
    return (frames @ vectors[:, :, None])[:, :, 0]


def skew_vectors(matrices: Tensor) -> Tensor:
    """Return the axial vectors ``[n,3]`` of the skew-symmetric parts of matrices ``[n,3,3]``."""
    skew = (matrices - matrices.transpose(1, 2)) / 2
    return torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], 1)


def move_tensors(gaussians: Gaussians, residuals: Tensor, frames: Tensor) -> Gaussians:
    """Apply corrections ``residuals [n,13]`` to Gaussians, in ``frames [n,3,3]`` whose columns are axes."""
    g = gaussians
    opacities = g.opacities
    factor = torch.exp(residuals[:, LOGIT_COLUMN])
    return replace(
        g,
        means=g.means + rotate_vectors(frames, residuals[:, MEAN_COLUMNS] * gaussian_sizes(g.scales)[:, None]),
        quats=rotate_quats(rotate_vectors(frames, residuals[:, ROTATION_COLUMNS]), g.quats),
        scales=g.scales * torch.exp(residuals[:, SIZE_COLUMNS]),
        opacities=(opacities * factor / (1 + opacities * (factor - 1))).clamp(0, 1),  # adds the correction to the logit
        sh0=g.sh0 + residuals[:, None, COLOR_COLUMNS] / SH_C0,
    )
