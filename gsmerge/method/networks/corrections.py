"""Apply bounded corrections to Gaussians and Feature Gaussians.

A correction has 13 columns: a shift of the mean (3), changes of the log scales along the principal axes (3), a rotation
vector (3), a change of the opacity's logit (1), and changes of the base colour (3). Shift and rotation vector are in
the group's frame. Corrections of Feature Gaussians have one more column, which is added to the logarithm of the mass.
The mass also follows the changes of size and opacity. A correction of zero changes no bit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.arrays import Array, like
from gsmerge.method.kernels.elementary import exp
from gsmerge.method.kernels.networks.tokens import correct_features, correct_gaussians
from gsmerge.method.networks.options import RESIDUAL, Bounds
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import FeatureGaussians, Gaussians

# Columns of a correction
MEAN_COLUMNS = slice(0, 3)
SIZE_COLUMNS = slice(3, 6)
ROTATION_COLUMNS = slice(6, 9)
# the last is only in corrections of Feature Gaussians
LOGIT_COLUMN = 9
COLOR_COLUMNS = slice(10, 13)
MASS_COLUMN = 13
HALF = 0.5  # encoder, merger and refiner may each use the share HALF of the bounds
CORRECTION_ROWS = 8192  # rows per task


def residual_limits(bounds: Bounds) -> np.ndarray:
    """Return the bounds ``[14]`` float32 of the columns of a correction of Feature Gaussians."""
    b = bounds
    return np.array([b.mean] * 3 + [b.size] * 3 + [b.turn] * 3 + [b.logit] + [b.color] * 3 + [b.logit], np.float32)


def scale_outputs(outputs: Array, bounds: Bounds, share: float = 1.0) -> Array:
    """Scale network outputs ``[...,13 or 14]`` in [-1, 1] to corrections of at most ``share`` times the bounds."""
    return outputs * like(np.float32(share) * residual_limits(bounds)[: outputs.shape[-1]], outputs)


def move_gaussians(gaussians: Gaussians, residuals: np.ndarray, owners: np.ndarray, frames: np.ndarray) -> Gaussians:
    """Apply corrections ``residuals [n,13]`` to Gaussians, in the ``frames [g,3,3]`` of their groups ``owners [n]``."""
    names = ("means", "quats", "scales", "opacities", "sh0")
    columns = {name: np.array(getattr(gaussians, name), np.float32, order="C") for name in names}

    def move(first: int) -> None:
        """Correct the rows from ``first`` on in place."""
        rows = slice(first, first + CORRECTION_ROWS)
        correct_gaussians(*(column[rows] for column in columns.values()), residuals[rows], frames, owners[rows])

    parallel_map(move, range(0, len(gaussians), CORRECTION_ROWS))
    return replace(gaussians, **columns)


def move_features(
    features: FeatureGaussians, base: Gaussians, residuals: np.ndarray, frames: np.ndarray
) -> FeatureGaussians:
    """Apply corrections ``residuals [g,14]`` to Feature Gaussians.

    ``base`` are the Gaussians with their moments. ``frames [g,3,3]`` have the axes of each group as columns, in the
    world. ``LOGIT_COLUMN`` is added to the logarithms of both the integrated optical depth and the mass, and
    ``MASS_COLUMN`` only to the logarithm of the mass. A change of scales does not change the opacity.
    """
    names = ("means", "covars", "masses", "extinctions", "sh0")
    columns = {name: np.array(getattr(features, name), np.float32, order="C") for name in names}
    fixed = (base.quats, base.scales, frames, np.ascontiguousarray(residuals[:, :RESIDUAL]))

    def move(first: int) -> None:
        """Correct the rows from ``first`` on in place."""
        rows = slice(first, first + CORRECTION_ROWS)
        correct_features(*(column[rows] for column in (*columns.values(), *fixed)))

    parallel_map(move, range(0, len(features), CORRECTION_ROWS))
    columns["masses"] = (columns["masses"] * exp(residuals[:, MASS_COLUMN])).astype(np.float32)
    return replace(features, **columns)
