"""gaussians -> fitted gaussians: all parameters moved onto the input photos by a short, confined optimisation.

One view per step: L1 and structural similarity on a random background, half-size photos first, Adam with rates in
units of each Gaussian's own size, a box about the start. The number of Gaussians never changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from gsmerge.fit.options import FitOptions
from gsmerge.kernels import optimise as kernels
from gsmerge.photos import Photos
from gsmerge.render import Splats, composite
from gsmerge.render.gradient import plan_differentiable, plan_gradients
from gsmerge.threads import parallel_map
from gsmerge.types import SH_C0, Gaussians

ROWS = 16384  # Gaussians per piece of an optimiser step
WINDOW = (7, 7)  # of structural similarity


@dataclass(eq=False)
class State:
    """Parameters under optimisation, and the arrays that they mean to the rasterizer.

    Args:
        x: ``[n,14]`` float32: mean, log scale, quaternion, opacity logit, colour.
        x0: The start.
        m: First moment.
        v: Second moment.
        units: ``[n]`` size of each Gaussian: geometric mean of its two largest scales at the start.
        splats: Means, quaternions, scales and opacities as the rasterizer takes them.
        colors: ``[n,3]``.
    """

    x: np.ndarray
    x0: np.ndarray
    m: np.ndarray
    v: np.ndarray
    units: np.ndarray
    splats: Splats
    colors: np.ndarray
    step: int = 0


def start_state(gaussians: Gaussians) -> State:
    """The optimiser's view of some Gaussians."""
    count = len(gaussians)
    x = np.empty((count, kernels.COLUMNS), np.float32)
    scales = gaussians.scales.numpy().clip(1e-9)
    opacities = gaussians.opacities.double().numpy().clip(0.004, 0.999)
    x[:, :3] = gaussians.means.numpy()
    x[:, kernels.SIZE : kernels.QUAT] = np.log(scales)
    x[:, kernels.QUAT : kernels.LOGIT] = gaussians.quats.numpy()
    x[:, kernels.LOGIT] = np.log(opacities / (1 - opacities))
    x[:, kernels.COLOR :] = 0.5 + SH_C0 * gaussians.sh0[:, 0].numpy()
    return state_from(x)


def state_from(x: np.ndarray) -> State:
    """A fresh state at given parameters."""
    count = len(x)
    sizes = np.sort(x[:, kernels.SIZE : kernels.QUAT], 1)
    units = np.exp((sizes[:, 1] + sizes[:, 2]) / 2)
    splats = Splats(
        means=np.ascontiguousarray(x[:, :3]),
        quats=np.ascontiguousarray(x[:, kernels.QUAT : kernels.LOGIT]),
        scales=np.exp(x[:, kernels.SIZE : kernels.QUAT]),
        opacities=(1 / (1 + np.exp(-x[:, kernels.LOGIT]))).astype(np.float32),
        sh0=np.zeros((count, 1, 3), np.float32),
        shN=np.zeros((count, 0, 3), np.float32),
        origin=np.zeros(3),
    )
    colors = np.ascontiguousarray(x[:, kernels.COLOR :])
    return State(x, x.copy(), np.zeros_like(x), np.zeros_like(x), units, splats, colors)


def end_state(state: State, gaussians: Gaussians) -> Gaussians:
    """Gaussians of a state; higher SH from those that it started from."""
    s, tensor = state.splats, torch.from_numpy
    sh0 = tensor((state.colors - 0.5) / SH_C0).float()[:, None]
    return Gaussians(tensor(s.means), tensor(s.quats), tensor(s.scales), tensor(s.opacities), sh0, gaussians.shN)


@dataclass(frozen=True, eq=False)
class Pyramid:
    """The photos at full and at half size, with the photo's part of structural similarity."""

    levels: tuple[Photos, Photos]


