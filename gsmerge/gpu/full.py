"""gaussians -> fitted gaussians, on a device: the run of :mod:`gsmerge.stages.fit.full`, which says why it is as it is.

Order of the views and backgrounds are those of the CPU's run. What comes back from the device during the run are
scores at its beginning and at the change of sizes, and the error once in ``READ_EVERY`` steps.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsmerge.gpu.adam import FitState, Gradients, adam_step, state_of
from gsmerge.gpu.grow import grow_to
from gsmerge.gpu.holdout import holdout_score, initial_scores, state_colors
from gsmerge.gpu.loss import PhotoMeans, loss_gradient, photo_means
from gsmerge.gpu.raster import draw
from gsmerge.gpu.scene import DevicePhotos
from gsmerge.kernels.gaussians.optimise import COLOR, LOGIT, QUAT, SIZE
from gsmerge.stages.fit.full import (
    GROWTH,
    MAX_STEPS,
    PROBE,
    Plan,
    Progress,
    TailMean,
    affordable_steps,
    look_of,
    plan_run,
    step_sizes,
)
from gsmerge.stages.fit.options import FitOptions
from gsmerge.stages.fit.report import FitReport
from gsmerge.types import SH_C0, Gaussians

READ_EVERY = 20  # steps; each reading waits for the device
MAX_DRAWN = 0.99  # opacity of what is drawn in place of the Gaussians that a step leaves out


@dataclass(frozen=True, eq=False)
class Level:
    """The photos of one size, and what a step needs of them.

    Args:
        photos: The photos.
        means: Of their windows.
        weights: ``[v,h,w]`` of the pixels in a step; of full size ``[1,h,w]``, the same for all views.
        counts: ``[v]`` sum of each view's weights.
    """

    photos: DevicePhotos
    means: PhotoMeans
    weights: Tensor
    counts: tuple[float, ...]

    def weight(self, view: int) -> Tensor:
        """``[h,w]``."""
        return self.weights[view if len(self.weights) > 1 else 0]


@dataclass(frozen=True, eq=False)
class Schedule:
    """What is random in a run: the view of every step, and ``[s,3]`` the background on the device."""

    views: list[int]
    backgrounds: Tensor


def draw_schedule(seed: int, num_views: int, steps: int, device: torch.device) -> Schedule:
    """As many steps as may be taken, in the order in which the CPU's run draws its numbers."""
    rng = np.random.default_rng(seed)
    queue: list[int] = []
    views, backgrounds = [], np.empty((steps, 3), np.float32)
    for step in range(steps):
        queue = queue or rng.permutation(num_views).tolist()
        views.append(queue.pop())
        backgrounds[step] = rng.random(3, dtype=np.float32)
    return Schedule(views, torch.from_numpy(backgrounds).to(device))


def start_state(gaussians: Gaussians) -> FitState:
    """A fresh state at some Gaussians."""
    opacities = gaussians.opacities.double().clamp(0.004, 0.999)
    x = torch.cat(
        [
            gaussians.means,
            gaussians.scales.clamp_min(1e-9).log(),
            gaussians.quats,
            (opacities / (1 - opacities)).log().float()[:, None],
            0.5 + SH_C0 * gaussians.sh0[:, 0],
        ],
        1,
    )
    return state_of(x, gaussians.shN)


def gaussians_of(x: Tensor, shN: Tensor) -> Gaussians:
    """The Gaussians that parameters ``[n,14]`` stand for."""
    return Gaussians(
        means=x[:, :SIZE].contiguous(),
        quats=x[:, QUAT:LOGIT].contiguous(),
        scales=x[:, SIZE:QUAT].exp(),
        opacities=x[:, LOGIT].sigmoid(),
        sh0=((x[:, COLOR:] - 0.5) / SH_C0)[:, None],
        shN=shN,
    )


def make_levels(photos: tuple[DevicePhotos, DevicePhotos], plan: Plan, device: torch.device) -> tuple[Level, Level]:
    """Both sizes with their weights: everything counts at full size, the training pixels at half size."""
    full, half = photos
    everywhere = torch.ones((1, full.height, full.width), device=device)
    trained = torch.from_numpy(np.stack(plan.step_weights[1])).to(device)
    counts = tuple(float(weight.sum()) for weight in plan.step_weights[1])
    return (
        Level(full, photo_means(full.images), everywhere, (float(full.height * full.width),) * len(full)),
        Level(half, photo_means(half.images), trained, counts),
    )


def take_step(
    state: FitState,
    level: Level,
    view: int,
    background: Tensor,
    kept: Tensor | None,
    options: FitOptions,
    look: dict[str, Any],
) -> tuple[Gradients, Tensor]:
    """Gradients of one view's loss, and the sum of its weighted squared errors.

    Args:
        state: n Gaussians.
        level: The photos.
        view: Of them.
        background: ``[3]``.
        kept: ``[n]`` opacities of what is drawn; None: the state's own.
        options: Of the loss.
        look: Low-pass, and whether its energy is compensated; see :func:`gsmerge.stages.fit.full.look_of`.
    """
    photos = level.photos
    shape = (state.means, state.quats, state.scales, state.opacities if kept is None else kept)
    with torch.enable_grad():
        leaves = [tensor.detach().requires_grad_() for tensor in (*shape, state_colors(state, photos, view))]
        drawn = leaves[0], leaves[1], leaves[2], leaves[3]
        image, reached = draw(drawn, leaves[4], photos, view, background, **look)
    means = level.means.first[view], level.means.square[view]
    wanted, error = loss_gradient(image.detach(), photos.images[view], means, level.weight(view), options.ssim_lambda)
    of_means, of_quats, of_scales, of_opacities, of_colors = torch.autograd.grad(image, leaves, wanted)
    return Gradients(of_means, of_quats, of_scales, of_opacities, of_colors, reached), error


