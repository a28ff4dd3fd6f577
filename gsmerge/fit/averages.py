"""Averages over the last steps of a fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmerge.kernels.gaussians.optimise import LOGIT, QUAT

RECENT = 10  # a recent mean averages about this many numbers


@dataclass
class RecentMean:
    """A moving mean, in which about the last ``RECENT`` numbers count."""

    mean: float = 0.0
    count: int = 0  # The last number has the weight 1 / count; at most RECENT

    def add(self, number: float) -> None:
        """Add a number, and move the mean towards it."""
        self.count = min(self.count + 1, RECENT)
        self.mean += (number - self.mean) / self.count


@dataclass
class TailMean:
    """Mean of the parameters ``[n,14]`` over the last steps of a fit, as they are noisy after a single step."""

    total: np.ndarray | None = None
    count: int = 0  # Number of steps whose parameters are in the total

    def add(self, x: np.ndarray) -> None:
        """Add the parameters ``x [n,14]`` after a step; begin anew if the number of Gaussians has changed."""
        if self.total is None or len(self.total) != len(x):
            self.total, self.count = 0 * x, 0
        self.count += 1
        self.total += x

    def of(self, x: np.ndarray) -> np.ndarray:
        """Return the mean with normalised quaternions.

        If no step was added, or the steps had another number of Gaussians than the parameters ``x``, return ``x``.
        """
        if self.total is None or len(self.total) != len(x):
            return x
        mean = self.total / self.count
        quats = mean[:, QUAT:LOGIT]
        quats /= (quats * quats).sum(1)[:, None] ** 0.5
        return mean
