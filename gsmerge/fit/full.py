"""Gaussians -> fitted Gaussians: a short optimisation of all parameters, confined to a box about the start.

One view per step: L1 of pixels and of their differences, and structural similarity, on a random
background, samples of the photos' pixels first, Adam with rates in units of each Gaussian's own size. Longer runs
begin with fewer Gaussians than they may have and spend the rest where the error is.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from gsmerge.fit.edges import cut_state
from gsmerge.fit.fit_state import FitState, gaussians_of, start_state
from gsmerge.fit.growth import FAINT, drop_faint, grow_to
from gsmerge.fit.report import TIME_SPENT, FitReport, FitResult
from gsmerge.fit.schedule import CLEARS, CUTS, GROWTH, PROBE, FitRun, Schedule, affordable_steps, begins
from gsmerge.fit.steps import make_optimiser
from gsmerge.fit.survey import Survey, score_state, survey_photos
from gsmerge.kernels.elementary import log
from gsmerge.kernels.gaussians.optimise import LOGIT, QUAT
from gsmerge.raster.metrics import decibels
from gsmerge.raster.photos import Photos
from gsmerge.settings.fit import Tuning
from gsmerge.types import Gaussians


def fit_full(
    gaussians: Gaussians, run: FitRun, survey: Survey | None = None, fixed: np.ndarray | None = None
) -> FitResult:
    """Fit all parameters of Gaussians to the photos of a run.

    The result after the first steps is kept if it beats the start on held-out patches; otherwise the start is
    returned. The full-size steps then use every patch. ``survey``: survey of the Gaussians, if made already; ``fixed``:
    mask ``[n]`` of Gaussians that stay unchanged.
    """
    job, options, schedule, tail = run.job, run.job.options, Schedule(run), TailMean()
    state, optimiser = start_state(gaussians), make_optimiser(run)
    if fixed is not None:
        state.fixed[:] = fixed
    survey = survey_photos(gaussians, run) if survey is None else survey
    state.box_shares[:], state.min_sizes[:] = limit_moves(survey, options.tuning)
    half, judged = optimiser.photos[1], not options.judged
    before = after = survey.score
    step, steps, last, error, grows, looks = 0, options.steps, -1.0, 0.0, options.grows, 0
    started = time.perf_counter()
    while step < steps:
        part = step / steps
        if part >= run.half_part and not judged:  # before growth: halves that were never fitted show less
            after, judged = score_state(state, run, half), True
            if after <= before:
                break
        if grows and begins((*CLEARS, *CUTS, GROWTH), last, part):
            state, tail = renew_state(state, run, half, last, part), TailMean()
        drawn = schedule.draw(step + 1, part, len(state.x))
        looks = 1 if begins((run.half_part,), last, part) else min(looks + 1, 10)  # anew with photos of full size
        error += (optimiser.step(state, drawn) - error) / looks
        step, last = step + 1, part
        outside_view = run.outside_view(step, part)
        if outside_view is not None:
            optimiser.clear_veils(state, drawn, outside_view)
        if job.region is not None:
            state.keep_inside(job.region)
        if step > steps * (1 - options.tuning.average_share):
            tail.add(state.x)
        if options.time_budget is not None and step == PROBE:
            steps = affordable_steps(time.perf_counter() - started, run)
        if job.progress:
            job.progress(step, steps, decibels(error), run.half_part)
    if not judged:
        after = score_state(state, run, half)
    if options.judged and after <= before:
        why = f"held-out patches of the photos were no better after {step} steps"
        return gaussians, FitReport("none", False, step, before, after, why, origins=np.arange(len(gaussians)))
    if grows and last < GROWTH:  # a time budget may end before the growth
        state = grow_to(state, half, job.count)
    why = TIME_SPENT if options.time_budget is not None else "all steps done"
    fitted = gaussians_of(tail.of(state.x), state.splats.shN)
    return fitted, FitReport("full", True, step, before, after, why, optimiser.viewmats, origins=state.origins)


def renew_state(state: FitState, run: FitRun, half: Photos, before: float, now: float) -> FitState:
    """Grow a state, drop its faint Gaussians and cut it at the views' edges, as is due between two parts of a run.

    Rows and axes then mean others than before.
    """
    job, options = run.job, run.job.options
    if begins((GROWTH,), before, now):
        state = grow_to(state, half, job.count)
    if job.fixed is None and options.min_contribution > 0 and begins(CLEARS, before, now):
        state = grow_to(state, half, job.count, FAINT) if options.fills else drop_faint(state, FAINT)
    if job.edges is not None and begins(CUTS, before, now):
        cut_state(state, job.edges)
    return state


def limit_moves(survey: Survey, rates: Tuning) -> tuple[np.ndarray, np.ndarray]:
    """Return the share ``[n]`` of its box that each Gaussian may use, and its least log scale ``[n]``.

    The share lies between ``single_view_share`` and 1, by the effective number of photos that show the Gaussian: (sum
    w)^2 / sum w^2 of its blending weights w in the photos. The least scale is ``min_scale`` pixels of the largest photo
    that shows it nearest (the 3D filter of Mip-Splatting); there is none if no photo shows it.
    """
    photos_each = survey.sums**2 / np.maximum(survey.squares, 1e-12)
    box_shares = np.clip(photos_each - 1, rates.single_view_share, 1).astype(np.float32)
    pixels = np.where(np.isfinite(survey.pixels), survey.pixels, 0)
    return box_shares, log(rates.min_scale * pixels).astype(np.float32)


@dataclass
class TailMean:
    """Mean of the parameters ``[n,14]`` over the last steps, which are noisy."""

    total: np.ndarray | None = None
    count: int = 0

    def add(self, x: np.ndarray) -> None:
        """Add the parameters after a step; start anew if the number of Gaussians has changed."""
        if self.total is None or len(self.total) != len(x):
            self.total, self.count = 0 * x, 0
        self.count += 1
        self.total += x

    def of(self, x: np.ndarray) -> np.ndarray:
        """Return the mean with normalised quaternions; ``x`` itself without steps with this number of Gaussians."""
        if self.total is None or len(self.total) != len(x):
            return x
        mean = self.total / self.count
        quats = mean[:, QUAT:LOGIT]
        quats /= (quats * quats).sum(1)[:, None] ** 0.5
        return mean