def leave_out(state: FitState, dropout: float, generator: torch.Generator) -> Tensor:
    """``[n]`` opacities with a share of the Gaussians left out, the others a little more opaque."""
    kept = torch.rand(len(state), device=state.x.device, generator=generator) >= dropout
    return kept * (state.opacities / (1 - dropout)).clamp_max(MAX_DRAWN)


def fit_full(
    gaussians: Gaussians,
    photos: tuple[DevicePhotos, DevicePhotos],
    options: FitOptions,
    count: int = 0,
    seed: int = 0,
    progress: Progress | None = None,
    baseline_start: Gaussians | None = None,
) -> tuple[Gaussians, FitReport]:
    """All parameters fitted to the photos; see :func:`gsmerge.stages.fit.full.fit_full`.

    Args:
        gaussians: Canonical Gaussians.
        photos: The input views at full and at half size.
        options: Steps, rates, limits.
        count: Number of Gaussians to grow to.
        seed: Everything random.
        progress: Called every ``READ_EVERY`` steps and at the end.
        baseline_start: Another start that the fit may beat instead.
    """
    device = gaussians.means.device
    plan = plan_run((photos[0].host, photos[1].host), options, seed)
    run = _Run(start_state(gaussians), make_levels(photos, plan, device), plan, count, seed, progress)
    judged = torch.from_numpy(np.stack(plan.weights[1])).to(device)
    half = photos[1]
    before, run.state.box_shares, run.state.min_sizes = initial_scores(run.state, photos, judged, options)
    if baseline_start is not None:
        before = min(before, holdout_score(start_state(baseline_start), half, judged, options.min_gain))
    run.score, after = before, None
    while run.step < run.steps:
        run.grow()
        if run.step / run.steps >= options.half_res_part and after is None:
            run.score = after = holdout_score(run.state, half, judged, options.min_gain)
            if after <= before:
                break
        run.take_step()
    after = holdout_score(run.state, half, judged, options.min_gain) if after is None else after
    if after <= before:
        why = f"held-out parts of the photos were no better after {run.step} steps"
        return gaussians, FitReport("none", False, run.step, before, after, why)
    if options.grows:  # a time budget may end before the growth
        run.state = grow_to(run.state, half, count)
    why = "time budget spent" if options.time_budget is not None else "all steps done"
    fitted = gaussians_of(run.tail.of(run.state.x), run.state.shN)
    return fitted, FitReport("full", True, run.step, before, after, why)


class _Run:
    """The steps of a run, and where it stands."""

    def __init__(
        self, state: FitState, levels: tuple[Level, Level], plan: Plan, count: int, seed: int, progress: Progress | None
    ):
        device, options = state.x.device, plan.options
        self.state, self.levels, self.plan, self.count, self.progress = state, levels, plan, count, progress
        self.step, self.steps, self.started, self.score = 0, options.steps, time.perf_counter(), 0.0
        self.tail, self.error = TailMean(), torch.zeros((), device=device)
        most = max(self.steps, MAX_STEPS) if options.time_budget is not None else self.steps
        self.schedule = draw_schedule(seed, len(levels[0].photos), most, device)
        self.generator = torch.Generator(device).manual_seed(seed)
        self.rates = self._all_rates()

    def _all_rates(self) -> Tensor:
        """``[steps,14]`` size of every step."""
        options = self.plan.options
        rows = [step_sizes(options.rates, step / self.steps, options.steps) for step in range(self.steps)]
        return torch.from_numpy(np.stack(rows)).to(self.state.x.device)

    def grow(self) -> None:
        """Add Gaussians, once it is time."""
        due = self.plan.options.grows and self.step / self.steps >= GROWTH
        if due and len(self.state) < self.count:
            self.state = grow_to(self.state, self.levels[1].photos, self.count)

    def take_step(self) -> None:
        """One step on one view."""
        options, dropout = self.plan.options, self.plan.dropout
        at = 1 if self.step / self.steps < options.half_res_part else 0
        level, look = self.levels[at], look_of(self.step + 1, at, self.levels[at].photos.host.eps2d)
        view = self.schedule.views[self.step]
        kept = leave_out(self.state, dropout, self.generator) if dropout > 0 else None
        gradients, error = take_step(self.state, level, view, self.schedule.backgrounds[self.step], kept, options, look)
        adam_step(self.state, gradients, options, self.rates[self.step], self.step + 1)
        mean = error / max(3 * level.counts[view], 1)
        self.error.lerp_(mean, 1 / min(self.step + 1, 10))
        self.step += 1
        if self.step > self.steps * (1 - options.average_share):
            self.tail.add(self.state.x)
        if options.time_budget is not None and self.step == PROBE:
            self.read_error()  # which waits for the device
            self.steps = affordable_steps(time.perf_counter() - self.started, self.plan)
            self.rates = self._all_rates()
        if self.progress and (self.step % READ_EVERY == 0 or self.step == self.steps):
            self.progress(self.step, self.steps, -10 * np.log10(max(self.read_error(), 1e-12)), self.score)

    def read_error(self) -> float:
        """Mean squared error of the last steps."""
        return float(self.error)
