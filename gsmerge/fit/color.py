"""Fit the colours of Gaussians to the photos.

With fixed geometry, opacities and order, every pixel is linear in the colours. So the best colours solve a sparse
linear system. A product with its matrix takes one splat and one transposed splat. A few preconditioned
conjugate-gradient steps are enough.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmerge.fit.photo_sizes import exposure_gains, holdout_psnr, training_weights
from gsmerge.fit.report import FitReport, FitResult
from gsmerge.geometry import rgb_to_sh0, sh0_to_rgb
from gsmerge.raster import composite, make_splats, tile_view
from gsmerge.raster.photos import Photos
from gsmerge.raster.weights import ViewWeights, apply, apply_transposed, view_weights
from gsmerge.runtime.threads import in_turn, parallel_map
from gsmerge.settings.fit import FitOptions
from gsmerge.types import Gaussians

MAX_RETRIES = 2
# Factor on the share of held-out patches. Few patches would misjudge a scene of few views. The last steps use all
# patches, so none is lost
HOLDOUT = 4


@dataclass(frozen=True, eq=False)
class Drawn:
    """A set of Gaussians drawn into every photo: blending weights and images."""

    views: list[ViewWeights]  # Blending weights of every view
    images: list[np.ndarray]  # [h,w,3] renders


def draw(gaussians: Gaussians, photos: Photos) -> Drawn:
    """Render the Gaussians into every photo and keep the blending weights."""
    splats = make_splats(gaussians)

    def one_view(view: int) -> tuple[ViewWeights, np.ndarray]:
        tiled = tile_view(splats, **photos.camera(view))
        return view_weights(tiled), composite(tiled)[0]

    views, images = zip(*parallel_map(one_view, range(len(photos))), strict=True)
    return Drawn(list(views), list(images))


def fit_colors(
    gaussians: Gaussians,
    drawn: Drawn,
    photos: Photos,
    options: FitOptions,
    seed: int = 0,
    color_precision: np.ndarray | None = None,
) -> FitResult:
    """Fit base colours to the photos, and keep them only if held-out patches get better.

    ``drawn`` are the same Gaussians in the photos, see :func:`draw`; ``seed`` chooses the held-out patches. The present
    colours are a prior with the weights ``color_precision [n]``: the number of pixels of earlier photos to which each
    colour was fitted. Geometry, opacities and higher harmonics stay.
    """
    train = training_weights(photos, min(0.5, HOLDOUT * options.holdout), seed)
    precision = 0.0 if color_precision is None else color_precision[:, None].astype(np.float64)
    system = ColorSystem(drawn, photos, options, train, train, np.ones((len(photos), 3)), precision)
    offsets, report = solve_colors(system, np.zeros((len(gaussians), 3)), options)
    if not report.accepted:
        return gaussians, report
    sh0 = _add_offsets(gaussians.sh0.astype(np.float64), offsets[:, None])
    return replace(gaussians, sh0=sh0.astype(np.float32)), report


@dataclass(frozen=True, eq=False)
class ColorSystem:
    """Least-squares system in the colours of n Gaussians; ``x [n,3]`` are offsets, float64."""

    drawn: Drawn  # The Gaussians against the photos
    photos: Photos  # V photos
    options: FitOptions  # The solver's settings
    train: list[np.ndarray]  # [h,w] of every view: 0 on the held-out patches, 1 elsewhere
    weights: list[np.ndarray]  # [h,w] of the pixels of every view
    gains: np.ndarray  # [v,3] exposures
    precision: np.ndarray | float  # [n,1] prior of earlier photos on offsets of 0, added to the diagonal; or 0

    def _image(self, view: int, x: np.ndarray) -> np.ndarray:
        return self.drawn.images[view] + apply(self.drawn.views[view], x)

    def _images(self, x: np.ndarray) -> list[np.ndarray]:
        return parallel_map(lambda view: self._image(view, x), range(len(self.photos)))

    def score(self, x: np.ndarray | None = None) -> float:
        """Return the PSNR (dB) of the held-out patches at offsets ``x``; None: with the colours before the fit."""
        images = self.drawn.images if x is None else self._images(x)
        return holdout_psnr(images, self.photos, self.train, self.options.tuning.min_gain)

    def residual(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the diagonal scale ``[n,3]`` and the negative gradient ``[n,3]`` of the data term."""

        def one_view(view: int) -> np.ndarray:
            weight, gain = self.weights[view][..., None], self.gains[view].astype(np.float32)
            residual = weight * (self.photos.images[view] - gain * self._image(view, x))
            return apply_transposed(self.drawn.views[view], np.concatenate([residual, weight], -1))

        mass, gradient = np.zeros_like(x), np.zeros_like(x)
        for view, sums in enumerate(in_turn(one_view, range(len(self.photos)))):
            ids, gain = self.drawn.views[view].ids, self.gains[view]
            mass[ids] += sums[:, 3:] * gain**2
            gradient[ids] += sums[:, :3] * gain
        return mass, gradient

    def normal(self, x: np.ndarray) -> np.ndarray:
        """Return the normal matrix of the data term times ``x``, ``[n,3]``."""

        def one_view(view: int) -> np.ndarray:
            matrix = self.drawn.views[view]
            return apply_transposed(matrix, apply(matrix, x) * self.weights[view][..., None])

        # views are added in their order, so that the threads cannot change the sum
        total = np.zeros_like(x)
        for view, sums in enumerate(in_turn(one_view, range(len(self.photos)))):
            total[self.drawn.views[view].ids] += sums * self.gains[view] ** 2
        return total

    def reweigh(self, x: np.ndarray, *, everywhere: bool = False) -> ColorSystem:
        """Return the system with Huber weights and exposure gains at ``x``, on training pixels or ``everywhere``."""
        images, options = self._images(x), self.options

        def one_view(view: int) -> tuple[np.ndarray, np.ndarray]:
            train = self.train[view]
            base = np.where(train == 0, np.float32(1), train) if everywhere else train
            error = np.sqrt(((self.photos.images[view] - images[view]) ** 2).mean(-1))
            robust = base * np.minimum(1, options.tuning.huber / np.maximum(error, 1e-6)).astype(np.float32)
            return robust, base * (error < 2 * options.tuning.huber)

        weights, calm = zip(*parallel_map(one_view, range(len(self.photos))), strict=True)
        gains = exposure_gains(images, self.photos.images, calm, options.tuning.min_gain, options.tuning.max_gain)
        return replace(self, weights=list(weights), gains=gains)


