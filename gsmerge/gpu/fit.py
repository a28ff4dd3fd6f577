"""The fit on a device: which Gaussians stay, and what of them is fitted; :mod:`gsmerge.stages.fit.stage`."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsmerge.gpu.color import fit_colors
from gsmerge.gpu.full import fit_full, gaussians_of, start_state
from gsmerge.gpu.grow import grow_to
from gsmerge.gpu.raster import peak_weights
from gsmerge.gpu.scene import DevicePhotos, upload_gaussians, upload_photos
from gsmerge.gpu.score import photo_error
from gsmerge.render.photos import Photos
from gsmerge.stages.fit.full import Progress
from gsmerge.stages.fit.options import FitOptions
from gsmerge.stages.fit.report import FitReport
from gsmerge.stages.fit.stage import ALWAYS, CLOSE
from gsmerge.types import Gaussians

Pair = tuple[DevicePhotos, DevicePhotos]


def fit_gaussians(
    gaussians: Gaussians,
    photos: tuple[Photos, Photos],
    options: FitOptions,
    count: int = 0,
    seed: int = 0,
    progress: Progress | None = None,
    baseline_start: Gaussians | None = None,
    *,
    exact: bool = False,
    device: torch.device | str,
) -> tuple[Gaussians, FitReport | None]:
    """:func:`gsmerge.stages.fit.fit` on a device: the border of :func:`fit` for callers with core types."""
    device = torch.device(device)
    pair = upload_photos(photos[0], device), upload_photos(photos[1], device)
    other = None if baseline_start is None else upload_gaussians(baseline_start, device)
    start = upload_gaussians(gaussians, device)
    fitted, report = fit(start, pair, options, count, seed, progress, other, exact=exact)
    return fitted.numpy(), report


def fit(
    gaussians: Gaussians,
    photos: Pair,
    options: FitOptions,
    count: int = 0,
    seed: int = 0,
    progress: Progress | None = None,
    baseline_start: Gaussians | None = None,
    *,
    exact: bool = False,
) -> tuple[Gaussians, FitReport | None]:
    """Leave out what no photo shows, and fit the rest to the photos; arguments as of :func:`gsmerge.stages.fit.fit`."""
    if exact and not options.grows:
        options = replace(options, min_contribution=0.0)
    if not options.needs_photos:
        return gaussians, None
    full, half = photos
    keep = visible_mask(gaussians, half, options.min_contribution)
    if options.fit == "none":
        return gaussians[keep], None
    if options.fit == "color":
        fitted, report = fit_colors(gaussians, half, options, seed)
        return better_of(gaussians[keep], fitted[keep], report, full, CLOSE)
    kept = gaussians[keep]
    fitted, report = fit_full(kept, photos, options, count, seed, progress, baseline_start)
    fitted, report = better_of(kept, fitted, report, full, CLOSE)
    if report.accepted:
        return fitted, report
    if options.grows:  # the stages before left room for a growth that did not happen
        state = grow_to(start_state(kept), half, count)
        fitted, report = fit_colors(gaussians_of(state.x, state.shN), half, options, seed)
        return better_of(kept, fitted, report, full, ALWAYS) if report.accepted else (kept, report)
    fitted, report = fit_colors(gaussians, half, options, seed)
    return better_of(kept, fitted[keep], report, full, ALWAYS)


def visible_mask(gaussians: Gaussians, photos: DevicePhotos, min_weight: float) -> Tensor:
    """``[n]`` bool: the Gaussians with at least this blending weight at some pixel, or in no photo's frustum."""
    peak = torch.zeros(len(gaussians), device=gaussians.means.device)
    inside = torch.zeros_like(peak, dtype=torch.bool)
    for view in range(len(photos)):
        peaks, reached = peak_weights(gaussians, photos, view)
        inside |= reached
        peak = torch.maximum(peak, peaks)
    return ~inside | (peak >= min_weight)


def better_of(
    before: Gaussians, after: Gaussians, report: FitReport, photos: DevicePhotos, close: float
) -> tuple[Gaussians, FitReport]:
    """The fitted Gaussians; their start if the held-out blocks gained less than ``close`` dB and the photos lost."""
    if not report.accepted or report.holdout_after - report.holdout_before >= close:
        return after, report
    if photo_error(after, photos) <= photo_error(before, photos):
        return after, report
    return before, replace(report, method="none", accepted=False, stopped="the photos as a whole were shown worse")
