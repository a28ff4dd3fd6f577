"""The fit on a device: what :mod:`gsmerge.stages.fit.stage` is made of there."""

from __future__ import annotations

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
from gsmerge.stages.fit.stage import FitBackend, fit_with
from gsmerge.types import Gaussians


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
    """:func:`gsmerge.stages.fit.fit` on a device, of core types."""
    device = torch.device(device)
    pair = upload_photos(photos[0], device), upload_photos(photos[1], device)
    other = None if baseline_start is None else upload_gaussians(baseline_start, device)
    start = upload_gaussians(gaussians, device)
    fitted, report = fit_with(ON_DEVICE, start, pair, options, count, seed, progress, other, exact=exact)
    return fitted.numpy(), report


def visible_mask(gaussians: Gaussians, photos: DevicePhotos, min_weight: float) -> Tensor:
    """``[n]`` bool: the Gaussians with at least this blending weight at some pixel, or in no photo's frustum."""
    peak = torch.zeros(len(gaussians), device=gaussians.means.device)
    inside = torch.zeros_like(peak, dtype=torch.bool)
    for view in range(len(photos)):
        peaks, reached = peak_weights(gaussians, photos, view)
        inside |= reached
        peak = torch.maximum(peak, peaks)
    return ~inside | (peak >= min_weight)


def _grow(gaussians: Gaussians, photos: DevicePhotos, count: int) -> Gaussians:
    state = grow_to(start_state(gaussians), photos, count)
    return gaussians_of(state.x, state.shN)


ON_DEVICE = FitBackend(visible_mask, fit_full, fit_colors, _grow, photo_error)
