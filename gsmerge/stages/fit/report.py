"""What a fit did."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from gsmerge.runtime.record import choose, note, report_progress
from gsmerge.types import Cameras, Gaussians


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
        device: Where it ran: ``"cpu"`` or ``"cuda"``.
    """

    method: str
    accepted: bool
    steps: int
    holdout_before: float
    holdout_after: float
    stopped: str
    viewmats: np.ndarray | None = None
    device: str = "cpu"


@dataclass(frozen=True, eq=False)
class Fitted:
    """Gaussians after the fit.

    Args:
        gaussians: Canonical Gaussians.
        cameras: The scene's cameras, canonical, moved where the fit moved them.
        report: What the fit did; None where nothing was fitted.
    """

    gaussians: Gaussians
    cameras: Cameras
    report: FitReport | None


def record_fit(report: FitReport | None) -> None:
    """Add what a fit did to the current record; None: nothing was fitted."""
    if report is None:
        return
    numbers = asdict(report)
    del numbers["viewmats"]
    choose(fit=numbers)
    if not report.accepted:
        note("the fit was not accepted: held-out parts of the photos did not get better")


def report_steps(step: int, steps: int, photos: float, held_out: float) -> None:
    """Report a step of the fit and the PSNR (dB) of the photos and of their held-out blocks."""
    report_progress(f"fit: photos {photos:.1f} dB, held out {held_out:.1f} dB", step, steps)
