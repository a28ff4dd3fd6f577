"""The report and the result of a fit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsmerge.fit.outside import Outside
from gsmerge.runtime.record import choose, note, report_progress
from gsmerge.types import Cameras, Gaussians
from gsmerge.values.arrays import ArrayFields

SAMPLE_COST = 0.4  # time of a step on a quarter of the pixels, in units of one on all: .3 to .6 on two captures
HAZE = 0.05  # far fog above which a result gets a note, because it is plain to see in a viewer


@dataclass(frozen=True, eq=False, repr=False)
class FitReport(ArrayFields):
    """Facts about a fit and its scores."""

    method: str  # `"none"` or `"full"`: the fit from which the result comes
    accepted: bool  # Whether the photos are shown better; if not, nothing was changed
    steps: int  # Steps of the full fit
    holdout_before: float  # PSNR (dB) on the held-out patches before the fit
    holdout_after: float  # The same after it
    stopped: str  # Why it ended
    viewmats: np.ndarray | None = None  # [v,4,4] poses after the fit; None: fixed
    # Mean opacity of the result, in [0, 1], seen from outside where the input is empty; None: it is nowhere empty
    fog: float | None = None
    # [n] row of the start from which each Gaussian comes; None: unknown
    origins: np.ndarray | None = field(default=None, compare=False)

    def to_dict(self) -> dict[str, Any]:
        """Return all but the arrays, as plain values."""
        return {name: value for name, value in vars(self).items() if name not in ("viewmats", "origins")}


FitResult = tuple[Gaussians, FitReport]


@dataclass(frozen=True, eq=False)
class Fitted:
    """Gaussians after the fit."""

    gaussians: Gaussians  # Canonical Gaussians
    cameras: Cameras  # The scene's cameras, canonical, at the poses after the fit
    report: FitReport | None  # Report of the fit; None if nothing was fitted
    outside: Outside | None = None  # Views from outside that kept it clear of fog; None: none


def record_fit(report: FitReport) -> None:
    """Add the report of a fit to the current record."""
    choose(fit=report.to_dict())
    if report.fog is not None and report.fog > HAZE:
        seen = f"seen from outside, the result shows haze where the scene is empty: far fog {report.fog:.2f}"
        note(f"{seen}; --fit none makes less, and is farther from the photos" if report.accepted else seen)
    if not report.accepted:
        note("the fit was not accepted: it shows most views worse than its start does")


def report_steps(step: int, steps: int, photos: float, half_part: float) -> None:
    """Report progress of the fit: the steps that are done, by their time, and the PSNR (dB) of the last photos.

    The first share ``half_part`` of the steps draws samples of the photos, which takes less time.
    """
    half = half_part * steps
    done, total = (count - (1 - SAMPLE_COST) * min(count, half) for count in (step, steps))
    report_progress(f"fit: photos {photos:.1f} dB", round(done / total * steps), steps)
