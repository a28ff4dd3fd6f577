"""Bounded corrections of Gaussians and Feature Gaussians; a correction of zero changes no bit.

A correction has 13 columns: shift of the mean (3) and rotation vector (3) in the group's frame, change of the log
scales (3) along the principal axes, of the opacity (1) and of the base colour (3).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsmerge.geometry import rotation_entries
from gsmerge.types import SH_C0, FeatureGaussians, Gaussians, as_array, as_tensor

MEAN, SIZE, ROTATION, LOGIT, COLOR = slice(0, 3), slice(3, 6), slice(6, 9), 9, slice(10, 13)
RESIDUAL = 13
ROWS = 65_536  # that are moved at once: their float64 matrices are ten times as large as they
HALF = 0.5  # share of the bounds that each stage before the decoder may use


@dataclass(frozen=True)
class Bounds:
    """Largest correction that the decoder may make, 0: none; merger, refiner and encoder may each make half of it.

    Args:
        mean: Shift along each axis of the group's frame, in units of the Gaussian's size.
        size: Change of each log scale.
        turn: Rotation about each axis of the group's frame, radians.
        logit: Change of the opacity's logit; of Feature Gaussians, of the logarithm of the optical depth.
        color: Change of each channel of the base colour, sRGB in [0, 1].

    Raises:
        ValueError: If one is below 0, or too large to bound anything.
    """

    mean: float = 1.0
    size: float = 1.1
    turn: float = 0.5
    logit: float = 3.0
    color: float = 0.25

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 8:
                raise ValueError(f"{f.name}: expected a number from 0 to 8, got {value!r}")


WIDE = Bounds(mean=4.0, size=6.0, turn=3.2, logit=8.0, color=0.75)  # of absolute outputs


def residual_limits(bounds: Bounds) -> Tensor:
    """Return the largest correction of every column, ``[13]``."""
    b = bounds
    return torch.tensor([b.mean] * 3 + [b.size] * 3 + [b.turn] * 3 + [b.logit] + [b.color] * 3)


def bound_residuals(raw: Tensor, bounds: Bounds, share: float = 1.0) -> Tensor:
    """Convert raw outputs to corrections ``[...,13]`` within ``share`` of the bounds."""
    return share * residual_limits(bounds).to(raw) * tanh_bounded(raw)


def tanh_bounded(raw: Tensor) -> Tensor:
    """Compute the tanh of raw outputs, with 0 for NaN."""
    return torch.tanh(raw.nan_to_num())


def gaussian_sizes(scales: Tensor) -> Tensor:
    """Compute the sizes ``[n]`` of Gaussians: geometric mean of the two largest of ``scales [n,3]``."""
    top = scales.sort(-1).values
    return (top[..., 1] * top[..., 2]).sqrt()


def quat_to_rotmat(quats: Tensor) -> Tensor:
    """Convert quaternions ``[...,4]`` to rotations ``[...,3,3]``, differentiable."""
    entries = rotation_entries(*normalize(quats, dim=-1).unbind(-1))
    return torch.stack(entries, -1).reshape(*quats.shape[:-1], 3, 3)


def rotation_matrices(vectors: Tensor) -> Tensor:
    """Convert rotation vectors ``[n,3]`` to rotations ``[n,3,3]`` (Rodrigues); zero to exactly the identity."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    angle = vectors.norm(dim=-1).clamp_min(1e-12)[:, None, None]
    return torch.eye(3).to(vectors) + angle.sin() / angle * cross + (1 - angle.cos()) / angle**2 * (cross @ cross)


def rotate_quats(vectors: Tensor, quats: Tensor) -> Tensor:
    """Rotate quaternions ``[n,4]`` by rotation vectors ``[n,3]`` in the world."""
    half = vectors.norm(dim=-1, keepdim=True).clamp_min(1e-12) / 2
    w, (x, y, z) = half.cos()[:, 0], (half.sin() / (2 * half) * vectors).unbind(-1)
    a, b, c, d = quats.unbind(-1)
    return torch.stack(
        [w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c,
         w * c - x * d + y * a + z * b, w * d + x * c - y * b + z * a], -1,
    )  # fmt: skip


def rotate_vectors(frames: Tensor, vectors: Tensor) -> Tensor:
    """Convert vectors ``[n,3]`` from frames ``[n,3,3]`` to the world."""
    return (frames @ vectors[:, :, None])[:, :, 0]


def move_gaussians(gaussians: Gaussians, residuals: Tensor, frames: Tensor) -> Gaussians:
    """Apply corrections ``[n,13]`` to n Gaussians, tensors, in frames ``[n,3,3]`` with axes as columns, world."""
    g = gaussians
    odds, factor = g.opacities, torch.exp(residuals[:, LOGIT])
    return replace(
        g,
        means=g.means + rotate_vectors(frames, residuals[:, MEAN] * gaussian_sizes(g.scales)[:, None]),
        quats=rotate_quats(rotate_vectors(frames, residuals[:, ROTATION]), g.quats),
        scales=g.scales * torch.exp(residuals[:, SIZE]),
        opacities=(odds * factor / (1 + odds * (factor - 1))).clamp(0, 1),  # the logit plus the correction
        sh0=g.sh0 + residuals[:, None, COLOR] / SH_C0,
    )


def move_features(features: FeatureGaussians, base: Gaussians, residuals: Tensor, frames: Tensor) -> FeatureGaussians:
    """Apply corrections ``[g,13]`` to Feature Gaussians; opacity depends only on its own column, not on the scales.

    ``base`` has the Gaussian of each as tensors, ``frames [g,3,3]`` the axes of each group as columns, world. Gradients
    end here. The tenth correction is added to the logarithm of the integrated optical depth.
    """
    starts = range(0, max(1, len(features)), ROWS)
    parts = [_move_rows(features, base, residuals, frames, slice(first, first + ROWS)) for first in starts]
    return replace(features, **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


def _move_rows(
    features: FeatureGaussians, base: Gaussians, residuals: Tensor, frames: Tensor, rows: slice
) -> dict[str, np.ndarray]:
    """Compute the columns of some rows that :func:`move_features` changes."""
    names = ("means", "covars", "masses", "extinctions", "sh0")
    f = {name: as_tensor(getattr(features, name)[rows]) for name in names}
    base, residuals = base[rows], residuals[rows]
    wide, frames = residuals.double(), frames[rows].double()
    axes = quat_to_rotmat(base.quats.double())
    stretch = torch.eye(3).double() + axes @ (torch.expm1(wide[:, SIZE])[:, :, None] * axes.transpose(1, 2))
    change = rotation_matrices(rotate_vectors(frames, wide[:, ROTATION])) @ stretch
    covars = change @ f["covars"].double() @ change.transpose(1, 2)
    depth = wide[:, LOGIT]
    disc = wide[:, SIZE][:, 1:].sum(1)  # of the two larger axes: principal axes are in ascending order
    sizes = gaussian_sizes(base.scales).double()
    shift = rotate_vectors(frames, wide[:, MEAN] * sizes[:, None])
    shift = torch.where(shift.isfinite(), shift, 0)  # for means as far away as float32 allows
    moved = {
        "means": f["means"] + shift,
        "covars": (covars + covars.transpose(1, 2)) / 2,
        "masses": f["masses"] * torch.exp(depth + wide[:, SIZE].sum(1)),
        "extinctions": f["extinctions"] * torch.exp(depth + disc),
        "sh0": f["sh0"] + residuals[:, None, COLOR] / SH_C0,
    }
    return {name: as_array(values.float()) for name, values in moved.items()}