def image_gradient(image: np.ndarray, photo: np.ndarray, weight: np.ndarray | None, dssim: float) -> np.ndarray:
    """Gradient of the mean over the pixels of (1 - dssim) L1 + dssim (1 - SSIM), windows of 7 x 7.

    Args:
        image: ``[h,w,3]`` float32.
        photo: ``[h,w,3]`` float32.
        weight: ``[h,w]`` weights of the pixels, None for ones.
        dssim: Share of structural similarity.
    """

    def box(a: np.ndarray) -> np.ndarray:
        return cv2.blur(a, WINDOW, borderType=cv2.BORDER_CONSTANT)

    mean, square, cross = np.empty_like(image), np.empty_like(image), np.empty_like(image)
    windows = [box(image), box(photo), box(image * image), box(photo * photo), box(image * photo)]
    kernels.similarity_terms(*(w.reshape(-1) for w in windows), mean.reshape(-1), square.reshape(-1), cross.reshape(-1))
    if weight is not None:
        for terms in (mean, square, cross):
            terms *= weight[..., None]
    similarity = box(mean) + 2 * image * box(square) + photo * box(cross)
    gradient = np.sign(image - photo)
    if weight is not None:
        gradient *= weight[..., None]
    gradient *= 1 - dssim
    gradient -= dssim * similarity
    gradient /= image.shape[0] * image.shape[1]
    return gradient


def fit_step(
    state: State,
    photos: Photos,
    view: int,
    rates: np.ndarray,
    options: FitOptions,
    rng: np.random.Generator,
    weight: np.ndarray | None,
) -> None:
    """One Adam step on one view."""
    background = rng.random(3, dtype=np.float32)
    opacities = None
    if options.dropout > 0:
        kept = rng.random(len(state.x), dtype=np.float32) >= options.dropout
        opacities = kept * np.minimum(state.splats.opacities / np.float32(1 - options.dropout), np.float32(0.99))
    plan = plan_differentiable(
        state.splats, photos.viewmats[view], photos.Ks[view], photos.width, photos.height,
        eps2d=photos.eps2d, opacities=opacities,
    )  # fmt: skip
    image, transmittance = composite(plan, state.colors, background)
    gradient = image_gradient(image, photos.images[view], weight, options.dssim)
    g = plan_gradients(plan, gradient, image=image, transmittance=transmittance, colors=state.colors)
    state.step += 1
    limits = np.array([options.reach, options.reach_size, options.reach_logit], np.float32)
    betas = np.array([options.beta1, options.beta2], np.float32)
    s = state.splats

    def update(first: int) -> None:
        last = min(first + ROWS, len(state.x))
        kernels.adam(
            state.x, state.x0, state.m, state.v, state.units, g.ids,
            g.means, g.quats, g.scales, g.opacities, g.colors, rates, limits, betas, state.step,
            first, last, s.means, s.quats, s.scales, s.opacities, state.colors,
        )  # fmt: skip

    parallel_map(update, range(0, len(state.x), ROWS))


def step_rates(options: FitOptions, progress: float) -> np.ndarray:
    """Rates of the fourteen columns at a point of the run, decaying geometrically."""
    base = (options.rate_mean,) * 3 + (options.rate_size,) * 3 + (options.rate_quat,) * 4
    base += (options.rate_logit,) + (options.rate_color,) * 3
    return (np.array(base) * options.decay**progress).astype(np.float32)


Progress = Callable[[int, int], None]


def fit_full(gaussians: Gaussians, photos: tuple[Photos, Photos], options: FitOptions, seed: int = 0) -> Gaussians:
    """All parameters fitted to the photos.

    Args:
        gaussians: The start, canonical.
        photos: The input views at full and at half size.
        options: Steps, rates, limits.
        seed: Order of the views, backgrounds, dropout.
    """
    rng, state, queue = np.random.default_rng(seed), start_state(gaussians), []
    for step in range(options.fit_steps):
        progress = step / options.fit_steps
        if not queue:
            queue = list(rng.permutation(len(photos[0])))
        level = photos[1] if progress < options.coarse else photos[0]
        fit_step(state, level, queue.pop(), step_rates(options, progress), options, rng, None)
    return end_state(state, gaussians)
