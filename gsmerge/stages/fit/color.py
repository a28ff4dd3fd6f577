"""gaussians -> fitted gaussians: colours that reproduce the input photos best.

With geometry, opacity and order fixed, every pixel is linear in the colours, so the best ones solve a sparse
linear system whose matrix is one splat and one transposed splat; a few preconditioned conjugate-gradient steps do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gsmerge.render import Splats, composite, plan_view, prepare
from gsmerge.render.photos import Photos
from gsmerge.render.weights import ViewWeights, apply, apply_transposed, view_weights
from gsmerge.runtime.threads import in_turn, parallel_map
from gsmerge.stages.fit.holdout import exposure_gains, holdout_psnr, training_weights
from gsmerge.stages.fit.options import FitOptions
from gsmerge.stages.fit.report import FitReport
from gsmerge.types import SH_C0, Gaussians

MAX_RETRIES = 2
HOLDOUT = 4  # times the share: the last steps see everything, and a small sample misjudges a scene of few views


@dataclass(frozen=True, eq=False)
class Drawn:
    """One set of Gaussians against the photos: per view the blending weights and the render with their own colours.

    Args:
        count: Number of Gaussians, n.
        views: Blending weights of every view.
        images: ``[h,w,3]`` renders.
    """

    count: int
    views: list[ViewWeights]
    images: list[np.ndarray]


@dataclass(frozen=True, eq=False)
class _System:
    """Least squares in the colours: renders, photos, pixel weights ``[h,w]``, exposure gains ``[v,3]``.

    ``color_precision [n,1]`` is the diagonal of earlier photos' normal equations, which the present colours solve.
    """

    drawn: Drawn
    photos: np.ndarray
    weights: list[np.ndarray]
    gains: np.ndarray
    color_precision: np.ndarray


def draw(gaussians: Gaussians, photos: Photos) -> Drawn:
    """Render the Gaussians into every photo and keep the blending weights."""
    splats: Splats = prepare(gaussians)

    def one_view(view: int) -> tuple[ViewWeights, np.ndarray]:
        plan = plan_view(splats, **photos.camera(view))
        return view_weights(plan), composite(plan)[0]

    views, images = zip(*parallel_map(one_view, range(len(photos))), strict=True)
    return Drawn(len(gaussians), list(views), list(images))


def fit_colors(
    gaussians: Gaussians,
    drawn: Drawn,
    photos: Photos,
    options: FitOptions,
    seed: int = 0,
    color_precision: np.ndarray | None = None,
) -> tuple[Gaussians, FitReport]:
    """Base colours fitted to the photos, kept only if held-out blocks of the photos get better.

    Args:
        gaussians: Geometry and opacities stay as they are; higher SH stay too.
        drawn: The same Gaussians against the photos, see :func:`draw`.
        photos: The input views.
        options: The solver's settings.
        seed: Chooses the held-out blocks.
        color_precision: ``[n]`` pixels of photos that are gone which each colour was fitted to; None: of none.

    Returns:
        The Gaussians with new sh0 (or the old ones, where the fit was not accepted), and the report.
    """
    train = training_weights(photos, min(0.5, HOLDOUT * options.holdout), seed)
    before_these = (
        np.zeros((drawn.count, 1)) if color_precision is None else color_precision[:, None].astype(np.float64)
    )
    plain = _System(drawn, photos.images, train, np.ones((len(photos), 3)), before_these)
    before = holdout_psnr(drawn.images, photos, train, options.min_gain)
    prior_weight = options.prior_weight
    for _ in range(1 + MAX_RETRIES):
        system, offsets = _solve(plain, options, prior_weight)
        fitted = parallel_map(partial(_image, plain, offsets=offsets), range(len(photos)))
        after = holdout_psnr(fitted, photos, train, options.min_gain)
        if after > before:
            offsets = _finish(system, offsets, options, prior_weight)
            report = FitReport("color", True, options.iterations, before, after, f"prior weight {prior_weight:g}")
            return replace(gaussians, sh0=_clamped(gaussians, offsets)), report
        prior_weight *= 8
    report = FitReport("none", False, options.iterations, before, after, "held-out parts of the photos did not improve")
    return gaussians, report


def _solve(plain: _System, options: FitOptions, prior_weight: float) -> tuple[_System, np.ndarray]:
    """Offsets ``[n,3]`` of the base colours that fit the training pixels, and the system with its final weights.

    A third of the steps with plain weights; then pixels that still fit badly count less, exposure is compensated,
    and another third follows.
    """
    steps = max(1, options.iterations // 3)
    offsets = _conjugate_gradients(plain, np.zeros((plain.drawn.count, 3)), steps, prior_weight)
    system = _reweighed(plain, plain.weights, offsets, options)
    return system, _conjugate_gradients(system, offsets, steps, prior_weight)


def _finish(system: _System, offsets: np.ndarray, options: FitOptions, prior_weight: float) -> np.ndarray:
    """The last steps, on all pixels."""
    everywhere = [np.ones_like(weight) for weight in system.weights]
    steps = max(1, options.iterations - 2 * (options.iterations // 3))
    return _conjugate_gradients(_reweighed(system, everywhere, offsets, options), offsets, steps, prior_weight)


def _conjugate_gradients(system: _System, x: np.ndarray, iterations: int, prior_weight: float) -> np.ndarray:
    """Jacobi-preconditioned conjugate gradients from ``x`` on.

    They minimise sum |gain (prior + W x) - photo|^2 + (prior_weight mass + color_precision) |x|^2.
    """
    mass, r = _residual(system, x)
    back = prior_weight * mass + system.color_precision
    r -= back * x
    inverse = 1 / (mass * (1 + prior_weight) + system.color_precision + 1e-6)
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


def _image(system: _System, view: int, offsets: np.ndarray | None) -> np.ndarray:
    """Render of a view with offsets on the base colours."""
    image = system.drawn.images[view]
    return image if offsets is None else image + apply(system.drawn.views[view], offsets)


def _residual(system: _System, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Diagonal scale ``[n,3]`` and negative gradient ``[n,3]`` of the data term at ``x``."""

    def one_view(view: int) -> np.ndarray:
        weight, gain = system.weights[view][..., None], system.gains[view].astype(np.float32)
        residual = weight * (system.photos[view] - gain * _image(system, view, x))
        return apply_transposed(system.drawn.views[view], np.concatenate([residual, weight], -1))

    mass, gradient = np.zeros_like(x), np.zeros_like(x)
    for view, sums in enumerate(in_turn(one_view, range(len(system.photos)))):
        ids, gain = system.drawn.views[view].ids, system.gains[view]
        mass[ids] += sums[:, 3:] * gain**2
        gradient[ids] += sums[:, :3] * gain
    return mass, gradient