def solve_colors(system: ColorSystem, start: np.ndarray, options: FitOptions) -> tuple[np.ndarray, FitReport]:
    """Solve for offsets ``[n,3]`` of the base colours; return ``start`` if the held-out patches get worse.

    The first third of the steps uses equal weights. In the second third, pixels with large errors count less, and
    exposure is compensated. The last third uses all pixels, including the held-out patches.
    """
    steps = options.tuning.iterations
    third = steps // 3
    before, prior_weight = system.score(), options.tuning.prior_weight
    for _ in range(1 + MAX_RETRIES):
        x = conjugate_gradients(system, start, max(1, third), prior_weight)
        x = conjugate_gradients(system.reweigh(x), x, max(1, third), prior_weight)
        after = system.score(x)
        if after > before:
            last = max(1, steps - 2 * third)
            x = conjugate_gradients(system.reweigh(x, everywhere=True), x, last, prior_weight)
            return x, FitReport("color", True, steps, before, after, f"prior weight {prior_weight:g}")
        prior_weight *= 8
    stopped = "held-out patches of the photos did not improve"
    return start, FitReport("none", False, steps, before, after, stopped)


def conjugate_gradients(system: ColorSystem, x: np.ndarray, iterations: int, prior_weight: float) -> np.ndarray:
    """Run Jacobi-preconditioned conjugate gradients (Hestenes and Stiefel 1952) from ``x [n,3]`` on.

    They minimise sum |gain (render + W x) - photo|^2 + (prior_weight mass + precision) |x|^2, where W are the blending
    weights, and ``render`` is the image before the fit.
    """
    mass, r = system.residual(x)
    prior = prior_weight * mass + system.precision
    r = r - prior * x
    inverse = 1 / (mass * (1 + prior_weight) + system.precision + 1e-6)
    z = inverse * r
    p, rz = z, (r * z).sum(0)
    for _ in range(iterations):
        ap = system.normal(p) + prior * p
        step = rz / ((p * ap).sum(0) + 1e-12)
        x, r = x + step * p, r - step * ap
        z = inverse * r
        rz, before = (r * z).sum(0), rz
        p = z + rz / (before + 1e-12) * p
    return x


def _add_offsets(sh0: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Add offsets to base colours; clip the colours to [-0.05, 1.05], or to their value before if that is outside."""
    before = sh0_to_rgb(sh0)
    return rgb_to_sh0((before + offsets).clip(before.clip(None, -0.05), before.clip(1.05)))
