"""gaussians -> gaussians with fitted colours, on a device: :mod:`gsmerge.stages.fit.color`.

The same conjugate gradients with the same weights. The matrix of a view, applied to colours, is an image, and its
transpose the gradient of an image: each view is drawn once, and its transpose kept for as long as it is used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsmerge.gpu.holdout import exposure_gains, holdout_psnr
from gsmerge.gpu.raster import draw_all, draw_and_transpose, draw_black, shape_of
from gsmerge.gpu.scene import DevicePhotos
from gsmerge.stages.fit.color import HOLDOUT, MAX_RETRIES
from gsmerge.stages.fit.holdout import training_weights
from gsmerge.stages.fit.options import FitOptions
from gsmerge.stages.fit.report import FitReport
from gsmerge.types import SH_C0, Gaussians


@dataclass(frozen=True, eq=False)
class _System:
    """Least squares in the colours of n Gaussians.

    Args:
        gaussians: The Gaussians, whose geometry stays.
        photos: V photos.
        images: ``[v,h,w,3]`` their renders with the colours as they were.
        weights: ``[v,h,w]`` of the pixels.
        gains: ``[v,3]`` exposures.
    """

    gaussians: Gaussians
    photos: DevicePhotos
    images: Tensor
    weights: Tensor
    gains: Tensor

    def spread(self, view: int, colors: Tensor) -> Tensor:
        """The matrix of a view times colours ``[n,3]``: an image ``[h,w,3]``."""
        return draw_black(shape_of(self.gaussians), colors.float(), self.photos, view)

    def fitted(self, offsets: Tensor) -> Tensor:
        """``[v,h,w,3]`` renders with offsets ``[n,3]`` on the base colours."""
        return torch.stack([image + self.spread(view, offsets) for view, image in enumerate(self.images)])


def fit_colors(
    gaussians: Gaussians, photos: DevicePhotos, options: FitOptions, seed: int = 0
) -> tuple[Gaussians, FitReport]:
    """Base colours fitted to the photos, kept only if held-out blocks of the photos get better.

    Args:
        gaussians: Gaussians, whose geometry, opacities and higher harmonics stay as they are.
        photos: The input views.
        options: The solver's settings.
        seed: Chooses the held-out blocks.
    """
    device = gaussians.means.device
    train = training_weights(photos.host, min(0.5, HOLDOUT * options.holdout), seed)
    weights = torch.from_numpy(np.stack(train)).to(device)
    images = torch.stack(draw_all(gaussians, photos))
    plain = _System(gaussians, photos, images, weights, torch.ones(len(photos), 3, device=device))
    before = holdout_psnr(images, photos.images, weights, options.min_gain)
    prior_weight = options.prior_weight
    for _ in range(1 + MAX_RETRIES):
        system, offsets = _solve(plain, options, prior_weight)
        after = holdout_psnr(plain.fitted(offsets), photos.images, weights, options.min_gain)
        if after > before:
            offsets = _finish(system, offsets, options, prior_weight)
            report = FitReport("color", True, options.iterations, before, after, f"prior weight {prior_weight:g}")
            return replace(gaussians, sh0=_clamped(gaussians, offsets)), report
        prior_weight *= 8
    report = FitReport("none", False, options.iterations, before, after, "held-out parts of the photos did not improve")
    return gaussians, report


def _solve(plain: _System, options: FitOptions, prior_weight: float) -> tuple[_System, Tensor]:
    """Offsets ``[n,3]`` of the base colours that fit the training pixels, and the system with its final weights."""
    steps = max(1, options.iterations // 3)
    start = torch.zeros(len(plain.gaussians), 3, dtype=torch.float64, device=plain.images.device)
    offsets = conjugate_gradients(plain, start, steps, prior_weight)
    system = _reweighed(plain, plain.weights, offsets, options)
    return system, conjugate_gradients(system, offsets, steps, prior_weight)


def _finish(system: _System, offsets: Tensor, options: FitOptions, prior_weight: float) -> Tensor:
    """The last steps, on all pixels."""
    steps = max(1, options.iterations - 2 * (options.iterations // 3))
    everywhere = torch.ones_like(system.weights)
    return conjugate_gradients(_reweighed(system, everywhere, offsets, options), offsets, steps, prior_weight)


def conjugate_gradients(system: _System, x: Tensor, iterations: int, prior_weight: float) -> Tensor:
    """Jacobi-preconditioned conjugate gradients (Hestenes and Stiefel 1952) from ``x [n,3]`` on.

    They minimise sum |gain (prior + W x) - photo|^2 + prior_weight mass |x|^2.
    """
    mass, r = _residual(system, x)
    back = prior_weight * mass
    r = r - back * x
    inverse = 1 / (mass * (1 + prior_weight) + 1e-6)
    z = inverse * r
    p, rz = z, (r * z).sum(0)
    for _ in range(iterations):
        ap = _normal(system, p) + back * p
        step = rz / ((p * ap).sum(0) + 1e-12)
        x, r = x + step * p, r - step * ap
        z = inverse * r
        rz, before = (r * z).sum(0), rz
        p = z + rz / (before + 1e-12) * p
    return x


def _residual(system: _System, x: Tensor) -> tuple[Tensor, Tensor]:
    """Diagonal scale ``[n,3]`` and negative gradient ``[n,3]`` of the data term at ``x``."""
    mass, gradient = torch.zeros_like(x), torch.zeros_like(x)
    for view, image in enumerate(system.images):
        weight, gain = system.weights[view][..., None], system.gains[view]
        added, transpose = draw_and_transpose(shape_of(system.gaussians), x.float(), system.photos, view)
        residual = weight * (system.photos.images[view] - gain * (image + added))
        mass += transpose(weight.expand_as(image)) * gain**2
        gradient += transpose(residual) * gain
    return mass, gradient


def _normal(system: _System, x: Tensor) -> Tensor:
    """Normal matrix of the data term times ``x``."""
    total = torch.zeros_like(x)
    for view in range(len(system.images)):
        image, transpose = draw_and_transpose(shape_of(system.gaussians), x.float(), system.photos, view)
        total += transpose(image * system.weights[view][..., None]) * system.gains[view] ** 2
    return total


def _reweighed(system: _System, base: Tensor, x: Tensor, options: FitOptions) -> _System:
    """Weights ``base`` times Huber weights of the present residuals; exposure gains with geometric mean one."""
    images = system.fitted(x)
    error = ((system.photos.images - images) ** 2).mean(-1).sqrt()
    robust = base * (options.huber / error.clamp_min(1e-6)).clamp_max(1)
    calm = base * (error < 2 * options.huber)
    gains = exposure_gains(images, system.photos.images, calm, options.min_gain, options.max_gain)
    return replace(system, weights=robust, gains=gains)


def _clamped(gaussians: Gaussians, offsets: Tensor) -> Tensor:
    """New sh0 within a little more than the range of colours, or where they were outside it, no farther out."""
    before = 0.5 + SH_C0 * gaussians.sh0[:, 0].double()
    color = (before + offsets).clamp(before.clamp_max(-0.05), before.clamp_min(1.05))
    return ((color - 0.5) / SH_C0).float()[:, None]
