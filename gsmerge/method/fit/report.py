"""The report and the result of a fit."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsmerge.arrays import ArrayFields
from gsmerge.frozen import dataclass, field
from gsmerge.method.fit.outside import Outside
from gsmerge.runtime.record import note, record_choices, report_progress
from gsmerge.types import Cameras, Gaussians

SAMPLE_COST = 0.4  # time of a step on a quarter of the pixels, if one on all pixels takes 1; .3 to .6 on two captures
HAZE = 0.05  # a result with more far fog gets a note, because a viewer shows such fog plainly


@dataclass(frozen=True, eq=False, repr=False)
class FitReport(ArrayFields):
    """What a fit has done, and its scores."""

    method: str  # `"full"`, or `"none"` if the result is the unchanged start of the fit
    accepted: bool  # True if the fit shows the photos better; otherwise the result is its start
    steps: int  # Steps of the full fit
    holdout_before: float  # PSNR (dB) on the held-out patches before the fit
    holdout_after: float  # The same after the fit
    stopped: str  # Why the fit ended
    viewmats: np.ndarray | None = None  # [v,4,4] poses after the fit; None if cameras were fixed
    # Mean opacity, in [0, 1], of the result in views from outside, over all pixels where the input is empty; None
    # without empty pixels
    fog: float | None = None
    # [n] for each Gaussian of the result, the row of the Gaussian at the start from which it comes; None if unknown
    origins: np.ndarray | None = field(default=None, compare=False)

    def to_dict(self) -> dict[str, Any]:
        """Return all fields but the arrays, by name, for the report of a run."""
        return {name: value for name, value in vars(self).items() if name not in ("viewmats", "origins")}


FitResult = tuple[Gaussians, FitReport]


@dataclass(frozen=True, eq=False)
class Fitted:
    """The result of the stage: Gaussians and cameras after the fit."""

    gaussians: Gaussians  # Canonical Gaussians
    cameras: Cameras  # The scene's cameras, canonical, at the poses after the fit
    report: FitReport | None  # Report of the fit; None if there was no fit
    outside: Outside | None = None  # Views from outside in which steps cleared fog; None if there were none


def record_fit(report: FitReport) -> None:
    """Add the report of a fit to the current record, and notes about haze or a fit that was not accepted."""
    record_choices(fit=report.to_dict())
    if report.fog is not None and report.fog > HAZE:
        seen = f"seen from outside, the result shows haze where the scene is empty: far fog {report.fog:.2f}"
        note(f"{seen}; --fit none makes less, and is farther from the photos" if report.accepted else seen)
    if not report.accepted:
        note("the fit was not accepted: it shows most views worse than its start does")


def report_steps(step: int, steps: int, psnr: float, half_part: float) -> None:
    """Report the progress of a fit after ``step`` of ``steps`` steps, with the PSNR (dB) of the last photos.

    Progress is measured by time. The first steps, which are the share ``half_part`` of all steps, draw only samples of
    photos and take less time.
    """
    num_first = half_part * steps
    time, total_time = (count - (1 - SAMPLE_COST) * min(count, num_first) for count in (step, steps))
    report_progress(f"fit: photos {psnr:.1f} dB", round(time / total_time * steps), steps)
