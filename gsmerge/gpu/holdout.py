"""Scores of a fit on a device: held-out blocks, exposures, how many photos show a Gaussian."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsmerge.gpu.adam import FitState
from gsmerge.gpu.raster import draw_and_transpose, draw_black, harmonic_colors
from gsmerge.gpu.scene import DevicePhotos
from gsmerge.render.colored import Shape
from gsmerge.stages.fit.options import FitOptions
from gsmerge.types import SH_C0


def state_shape(state: FitState) -> Shape:
    """What the rasterizer is given of a state."""
    return state.means, state.quats, state.scales, state.opacities


def state_colors(state: FitState, photos: DevicePhotos, view: int) -> Tensor:
    """``[n,3]`` colours of a state in a view: as they are, or through the harmonics."""
    if state.shN.shape[1] == 0:
        return state.colors
    return harmonic_colors(state.means, ((state.colors - 0.5) / SH_C0)[:, None], state.shN, photos, view)


def draw_state(state: FitState, photos: DevicePhotos, view: int) -> Tensor:
    """``[h,w,3]`` render of a photo over black."""
    return draw_black(state_shape(state), state_colors(state, photos, view), photos, view)


def holdout_score(state: FitState, photos: DevicePhotos, weights: Tensor, min_gain: float) -> float:
    """PSNR (dB) of a state on the held-out blocks of photos."""
    images = torch.stack([draw_state(state, photos, view) for view in range(len(photos))])
    return holdout_psnr(images, photos.images, weights, min_gain)


def initial_scores(
    state: FitState, photos: tuple[DevicePhotos, DevicePhotos], weights: Tensor, options: FitOptions
) -> tuple[float, Tensor, Tensor]:
    """PSNR (dB) of the half-size held-out blocks; ``[n]`` box shares and ``[n]`` least log scales.

    See :func:`gsmerge.stages.fit.full.initial_scores`.
    """
    full, half = photos
    images, shape, rates = [], state_shape(state), options.rates
    sums, squares = (torch.zeros(len(state), dtype=torch.float64, device=state.x.device) for _ in range(2))
    pixels = torch.full_like(state.units, torch.inf)
    for view in range(len(half)):
        image, transpose = draw_and_transpose(shape, state_colors(state, half, view), half, view)
        each = transpose(torch.ones_like(image))[:, 0].double()
        images.append(image)
        sums += each
        squares += each * each
        ahead, focal = half.viewmats[view, 2], float(full.host.Ks[view][[0, 1], [0, 1]].max())
        sizes = (state.means @ ahead[:3] + ahead[3]) / focal
        pixels = torch.where(transpose.reached, pixels.minimum(sizes), pixels)
    photos_each = sums**2 / squares.clamp_min(1e-12)
    shares = (photos_each - 1).clamp(rates.single_view_share, 1).float()
    min_sizes = (rates.min_scale * pixels.where(pixels.isfinite(), 0)).log()
    return holdout_psnr(torch.stack(images), half.images, weights, options.min_gain), shares, min_sizes


def holdout_psnr(images: Tensor, photos: Tensor, weights: Tensor, min_gain: float) -> float:
    """PSNR (dB) of renders on the held-out blocks, exposure of the photos set aside.

    Args:
        images: ``[v,h,w,3]``.
        photos: ``[v,h,w,3]``.
        weights: ``[v,h,w]`` 0 on the held-out blocks, 1 elsewhere.
        min_gain: Exposure against the mean, as a factor, from which on it is set aside.
    """
    clipped = images.clamp(0, 1)
    gains = exposure_gains(clipped, photos, weights, min_gain)
    mask = weights == 0
    squares = ((clipped * gains[:, None, None] - photos) ** 2).sum(-1) * mask
    error, count = squares.sum(dtype=torch.float64), mask.sum()
    return float(-10 * (error / (3 * count).clamp_min(1)).clamp_min(1e-12).log10())


def exposure_gains(images: Tensor, photos: Tensor, weights: Tensor, min_gain: float, max_gain: float = 2.0) -> Tensor:
    """``[v,3]`` factors that bring renders to the photos' exposure, with geometric mean one.

    Least squares on the weighted pixels, per view and channel; ones where no view differs by ``min_gain``.
    """
    weighted = weights[..., None] * images
    with_photo, with_image = ((weighted * other).sum((1, 2), dtype=torch.float64) for other in (photos, images))
    gains = (with_photo / with_image.clamp_min(1e-9)).clamp(1 / max_gain, max_gain)
    gains = gains / gains.log().mean(0).exp()
    differs = gains.log().abs().max() >= math.log(min_gain)
    return torch.where(differs, gains, 1.0).float()
