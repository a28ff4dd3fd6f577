"""Renders against photos, on a device: PSNR and mean squared errors; :mod:`gsmerge.render.photos`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsmerge.gpu.raster import draw_gaussians
from gsmerge.gpu.scene import DevicePhotos
from gsmerge.kernels.raster.project import TILE
from gsmerge.render.photos import scored_tiles
from gsmerge.types import Gaussians


def photo_error(gaussians: Gaussians, photos: DevicePhotos) -> float:
    """Mean squared error of all photos."""
    errors = [
        (draw_gaussians(gaussians, photos, view).clamp(0, 1) - photo).square().mean(dtype=torch.float64)
        for view, photo in enumerate(photos.images)
    ]
    return float(torch.stack(errors).mean())


def photo_psnr(
    gaussians: Gaussians, photos: DevicePhotos, views: Sequence[int], *, near: float, quarter: bool
) -> float:
    """Mean over some views of the PSNR (dB) of their photos.

    Args:
        gaussians: Gaussians in the photos' frame.
        photos: Of full size.
        views: Of the photos.
        near: Near plane.
        quarter: Score the tiles of :func:`gsmerge.render.photos.scored_tiles` alone.
    """
    values = []
    for view in views:
        image = draw_gaussians(gaussians, photos, view, near=near).clamp(0, 1)
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
