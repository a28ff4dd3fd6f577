"""Merge by AnySplat's rule (Jiang et al. 2025): one Gaussian for each voxel, a softmax-weighted mean of its Gaussians.

Averages are taken of the parameters that a network outputs, such as logarithms of scales and logits of opacities.
AnySplat's weights are the softmax of a confidence. No file stores it, so the opacity replaces it. Bisection finds the
size of the voxels. The result has at most the requested count.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from gsmerge.facts.prepare import Prepared
from gsmerge.kernels.elementary import exp, log, power
from gsmerge.kernels.matrices import eigh
from gsmerge.plan import Plan
from gsmerge.runtime.record import choose, stage
from gsmerge.types import Gaussians

BITS = 21  # bits of a voxel's number along each axis; Gaussians farther out are in the outermost voxels
FINEST = -17.0  # smallest size, octaves of the canonical unit; at this size the outermost voxels lie 8 units away
PRECISION = 1e-4  # octaves
MIN_OPACITY, MIN_SCALE = 1e-6, 1e-12  # least values before logits and logarithms


def voxel_keys(means: np.ndarray, size: float) -> np.ndarray:
    """Return the numbers ``[n]`` int64 of the voxels that means ``[n,3]`` round to; voxels are ``size`` wide."""
    half = 1 << (BITS - 1)
    index = np.clip(np.rint(means / size), -half, half - 1).astype(np.int64) + half
    return (index[:, 0] << 2 * BITS) | (index[:, 1] << BITS) | index[:, 2]


def voxel_size(means: np.ndarray, count: int) -> float:
    """Find the smallest voxel size that leaves at most ``count`` voxels occupied, to a ten-thousandth of an octave."""

    def occupied(octave: float) -> int:
        keys = np.sort(voxel_keys(means, power(2, octave)))
        return 1 + int((keys[1:] != keys[:-1]).sum())

    extent = float(np.abs(means).max(initial=0))
    fine = coarse = FINEST  # octaves
    if extent > 0:
        coarse = max(FINEST, float(log(4 * extent) / log(2)))  # one voxel has all Gaussians
    if occupied(fine) <= count:
        return float(power(2, fine))
    while coarse - fine > PRECISION:
        middle = (fine + coarse) / 2
        fine, coarse = (fine, middle) if occupied(middle) <= count else (middle, coarse)
    return float(power(2, coarse))


def fuse(gaussians: Gaussians, keys: np.ndarray) -> Gaussians:
    """Merge the Gaussians of each voxel into one, weighted by exp(opacity), in the order of the keys ``[n]``.

    The average of rotations does not depend on the signs of their quaternions (Markley et al. 2007).
    """
    _, cells = np.unique(keys, return_inverse=True)
    means, quats, scales, opacities, sh0, shN = (
        getattr(gaussians, f.name).astype(np.float64) for f in fields(Gaussians)
    )
    weights = exp(opacities)
    count = int(cells.max(initial=-1)) + 1
    total = np.bincount(cells, weights, count)

    def average(values: np.ndarray) -> np.ndarray:
        flat = values.reshape(len(values), -1)
        columns = [np.bincount(cells, weights * column, count) / total for column in flat.T]
        return np.stack(columns, 1).reshape(count, *values.shape[1:]) if columns else values[:count]

    bounded = opacities.clip(MIN_OPACITY, 1 - MIN_OPACITY)
    _, axes = eigh(average(quats[:, :, None] * quats[:, None]))
    arrays = (
        average(means),
        axes[:, :, -1],
        exp(average(log(scales.clip(MIN_SCALE)))),
        1 / (1 + exp(-average(log(bounded / (1 - bounded))))),
        average(sh0),
        average(shN),
    )
    return Gaussians(*(array.astype(np.float32) for array in arrays))


def run(prepared: Prepared, plan: Plan, count: int) -> Gaussians:
    """Merge the Gaussians of each voxel into one, with the smallest voxels that leave at most ``count``."""
    gaussians = prepared.scene.file_gaussians
    with stage("reduce"):
        means = gaussians.means.astype(np.float64)
        size = voxel_size(means, count)
        choose(voxel_size=size)
        return fuse(gaussians, voxel_keys(means, size))
