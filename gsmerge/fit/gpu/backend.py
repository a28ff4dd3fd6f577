"""Functions of the fit and the scores on a device."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from gsmerge.fit.gpu.adam import gaussians_of, start_state
from gsmerge.fit.gpu.color_fit import fit_colors
from gsmerge.fit.gpu.device_photos import (
    DevicePhotos,
    draw_gaussians,
    peak_weights,
    upload_gaussians,
    upload_photos,
)
from gsmerge.fit.gpu.full_fit import fit_full, grow_to
from gsmerge.fit.stage import FitBackend
from gsmerge.raster import render
from gsmerge.raster.photos import Photos, view_psnr
from gsmerge.types import Cameras, Gaussians, as_array


def make_backend(device: torch.device) -> FitBackend[DevicePhotos]:
    """Return the functions of the fit and the scores for one device."""
    return FitBackend(
        device="cuda" if device.type == "cuda" else "cpu",
        upload=partial(upload_gaussians, device=device),
        upload_photos=partial(upload_photos, device=device),
        download=Gaussians.numpy,
        look_at=look_at,
        fit_full=fit_full,
        fit_colors=fit_colors,
        grow=grow,
        photo_error=photo_error,
        photo_psnr=partial(photo_psnr, device=device),
        memory_errors=(torch.cuda.OutOfMemoryError,),
    )


def look_at(gaussians: Gaussians, photos: tuple[DevicePhotos, ...], min_weight: float) -> tuple[Tensor, None]:
    """Return a mask ``[n]`` of the Gaussians worth keeping; the full fit looks again by itself."""
    return visible_mask(gaussians, photos[1], min_weight), None


def visible_mask(gaussians: Gaussians, photos: DevicePhotos, min_weight: float) -> Tensor:
    """Return a mask ``[n]`` of the Gaussians worth keeping, see :func:`gsmerge.fit.stage.visible_mask`."""
    peak = torch.zeros(len(gaussians), device=gaussians.means.device)
    inside = torch.zeros_like(peak, dtype=torch.bool)
    for view in range(len(photos)):
        peaks, reached = peak_weights(gaussians, photos, view)
        inside |= reached
        peak = torch.maximum(peak, peaks)
    return ~inside | (peak >= min_weight)


def grow(gaussians: Gaussians, photos: DevicePhotos, count: int) -> tuple[Gaussians, np.ndarray]:
    """Halve Gaussians where the photos are shown worst, until there are ``count``; also the row of each one's start."""
    state = grow_to(start_state(gaussians), photos, count)
    return gaussians_of(state.x, state.shN), state.origins.cpu().numpy()


def photo_error(gaussians: Gaussians, photos: DevicePhotos) -> float:
    """Return the mean squared error of all photos."""
    errors = []
    for view, photo in enumerate(photos.images):
        image = draw_gaussians(gaussians, photos, view).clamp(0, 1)
        errors.append((image - photo).square().mean(dtype=torch.float64))
    return float(torch.stack(errors).mean())


def photo_psnr(
    gaussians: Gaussians,
    photos: Photos,
    views: Sequence[int],
    *,
    quarter: bool,
    near: float,
    device: torch.device,
) -> float:
    """Return the mean over some views of the PSNR (dB) of their photos, rendered on a device.

    Gaussians and full-size photos are on the host, in one frame, whose unit ``near`` is in.
    ``quarter``: score the tiles of :func:`gsmerge.raster.photos.scored_tiles` alone.
    """
    uploaded = upload_gaussians(gaussians, device, dtype=None)  # float32 is too coarse far from the origin
    cameras = Cameras(photos.viewmats, photos.Ks, photos.width, photos.height)
    values = []
    for view in views:
        image = render(uploaded, cameras[[view]].to(device), near=near).images[0]
        values.append(view_psnr(as_array(image), photos, view, quarter=quarter))
    return float(np.mean(values))
