"""Renders against photos, on a device: PSNR and mean squared errors; :mod:`gsmerge.render.photos`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsmerge.gpu.raster import draw_gaussians
from gsmerge.gpu.scene import DevicePhotos, upload_gaussians, upload_photos
from gsmerge.kernels.raster.project import TILE
from gsmerge.render.photos import Photos, scored_tiles
from gsmerge.types import Gaussians


def photo_error(gaussians: Gaussians, photos: DevicePhotos) -> float:
    """Mean squared error of all photos."""
    errors = [
        (draw_gaussians(gaussians, photos, view).clamp(0, 1) - photo).square().mean(dtype=torch.float64)
        for view, photo in enumerate(photos.images)
    ]
    return float(torch.stack(errors).mean())


def score_photos(
    gaussians: Gaussians, photos: Photos, views: Sequence[int], device: torch.device | str, *, quarter: bool
) -> float:
    """Return the mean over some views of the PSNR (dB) of their photos; :func:`gsmerge.render.photos.photo_psnr`.

    Args:
        gaussians: Canonical Gaussians.
        photos: Of full size, in the same frame.
        views: Of the photos.
        device: Where to draw.
        quarter: Score the tiles of :func:`gsmerge.render.photos.scored_tiles` alone.
    """
    uploaded = upload_photos(photos, torch.device(device))
    return photo_psnr(upload_gaussians(gaussians, torch.device(device)), uploaded, views, quarter=quarter)


def photo_psnr(gaussians: Gaussians, photos: DevicePhotos, views: Sequence[int], *, quarter: bool) -> float:
    """The same of Gaussians and photos that are on the device."""
    values = []
    for view in views:
        image = draw_gaussians(gaussians, photos, view).clamp(0, 1)
        squares = (image - photos.images[view]).double().square()
        mask = scored_pixels(photos, view) if quarter else None
        error = squares.mean() if mask is None else (squares * mask[..., None]).sum() / (3 * mask.sum())
        values.append(-10 * error.log10())
    return float(torch.stack(values).mean())


def scored_pixels(photos: DevicePhotos, view: int) -> Tensor | None:
    """``[h,w]`` bool: the pixels of a view that scenes are judged by; None: all."""
    tiles = scored_tiles(view, photos.width, photos.height)
    if tiles is None:
        return None
    pixels = tiles.repeat(TILE, 0).repeat(TILE, 1)[: photos.height, : photos.width].copy()
    return torch.from_numpy(pixels).to(photos.images.device)
