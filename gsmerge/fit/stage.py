"""The stage of the fit: which Gaussians stay, and which parameters are fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from gsmerge.fit.cpu import ON_CPU
from gsmerge.fit.engine import Engine, FitBackend
from gsmerge.fit.fit_state import gaussians_of, grow_to, start_state
from gsmerge.fit.full import fit_full
from gsmerge.fit.outside import outside_views, score_fog
from gsmerge.fit.photo_sizes import fit_photos
from gsmerge.fit.report import FitReport, FitResult, Fitted, record_fit, report_steps
from gsmerge.fit.schedule import FitJob, plan_run
from gsmerge.raster import prepare
from gsmerge.runtime.record import choose, note, stage
from gsmerge.settings.fit import FitOptions
from gsmerge.types import Decoded, Gaussians, PicturedScene

ResultT = TypeVar("ResultT")
CLOSE = 1.0  # dB that the held-out blocks must gain; after less, the whole photos are compared
ALWAYS = float("inf")  # where the full fit failed: it may have begun where another one ended
START = 0.57  # share of the Gaussians that a run which grows begins with


def fit_scene(
    decoded: Decoded, scene: PicturedScene, views: Sequence[int], options: FitOptions, seed: int, backend: FitBackend
) -> Fitted:
    """Fit decoded Gaussians to the pictures of ``views`` of a canonical scene, if a fit is asked for."""
    if not options.needs_photos:
        return Fitted(decoded.gaussians, scene.cameras, None)
    with stage("fit"):
        photos = fit_photos(scene, options, views)
        choose(start_count=len(decoded.gaussians))
        if decoded.exact and not options.grows:  # then nothing is left out either
            options = replace(options, min_contribution=0.0)
        job = FitJob(photos, options, decoded.count, seed, report_steps, decoded.baseline_start, decoded.fixed)
        gaussians, report = fit(decoded.gaussians, job, backend)
        record_fit(report)
    cameras = scene.cameras
    if report is not None and report.viewmats is not None:
        viewmats = cameras.viewmats.astype(np.float64)
        viewmats[list(views)] = report.viewmats
        cameras = replace(cameras, viewmats=viewmats)
    return Fitted(gaussians, cameras, report)


def fit(gaussians: Gaussians, job: FitJob, backend: FitBackend = ON_CPU) -> tuple[Gaussians, FitReport | None]:
    """Leave out Gaussians that no photo shows, and fit the rest to the photos; without a fit in a draft, keep all.

    Where the full fit does not make held-out parts of the photos better, the colour fit is tried.
    The CPU alone fits to photos larger than the views, moves cameras, and leaves Gaussians that are
    fixed as they are. Views from outside are added to the job. The report is None if nothing was
    asked for.
    """
    options = job.options
    if not options.needs_photos:  # it costs as much as all that was done before
        return gaussians, None
    if options.fit != "none":
        job = replace(job, outside=outside_views(prepare(gaussians), job.photos[1], options))
    on_cpu = len(job.photos) > 2 or options.move_cameras or job.fixed is not None

    def fit_on(backend: FitBackend) -> tuple[Gaussians, FitReport | None]:
        fitted, report = _choose_fit(gaussians, job, backend.make_engine(plan_run(job)))
        return fitted, report and replace(report, device=backend.device)

    fitted, report = run_on(ON_CPU if on_cpu else backend, "fit", fit_on)
    if report is not None and job.outside is not None:
        report = replace(report, fog=score_fog(prepare(fitted), job.outside))
    return fitted, report


def run_on(backend: FitBackend, name: str, work: Callable[[FitBackend], ResultT]) -> ResultT:
    """Run ``work`` on a back end, or on the CPU, with a note, if the back end runs out of memory."""
    try:
        return work(backend)
    except backend.memory_errors:
        note(f"the memory of the GPU did not suffice for the {name}: the CPU did it")
    return work(ON_CPU)


def _choose_fit(gaussians: Gaussians, job: FitJob, engine: Engine) -> tuple[Gaussians, FitReport | None]:
    """Run :func:`fit` on an engine."""
    options, survey = job.options, engine.survey(gaussians)
    keep = survey.visible(options.min_contribution)
    kept, rows = gaussians[keep], np.flatnonzero(keep)
    if options.fit == "none":
        return kept, None
    fixed = None if job.fixed is None else job.fixed[rows]
    fitted, report = _better_of(engine, kept, *fit_full(kept, engine, survey[keep], fixed), CLOSE)
    if report.accepted:
        assert report.origins is not None
        return fitted, replace(report, origins=rows[report.origins])
    if not options.judged:
        return kept, replace(report, origins=rows)
    if options.grows:  # the stages before left room for a growth that did not happen
        state = grow_to(start_state(kept), engine.error_masses, job.count)
        fitted, report = engine.fit_colors(gaussians_of(state.x, state.splats.shN))
        if report.accepted:
            fitted, report = _better_of(engine, kept, fitted, report, ALWAYS)
        if report.accepted:
            return fitted, replace(report, origins=rows[state.origins])
        return kept, replace(report, origins=rows)
    fitted, report = engine.fit_colors(gaussians)
    fitted, report = _better_of(engine, kept, fitted[keep], report, ALWAYS)
    return fitted, replace(report, origins=rows)


def _better_of(engine: Engine, before: Gaussians, after: Gaussians, report: FitReport, close: float) -> FitResult:
    """Return the fitted Gaussians, or their start if held-out blocks hardly gained and whole photos lost.

    Gaussians that were fitted already are where steps of the default size only scatter. After a
    gain of ``close`` dB or more the photos are not compared.
    """
    if not report.accepted or report.holdout_after - report.holdout_before >= close:
        return after, report
    moved = engine if report.viewmats is None else engine.at_poses(report.viewmats)
    if moved.photo_error(after) <= engine.photo_error(before):
        return after, report
    why = "the photos as a whole were shown worse"
    return before, replace(report, method="none", accepted=False, stopped=why, viewmats=None)


def start_share(options: FitOptions) -> float:
    """Return the share of the final number of Gaussians with which the fit starts."""
    return START if options.grows else 1.0
