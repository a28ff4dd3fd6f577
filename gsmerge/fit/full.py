"""gaussians -> fitted gaussians: all parameters moved onto the input photos by a short, confined optimisation.

One view per step: L1 and structural similarity on a random background, half-size photos first, Adam with rates in
units of each Gaussian's own size, a box about the start. The number of Gaussians never changes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from gsmerge.fit.holdout import holdout_psnr, reduced, training_weights
from gsmerge.fit.loss import image_gradient
from gsmerge.fit.options import FitOptions, Rates
from gsmerge.fit.report import FitReport
from gsmerge.kernels import optimise as kernels
from gsmerge.photos import Photos
from gsmerge.render import Splats, composite, plan_view
from gsmerge.render.gradient import plan_differentiable, plan_gradients
from gsmerge.threads import parallel_map
from gsmerge.types import SH_C0, Gaussians

ROWS = 16384  # Gaussians per piece of an optimiser step
CHECK = 60  # steps between two looks at the held-out blocks
FEW_VIEWS, MANY_STEPS, DROPOUT = 5, 100, 0.2
PROBE = 6  # steps that are timed to spend a time budget
MAX_STEPS = 2000

Progress = Callable[[int, int, float, float], None]  # step, steps, PSNR of the photos and of their held-out blocks


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
    sizes = np.sort(x[:, kernels.SIZE : kernels.QUAT], 1)
    splats = Splats(
        means=np.ascontiguousarray(x[:, :3]),
        quats=np.ascontiguousarray(x[:, kernels.QUAT : kernels.LOGIT]),
        scales=np.exp(x[:, kernels.SIZE : kernels.QUAT]),
        opacities=(1 / (1 + np.exp(-x[:, kernels.LOGIT]))).astype(np.float32),
        sh0=gaussians.sh0.numpy().copy(),
        shN=gaussians.shN.numpy(),
        origin=np.zeros(3),
    )
    units, colors = np.exp((sizes[:, 1] + sizes[:, 2]) / 2), np.ascontiguousarray(x[:, kernels.COLOR :])
    return State(x, x.copy(), np.zeros_like(x), np.zeros_like(x), units, splats, colors)


def view_colors(state: State) -> np.ndarray | None:
    """Colours as the rasterizer takes them: as they are, or None: from the harmonics, which are brought up to date."""
    if state.splats.shN.shape[1] == 0:
        return state.colors
    np.divide(state.colors[:, None] - np.float32(0.5), np.float32(SH_C0), out=state.splats.sh0)
    return None


def end_state(x: np.ndarray, shN: torch.Tensor) -> Gaussians:
    """Gaussians of parameters ``[n,14]``; the higher harmonics stay as they were."""
    tensor = torch.from_numpy
    return Gaussians(
        means=tensor(x[:, :3].copy()),
        quats=tensor(x[:, kernels.QUAT : kernels.LOGIT].copy()),
        scales=tensor(np.exp(x[:, kernels.SIZE : kernels.QUAT])),
        opacities=tensor(1 / (1 + np.exp(-x[:, kernels.LOGIT]))),
        sh0=tensor((x[:, kernels.COLOR :] - 0.5) / SH_C0).float()[:, None],
        shN=shN,
    )


@dataclass(frozen=True)
class Plan:
    """How a run goes: photos at full and half size with their training weights, steps, and what a step does."""

    photos: tuple[Photos, Photos]
    weights: tuple[list[np.ndarray], list[np.ndarray]]
    options: FitOptions
    dropout: float


def plan_run(photos: tuple[Photos, Photos], options: FitOptions, seed: int) -> Plan:
    """Held-out blocks, and dropout where there are few views."""
    full = training_weights(photos[0], options.holdout, seed)
    few = len(photos[0]) <= FEW_VIEWS and options.fit_steps >= MANY_STEPS
    dropout = options.dropout if options.dropout is not None else DROPOUT if few else 0.0
    return Plan(photos, (full, reduced(full, photos[1])), options, dropout)


def fit_step(state: State, plan: Plan, view: int, step: int, progress: float, rng: np.random.Generator) -> float:
    """One Adam step on one view -> mean squared error of its training pixels."""
    level = 1 if progress < plan.options.coarse else 0
    photos = plan.photos[level]
    weight = plan.weights[level][view] if level == 1 else np.ones_like(plan.weights[level][view])
    background, opacities = rng.random(3, dtype=np.float32), None
    if plan.dropout > 0:
        kept = rng.random(len(state.x), dtype=np.float32) >= plan.dropout
        opacities = kept * np.minimum(state.splats.opacities / np.float32(1 - plan.dropout), np.float32(0.99))
    drawn = plan_differentiable(
        state.splats, photos.viewmats[view], photos.Ks[view], photos.width, photos.height,
        eps2d=photos.eps2d, opacities=opacities,
    )  # fmt: skip
    colors = view_colors(state)
    image, transmittance = composite(drawn, colors, background)
    gradient = image_gradient(image, photos.images[view], weight, plan.options.dssim)
    g = plan_gradients(drawn, gradient, image=image, transmittance=transmittance, colors=colors)
    rates, s = plan.options.rates, state.splats
    steps = step_sizes(rates, progress)
    limits = np.array([rates.reach_mean, rates.reach_size, rates.reach_logit], np.float32)
    betas = np.array(rates.betas, np.float32)

    def update(first: int) -> None:
        last = min(first + ROWS, len(state.x))
        kernels.adam(
            state.x, state.x0, state.m, state.v, state.units, g.ids,
            g.means, g.quats, g.scales, g.opacities, g.colors, steps, limits, betas, step,
            first, last, s.means, s.quats, s.scales, s.opacities, state.colors,
        )  # fmt: skip

    parallel_map(update, range(0, len(state.x), ROWS))
    error = weight[..., None] * (image - photos.images[view]) ** 2
    return float(error.sum(dtype=np.float64) / max(3 * weight.sum(), 1))


def step_sizes(rates: Rates, progress: float) -> np.ndarray:
    """Step of each of the fourteen columns at a point of the run, decaying geometrically."""
    columns = [rates.mean] * 3 + [rates.size] * 3 + [rates.quat] * 4 + [rates.logit] + [rates.color] * 3
    return (np.array(columns) * rates.decay**progress).astype(np.float32)


def holdout_score(state: State, plan: Plan) -> float:
    """PSNR (dB) of the half-size held-out blocks."""
    photos, colors = plan.photos[1], view_colors(state)

    def one_view(view: int) -> np.ndarray:
        drawn = plan_view(
            state.splats, photos.viewmats[view], photos.Ks[view], photos.width, photos.height, eps2d=photos.eps2d
        )
        return composite(drawn, colors)[0]

    return holdout_psnr(parallel_map(one_view, range(len(photos))), photos, plan.weights[1])


def fit_full(
    gaussians: Gaussians,
    photos: tuple[Photos, Photos],
    options: FitOptions,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Gaussians, FitReport]:
    """All parameters fitted to the photos.

    The best state by the held-out blocks is returned, the start included.

    Args:
        gaussians: n canonical Gaussians; the result has as many, in the same order.
        photos: The input views at full and at half size.
        options: Steps, rates, limits.
        seed: Order of the views, backgrounds, dropout, held-out blocks.
        progress: Told after every step.
    """
    rng, state, plan = np.random.default_rng(seed), start_state(gaussians), plan_run(photos, options, seed)
    before = best = score = holdout_score(state, plan)
    kept, kept_at = state.x.copy(), 0
    queue: list[int] = []
    step, steps, started, error = 0, options.fit_steps, time.perf_counter(), 0.0
    while step < steps:
        if not queue:
            queue = rng.permutation(len(photos[0])).tolist()
        error += 0.1 * (fit_step(state, plan, queue.pop(), step + 1, step / steps, rng) - error)
        step += 1
        if options.time_budget is not None and step == PROBE:
            steps = affordable_steps(time.perf_counter() - started, plan)
        if step % CHECK == 0 or step == steps:
            score = holdout_score(state, plan)
            if score > best:
                best, kept, kept_at = score, state.x.copy(), step
        if progress:
            progress(step, steps, -10 * np.log10(max(error, 1e-12)), score)
    accepted = kept_at > 0
    stopped = "all steps done" if kept_at == steps else f"held-out blocks were best after step {kept_at} of {steps}"
    report = FitReport("full" if accepted else "none", accepted, kept_at, before, best, stopped)
    return (end_state(kept, gaussians.shN) if accepted else gaussians), report


def affordable_steps(seconds: float, plan: Plan) -> int:
    """Steps that fit into the time budget, from the time of the first PROBE ones at half size.

    A step at full size costs up to three times as much.
    """
    budget, coarse = plan.options.time_budget, plan.options.coarse
    assert budget is not None
    mean_step = seconds / PROBE * (coarse + 3 * (1 - coarse))
    return int(np.clip((budget - seconds) / mean_step + PROBE, PROBE + 1, MAX_STEPS))
