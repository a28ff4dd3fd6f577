"""Fit all parameters of Gaussians to photos by a short optimisation, in which each parameter stays near its start.

Each step draws one view over a random background. The loss of a step combines the L1 error of pixels, the L1 error of
differences between neighbouring pixels, and structural similarity. The step sizes of the optimiser (Adam) are in units
of each Gaussian's own size. The first steps draw only a sample of each photo's pixels. Long runs begin with fewer
Gaussians than they may have, and add the rest where errors are large.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gsmerge.method.fit.edges import cut_state, split_at_edges
from gsmerge.method.fit.fit_state import FitState, gaussians_of, start_state, state_of
from gsmerge.method.fit.growth import FAINT, drop_faint, grow_to
from gsmerge.method.fit.outside import veil_gradients
from gsmerge.method.fit.report import FitReport, FitResult
from gsmerge.method.fit.schedule import CLEARS, CUTS, GROWTH, FitRun, Schedule
from gsmerge.method.fit.steps import Optimiser, make_optimiser
from gsmerge.method.fit.survey import Survey, photo_mses, score_state, spread_views, survey_photos
from gsmerge.method.kernels.elementary import log
from gsmerge.method.kernels.gaussians.optimise import LOGIT, QUAT
from gsmerge.method.raster.metrics import decibels
from gsmerge.method.raster.photos import Photos
from gsmerge.settings.fit import Tuning
from gsmerge.types import Gaussians

RECENT = 10  # a recent mean averages about this many numbers
SPLIT_LOSS = 1.01  # splits at the edges may multiply the mean squared error of photos by at most this factor
# Photos on which this is measured, evenly spread: in 24 of 25 fits of ten captures they decide as twelve photos do
SPLIT_PHOTOS = 4


def fit_full(
    gaussians: Gaussians, run: FitRun, survey: Survey | None = None, fixed: np.ndarray | None = None
) -> FitResult:
    """Fit all parameters of Gaussians to the photos of a run.

    Held-out patches are scored after the share ``scored_part`` of the steps. The remaining steps use every patch. After
    the last step, Gaussians are split at the edges of the views if the photos hardly suffer.

    Args:
        gaussians: The n Gaussians to start from.
        run: Photos and options.
        survey: Survey of the Gaussians, or None to make a new survey.
        fixed: ``[n]`` bool, true for Gaussians that must not change; if None, all may change.

    Returns:
        The fitted Gaussians and a report.
    """
    job = run.job
    survey = survey_photos(gaussians, run) if survey is None else survey
    fit = FullFit(
        run, optimiser=make_optimiser(run), schedule=Schedule(run), state=start_state(gaussians), before=survey.score,
        steps=job.options.steps,
    )  # fmt: skip
    fit.state.box_shares[:], fit.state.min_sizes[:] = limit_moves(survey, job.options.tuning)
    if fixed is not None:
        fit.state.fixed[:] = fixed
    while fit.step < fit.steps:
        if fit.progress >= run.scored_part:  # before Gaussians are split, because new halves score worse
            score_fit(fit)
        renew_state(fit)
        take_step(fit)
        if job.progress:
            job.progress(fit.step, fit.steps, decibels(fit.error.mean), run.half_part)
    score_fit(fit)
    final = state_of(fit.tail.of(fit.state.x), fit.state.splats.shN)
    final.origins, final.min_sizes = fit.state.origins, fit.state.min_sizes
    # A fit that fills an exact number of Gaussians has no room for halves. There are no edges if renders stand for
    # photos, because renders also show what lies beyond the edges of photos
    has_room = job.options.grows and not job.options.fills
    if has_room and job.edges is not None and job.fixed is None:
        split = split_at_edges(final, job.edges, job.count)
        if split is not final:
            photos = fit.half[sorted(spread_views(len(fit.half))[:SPLIT_PHOTOS])]
            mse, split_mse = (float(photo_mses(gaussians_of(s.x, s.splats.shN), photos).mean()) for s in (final, split))
            # photos may lose .5 dB where large Gaussians overlap, because two halves cover more than their parent
            final = split if split_mse <= SPLIT_LOSS * mse else final
    report = FitReport(
        method="full",
        accepted=True,
        steps=fit.step,
        holdout_before=fit.before,
        holdout_after=fit.before if fit.after is None else fit.after,
        stopped="all steps done",
        viewmats=fit.optimiser.viewmats,
        origins=final.origins,
    )
    return gaussians_of(final.x, final.splats.shN), report


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
            self.total = 0 * x
            self.count = 0
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


@dataclass(eq=False)
class FullFit:
    """A full fit between two of its steps."""

    run: FitRun
    optimiser: Optimiser
    schedule: Schedule
    state: FitState
    before: float  # PSNR (dB) of the held-out patches at the start
    steps: int  # Steps to take
    after: float | None = None  # PSNR (dB) of the held-out patches after the first steps; None before it is measured
    step: int = 0  # Steps taken
    last: float = -1.0  # Value of `progress` before the last step; -1 before the first step
    error: RecentMean = field(default_factory=RecentMean)  # Mean squared error of the last steps, which a user is shown
    tail: TailMean = field(default_factory=TailMean)  # Mean parameters over the last steps

    @property
    def progress(self) -> float:
        """Share of the steps that were taken so far, in [0, 1]."""
        return self.step / self.steps

    @property
    def half(self) -> Photos:
        """The photos at half size, at the poses that the fit has reached."""
        return self.optimiser.photos[1]

    def reaches(self, *milestones: float) -> bool:
        """Return true if the next step is the first after one of the ``milestones``, which are values of `progress`."""
        return any(self.last < milestone <= self.progress for milestone in milestones)


def score_fit(fit: FullFit) -> None:
    """Score a fit on held-out patches, unless it has a score already, or the options ask for none."""
    if fit.after is None and fit.run.job.options.scored:
        fit.after = score_state(fit.state, fit.run, fit.half)


def renew_state(fit: FullFit) -> None:
    """Add Gaussians, drop faint ones, or cut Gaussians at the edges of the views, if such a change is due.

    A change gives rows to other Gaussians, or turns the axes of a Gaussian, so the mean over the last steps begins
    anew. If some Gaussians are fixed, none are dropped or added, because the caller expects every Gaussian in its row.
    """
    job = fit.run.job
    options = fit.run.job.options
    if not options.grows or not fit.reaches(GROWTH, *CLEARS, *CUTS):
        return
    if fit.reaches(GROWTH) and job.fixed is None:
        fit.state = grow_to(fit.state, fit.half, job.count, most_growth=job.most_growth)
    if fit.reaches(*CLEARS) and job.fixed is None and options.min_contribution > 0:
        fit.state = grow_to(fit.state, fit.half, job.count, FAINT) if options.fills else drop_faint(fit.state, FAINT)
    if fit.reaches(*CUTS) and job.edges is not None:
        cut_state(fit.state, job.edges)
    fit.tail = TailMean()


def take_step(fit: FullFit) -> None:
    """Take a step on a photo, and also a step on a view from outside if one is due; count the step in ``fit``."""
    run = fit.run
    progress = fit.progress
    step = fit.schedule.draw(fit.step + 1, progress, len(fit.state.x))
    if fit.reaches(run.half_part):  # later steps draw whole photos, whose errors differ from errors of samples
        fit.error = RecentMean()
    fit.error.add(fit.optimiser.step(fit.state, step))
    outside_view = run.outside_view(step.number, progress)
    if outside_view is not None:
        assert run.job.outside is not None
        fit.optimiser.move(fit.state, veil_gradients(fit.state.splats, run.job.outside, outside_view), step)
    if run.job.region is not None:
        fit.state.keep_inside(run.job.region)
    fit.step = step.number
    fit.last = progress
    if fit.step > fit.steps * (1 - run.job.options.tuning.average_share):
        fit.tail.add(fit.state.x)


def limit_moves(survey: Survey, rates: Tuning) -> tuple[np.ndarray, np.ndarray]:
    """Return how far each Gaussian may move, as a share ``[n]`` of its full range, and its least log scale ``[n]``.

    A Gaussian that a single photo shows may move by the share ``single_view_share``, and a Gaussian that two photos
    show by the share 1. The effective number of photos is (sum w)^2 / sum w^2, where w is the sum of the Gaussian's
    blending weights in a photo. The least scale is ``min_scale`` times the size of the finest pixel that shows the
    Gaussian (the 3D filter of Mip-Splatting). If no photo shows the Gaussian, its scale has no lower limit.
    """
    num_photos = survey.sums**2 / np.maximum(survey.squares, 1e-12)
    box_shares = np.clip(num_photos - 1, rates.single_view_share, 1).astype(np.float32)
    pixel_sizes = np.where(np.isfinite(survey.pixels), survey.pixels, 0)
    return box_shares, log(rates.min_scale * pixel_sizes).astype(np.float32)
