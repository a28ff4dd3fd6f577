"""Run the stage of the fit: drop Gaussians that no photo shows, fit the rest, and keep the result if it is better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsmerge.method.fit.edges import find_edges
from gsmerge.method.fit.full import fit_full
from gsmerge.method.fit.growth import MOST_GROWTH
from gsmerge.method.fit.outside import place_outside_views, score_fog
from gsmerge.method.fit.photo_sizes import fit_photos
from gsmerge.method.fit.report import FitResult, Fitted, record_fit, report_steps
from gsmerge.method.fit.schedule import FitJob, prepare_fit
from gsmerge.method.fit.survey import photo_mses, survey_photos
from gsmerge.method.geometry.transforms import clamp_inside
from gsmerge.method.raster import make_splats
from gsmerge.method.raster.photos import scene_photos
from gsmerge.runtime.record import record_choices, stage
from gsmerge.settings.fit import FitOptions
from gsmerge.types import Decoded, Gaussians, PicturedScene

CLOSE = 1.0  # if held-out patches gain less than CLOSE dB, whole photos decide whether a fit is accepted
START = 0.57  # a run that grows starts with the share START of its final number of Gaussians


def fit_scene(
    decoded: Decoded,
    scene: PicturedScene,
    options: FitOptions,
    seed: int,
    *,
    views: Sequence[int] | None = None,
    num_scored: int | None = None,
    held_out: Sequence[int] = (),
) -> Fitted:
    """Fit decoded Gaussians to the pictures of some ``views`` of a canonical scene, or of all views if None.

    If the option ``fit`` is "none", the Gaussians are returned unchanged. If the scene has photos, ``num_scored`` is
    None, and the result is scored on all photos. If renders stand for photos, the result is scored on the views
    ``held_out``, or on the first ``num_scored`` views if none are held out.
    """
    if options.fit == "none":
        return Fitted(decoded.gaussians, scene.cameras, None)
    views = range(len(scene)) if views is None else views
    with stage("fit"):
        photos = fit_photos(scene, options, views)
        record_choices(start_count=len(decoded.gaussians))
        if decoded.exact and not options.grows:  # the number is exact, and no Gaussians are added after a drop
            options = replace(options, min_contribution=0.0)
        takes_all = decoded.exact or options.fills  # the fit grows to the whole count, even where that gains little
        job = FitJob(
            photos=photos,
            options=options,
            count=decoded.count,
            most_growth=None if takes_all else MOST_GROWTH,
            seed=seed,
            progress=report_steps,
            fixed=decoded.fixed,
            num_scored=num_scored,
            held_out=scene_photos(scene)[held_out] if held_out else None,
            edges=None if options.beyond else find_edges(scene.cameras, decoded.count),
            region=scene.region,
        )
        job = replace(job, outside=place_outside_views(scene, decoded.gaussians, job.scored_photos(1), options))
        gaussians, report = fit_gaussians(decoded.gaussians, job)
        if scene.region is not None:  # splits after the last step may have moved centres out of the region
            gaussians = replace(gaussians, means=clamp_inside(scene.region, gaussians.means).astype(np.float32))
        record_fit(report)
    cameras = scene.cameras
    if report.viewmats is not None:
        viewmats = cameras.viewmats.astype(np.float64)
        viewmats[list(views)] = report.viewmats
        cameras = replace(cameras, viewmats=viewmats)
    return Fitted(gaussians, cameras, report, job.outside)


def fit_gaussians(gaussians: Gaussians, job: FitJob) -> FitResult:
    """Drop Gaussians that no photo shows, fit the rest, and measure the fog of the result; return it with a report.

    If most photos become worse, the Gaussians that some photo shows are returned as they were. If the Gaussians were
    already fitted, they can become worse, because steps of the default size scatter them. Whole photos are compared
    only if held-out patches gained less than ``CLOSE`` dB. A fit is not refused because of held-out patches alone. If
    few views see a place, held-out patches become worse even in fits that improve new views by up to 10 dB.
    """
    run = prepare_fit(job)
    photos = job.scored_photos(0) if job.held_out is None else job.held_out
    survey = survey_photos(gaussians, run)
    is_shown = survey.visible(job.options.min_contribution)
    start = gaussians[is_shown]
    rows = np.flatnonzero(is_shown)
    fixed = None if job.fixed is None else job.fixed[rows]
    fitted, report = fit_full(start, run, survey[is_shown], fixed)
    assert report.origins is not None
    report = replace(report, origins=rows[report.origins])
    if not report.holdout_after - report.holdout_before >= CLOSE:  # also if no patches are held out
        moved_photos = photos if report.viewmats is None else replace(photos, viewmats=report.viewmats[: len(photos)])
        error_ratios = photo_mses(fitted, moved_photos) / photo_mses(start, photos)
        if not np.median(error_ratios) <= 1:  # not the mean, because a placed camera may see only one near Gaussian
            fitted = start
            stopped = "most photos were shown worse"
            report = replace(report, method="none", accepted=False, stopped=stopped, viewmats=None, origins=rows)
    if job.outside is not None:
        report = replace(report, fog=score_fog(make_splats(fitted), job.outside))
    return fitted, report


def start_share(options: FitOptions) -> float:
    """Return the share of the final number of Gaussians with which the fit starts."""
    return START if options.grows else 1.0
