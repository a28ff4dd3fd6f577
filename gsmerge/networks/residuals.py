"""Bounded corrections of Gaussians and Feature Gaussians; a correction of zero changes no bit.

A correction has 13 columns: shift of the mean (3) and rotation vector (3) in the group's frame, change of the log
scales (3) along the principal axes, of the opacity (1) and of the base colour (3).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsmerge.geometry import quat_to_rotmat
from gsmerge.networks.options import Bounds
from gsmerge.types import SH_C0, FeatureGaussians, Gaussians

MEAN, SIZE, TURN, LOGIT, COLOR = slice(0, 3), slice(3, 6), slice(6, 9), 9, slice(10, 13)
RESIDUAL = 13
HALF = 0.5  # of the bounds, for every stage before the decoder


def limits(bounds: Bounds) -> Tensor:
    """``[13]`` largest correction of every column."""
    b = bounds
    return torch.tensor([b.mean] * 3 + [b.size] * 3 + [b.turn] * 3 + [b.logit] + [b.color] * 3)


def bounded(raw: Tensor, bounds: Bounds, share: float = 1.0) -> Tensor:
    """Corrections ``[...,13]`` of raw outputs: within ``share`` of the bounds, whatever the network says."""
    return share * limits(bounds).to(raw) * tanh_bounded(raw)


def tanh_bounded(raw: Tensor) -> Tensor:
    """Raw outputs between -1 and 1; what is not a number becomes 0."""
    return torch.tanh(raw.nan_to_num())


def sizes_of(scales: Tensor) -> Tensor:
    """``[n]`` size of Gaussians: geometric mean of the two largest of ``scales [n,3]``."""
    top = scales.sort(-1).values
    return (top[..., 1] * top[..., 2]).sqrt()


def turn_matrices(vectors: Tensor) -> Tensor:
    """Rotations ``[n,3,3]`` of rotation vectors ``[n,3]`` (Rodrigues); the identity, exactly, of zero."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    angle = vectors.norm(dim=-1).clamp_min(1e-12)[:, None, None]
    return torch.eye(3).to(vectors) + angle.sin() / angle * cross + (1 - angle.cos()) / angle**2 * (cross @ cross)


def turn_quats(vectors: Tensor, quats: Tensor) -> Tensor:
    """Quaternions ``[n,4]`` turned by rotation vectors ``[n,3]`` in the world."""
    half = vectors.norm(dim=-1, keepdim=True).clamp_min(1e-12) / 2
    w, (x, y, z) = half.cos()[:, 0], (half.sin() / (2 * half) * vectors).unbind(-1)
    a, b, c, d = quats.unbind(-1)
    return torch.stack(
        [w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c,
         w * c - x * d + y * a + z * b, w * d + x * c - y * b + z * a], -1,
    )  # fmt: skip


def rotated(frames: Tensor, vectors: Tensor) -> Tensor:
    """Vectors ``[n,3]`` of frames ``[n,3,3]`` in the world."""
    return (frames @ vectors[:, :, None])[:, :, 0]


def move_gaussians(gaussians: Gaussians, residuals: Tensor, frames: Tensor) -> Gaussians:
    """Gaussians with corrections.

    Args:
        gaussians: n Gaussians.
        residuals: ``[n,13]``.
        frames: ``[n,3,3]`` axes of each Gaussian's group as columns, world.
    """
    g = gaussians
    odds, factor = g.opacities, torch.exp(residuals[:, LOGIT])
    return replace(
        g,
        means=g.means + rotated(frames, residuals[:, MEAN] * sizes_of(g.scales)[:, None]),
        quats=turn_quats(rotated(frames, residuals[:, TURN]), g.quats),
        scales=g.scales * torch.exp(residuals[:, SIZE]),
        opacities=(odds * factor / (1 + odds * (factor - 1))).clamp(0, 1),  # the logit plus the correction
        sh0=g.sh0 + residuals[:, None, COLOR] / SH_C0,
    )


def move_features(features: FeatureGaussians, base: Gaussians, residuals: Tensor, frames: Tensor) -> FeatureGaussians:
    """Feature Gaussians with corrections: opacity stays where scales change, and changes with its own column.

    Args:
        features: g Feature Gaussians.
        base: The Gaussian of each, see :func:`gsmerge.moments.feature_to_gaussians`.
        residuals: ``[g,13]``; the tenth is added to the logarithm of the optical depth.
        frames: ``[g,3,3]`` axes of each group as columns, world.
    """
    wide, frames = residuals.double(), frames.double()
    axes = quat_to_rotmat(base.quats.double())
    stretch = torch.eye(3).double() + axes @ (torch.expm1(wide[:, SIZE])[:, :, None] * axes.transpose(1, 2))
    change = turn_matrices(rotated(frames, wide[:, TURN])) @ stretch
    covars = change @ features.covars.double() @ change.transpose(1, 2)
    depth = wide[:, LOGIT]
    disc = wide[:, SIZE][:, 1:].sum(1)  # of the two larger axes: principal axes rise
    shift = rotated(frames, wide[:, MEAN] * sizes_of(base.scales / features.spreads[:, None]).double()[:, None])
    shift = torch.where(shift.isfinite(), shift, 0)  # of what is as far away as numbers go
    return replace(
        features,
        means=(features.means + shift).float(),
        covars=((covars + covars.transpose(1, 2)) / 2).float(),
        masses=(features.masses * torch.exp(depth + wide[:, SIZE].sum(1))).float(),
        extinctions=(features.extinctions * torch.exp(depth + disc)).float(),
        sh0=features.sh0 + residuals[:, None, COLOR] / SH_C0,
    )
