"""What a fit did."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class FitReport:
    """What a fit did.

    Args:
        method: ``"none"``, ``"color"`` or ``"full"``: what the result comes from.
        accepted: Whether the held-out blocks of the photos got better; if not, the Gaussians are as they were.
        steps: Steps of the full fit, or conjugate-gradient steps.
        holdout_before: PSNR (dB) on the held-out blocks before the fit.
        holdout_after: The same after it.
        stopped: Why it ended.
        viewmats: ``[v,4,4]`` poses of the photos after the fit; None where they were fixed.
    """

    method: str
    accepted: bool
    steps: int
    holdout_before: float
    holdout_after: float
    stopped: str
    viewmats: np.ndarray | None = None
