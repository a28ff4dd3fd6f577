"""Quaternions, covariances and projection, on batches of tensors."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsmerge.types import Cameras

MORTON_BITS = 21  # per axis: three fit into 63 bits


def quat_to_rotmat(quats: Tensor) -> Tensor:
    """Rotation matrices of quaternions.

    Args:
        quats: ``[...,4]`` wxyz; normalised here.

    Returns:
        ``[...,3,3]`` rotations, local to world.
    """
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(*quats.shape[:-1], 3, 3)


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """Covariances ``R diag(scales)^2 R^T`` (paper section 3).

    Args:
        quats: ``[...,4]`` wxyz.
        scales: ``[...,3]`` standard deviations.

    Returns:
        ``[...,3,3]``.
    """
    half = quat_to_rotmat(quats) * scales[..., None, :]
    return half @ half.transpose(-1, -2)


def project(means: Tensor, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Pixel positions and depths of points in every camera.

    Args:
        means: ``[n,3]`` world positions.
        cameras: c cameras.

    Returns:
        ``[c,n,2]`` positions in pixels (pixel centres at +0.5; meaningless where the depth is not positive)
        and ``[c,n]`` depths along z, both in float64.
    """
    means, viewmats, Ks = means.double(), cameras.viewmats.double(), cameras.Ks.double()
    camera = means @ viewmats[:, :3, :3].transpose(1, 2) + viewmats[:, None, :3, 3]
    image = camera @ Ks.transpose(1, 2)
    return image[..., :2] / image[..., 2:], camera[..., 2]


def morton_codes(points: np.ndarray) -> np.ndarray:
    """``[n]`` int64 places along a space-filling curve (Morton's) of points ``[n,3]``: the bits interleaved."""
    codes = np.zeros(len(points), np.int64)
    if len(points) == 0:
        return codes
    low, high = points.min(0), points.max(0)
    steps = (points - low) / np.maximum(high - low, 1e-30) * (2**MORTON_BITS - 1)
    for axis, column in enumerate(steps.astype(np.int64).T):
        for bit in range(MORTON_BITS):
            codes |= (column >> bit & 1) << (3 * bit + axis)
    return codes