def _normal(system: _System, x: np.ndarray) -> np.ndarray:
    """Normal matrix of the data term times ``x``."""

    def one_view(view: int) -> np.ndarray:
        matrix = system.drawn.views[view]
        return apply_transposed(matrix, apply(matrix, x) * system.weights[view][..., None])

    # views are added in their order, so that the threads cannot change the sum
    total = np.zeros_like(x)
    for view, sums in enumerate(in_turn(one_view, range(len(system.photos)))):
        total[system.drawn.views[view].ids] += sums * system.gains[view] ** 2
    return total


def _reweighed(system: _System, base: list[np.ndarray], x: np.ndarray, options: FitOptions) -> _System:
    """Weights ``base`` times Huber weights of the present residuals; exposure gains with geometric mean one."""

    views = range(len(system.photos))
    images = parallel_map(partial(_image, system, offsets=x), views)

    def one_view(view: int) -> tuple[np.ndarray, np.ndarray]:
        error = np.sqrt(((system.photos[view] - images[view]) ** 2).mean(-1))
        robust = base[view] * np.minimum(1, options.huber / np.maximum(error, 1e-6)).astype(np.float32)
        return robust, base[view] * (error < 2 * options.huber)

    weights, calm = zip(*parallel_map(one_view, views), strict=True)
    gains = exposure_gains(images, system.photos, calm, options.min_gain, options.max_gain)
    return replace(system, weights=list(weights), gains=gains)


def _clamped(gaussians: Gaussians, offsets: np.ndarray) -> np.ndarray:
    """New sh0 within a little more than the range of colours, or where they were outside it, no farther out."""
    before = 0.5 + SH_C0 * gaussians.sh0[:, 0].astype(np.float64)
    color = np.clip(before + offsets, np.minimum(before, -0.05), np.maximum(before, 1.05))
    return ((color - 0.5) / SH_C0).astype(np.float32)[:, None]
