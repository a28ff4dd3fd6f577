"""Gaussians -> fitted Gaussians, on a device; :mod:`gsmerge.fit.full` explains the method.

Order of the views and backgrounds are those of the CPU's run. What comes back from the device
during the run are scores at its beginning and at the change of sizes, and the error once in
``READ_EVERY`` steps.
"""

from __future__ import annotations

import math
import time
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from gsmerge.fit.fit_options import FitOptions, FitReport
from gsmerge.fit.fit_state import DEPTH, FADED, OFFSET
from gsmerge.fit.full import (
    GROWTH,
    MAX_STEPS,
    PROBE,
    FitPlan,
    Look,
    Progress,
    TailMean,
    affordable_steps,
    loss_weights,
    plan_run,
    step_sizes,
)
from gsmerge.fit.gpu.adam import FitState, StepGradients, adam_step, gaussians_of, start_state, state_of
from gsmerge.fit.gpu.device_photos import (
    DevicePhotos,
    draw,
    draw_and_transpose,
    draw_black,
    harmonic_colors,
    upload_photos,
)
from gsmerge.fit.gpu.image_scores import holdout_psnr, loss_gradient, photo_means
from gsmerge.fit.outside import TOUCHED
from gsmerge.kernels.gaussians.optimise import LOGIT, QUAT, SIZE
from gsmerge.kernels.raster.blend import MAX_ALPHA
from gsmerge.networks.tensors import quat_to_rotmat
from gsmerge.raster.autograd import Shape
from gsmerge.raster.photos import Photos
from gsmerge.types import SH_C0, Gaussians

READ_EVERY = 20  # steps; each reading waits for the device


@dataclass(frozen=True, eq=False)
class PhotoLevel:
    """Photos of one size, with weights and window means for the steps."""

    photos: DevicePhotos
    means: Tensor  # [v,2,3,h,w] window means, see gsmerge.fit.gpu.image_scores.photo_means
    weights: Tensor  # [v,h,w] weights of pixels in a step, or [1,h,w] for all views
    counts: tuple[float, ...]  # [v] sum of each view's weights

    def weight(self, view: int) -> Tensor:
        """Return the weights ``[h,w]`` of a view."""
        return self.weights[view if len(self.weights) > 1 else 0]


def make_levels(photos: tuple[DevicePhotos, DevicePhotos], plan: FitPlan) -> tuple[PhotoLevel, PhotoLevel]:
    """Weigh the photos of both sizes: all pixels at full size, the training pixels at half size."""
    full, half = photos
    everywhere = torch.ones((1, full.height, full.width), device=full.images.device)
    whole = (float(full.height * full.width),) * len(full)
    if full.host.weights is not None:
        everywhere = torch.from_numpy(np.stack(plan.step_weights[0])).to(full.images.device)
        whole = tuple(float(weight.sum()) for weight in plan.step_weights[0])
    trained = torch.from_numpy(np.stack(plan.step_weights[1])).to(half.images.device)
    counts = tuple(float(weight.sum()) for weight in plan.step_weights[1])
    return (
        PhotoLevel(full, photo_means(full.images), everywhere, whole),
        PhotoLevel(half, photo_means(half.images), trained, counts),
    )


def draw_order(seed: int, num_views: int, steps: int) -> tuple[list[int], np.ndarray]:
    """Draw the view and ``[steps,3]`` the background of every step, as the CPU's run draws its numbers."""
    rng = np.random.default_rng(seed)
    queue: list[int] = []
    views, backgrounds = [], np.empty((steps, 3), np.float32)
    for step in range(steps):
        queue = queue or rng.permutation(num_views).tolist()
        views.append(queue.pop())
        backgrounds[step] = rng.random(3, dtype=np.float32)
    return views, backgrounds


def state_shape(state: FitState) -> Shape:
    """Return what the rasterizer takes of a state."""
    return state.means, state.quats, state.scales, state.opacities


def state_colors(state: FitState, photos: DevicePhotos, view: int) -> Tensor:
    """Return the colours ``[n,3]`` of a state in a view: its own, or through the harmonics."""
    if state.shN.shape[1] == 0:
        return state.colors
    return harmonic_colors(state.means, ((state.colors - 0.5) / SH_C0)[:, None], state.shN, photos, view)


def holdout_score(state: FitState, photos: DevicePhotos, weights: Tensor, min_gain: float) -> float:
    """Return the PSNR (dB) of a state on the held-out blocks of photos."""
    views, shape = range(len(photos)), state_shape(state)
    images = [draw_black(shape, state_colors(state, photos, view), photos, view) for view in views]
    return holdout_psnr(torch.stack(images), photos.images, weights, min_gain)


def initial_scores(
    state: FitState, photos: tuple[DevicePhotos, DevicePhotos], weights: Tensor, options: FitOptions
) -> tuple[float, Tensor, Tensor]:
    """Score the start as :func:`gsmerge.fit.full.initial_scores` does."""
    full, half = photos
    images, shape, rates = [], state_shape(state), options.tuning
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
    return holdout_psnr(torch.stack(images), half.images, weights, options.tuning.min_gain), shares, min_sizes


def error_masses(state: FitState, photos: DevicePhotos) -> Tensor:
    """Sum ``[n]`` every Gaussian's blending weight times the absolute error over all pixels."""
    masses = torch.zeros(len(state), dtype=torch.float64, device=state.x.device)
    for view in range(len(photos)):
        image, transpose = draw_and_transpose(state_shape(state), state_colors(state, photos, view), photos, view)
        error = (image - photos.images[view]).abs().mean(-1, keepdim=True)
        masses += transpose(error.expand_as(image))[:, 0]
    return masses


def grow_to(state: FitState, photos: DevicePhotos, count: int) -> FitState:
    """Leave out what has faded and halve others, see :func:`gsmerge.fit.fit_state.grow_to`."""
    before = 0
    if len(state):
        state = state[state.opacities >= state.opacities.median().clamp_max(FADED)]
    while before < len(state) < count:
        before, state = len(state), grow(state, photos, count)
    return state


def grow(state: FitState, photos: DevicePhotos, count: int) -> FitState:
    """Halve the Gaussians with the largest error masses, see :func:`gsmerge.fit.fit_state.grow`."""
    masses = error_masses(state, photos)
    num = min(count - len(state), int((masses > 0).sum()))
    if num <= 0:
        return state
    picked = torch.sort(-masses, stable=True).indices[:num].sort().values
    parents, rows = state.x[picked], torch.arange(num, device=picked.device)
    longest = parents[:, SIZE:QUAT].argmax(1)
    reach = OFFSET * parents[rows, SIZE + longest].exp()
    shift = quat_to_rotmat(parents[:, QUAT:LOGIT])[rows, :, longest] * reach[:, None]
    halves = parents.clone()
    halves[rows, SIZE + longest] += 0.5 * math.log(1 - OFFSET**2)
    clear = (-halves[:, LOGIT].double()).sigmoid()  # 1 - opacity
    halves[:, LOGIT] = (1 / clear**DEPTH - 1).log().float()
    x = torch.cat([state.x, halves])
    x[picked] = halves
    x[picked, :3] -= shift
    x[len(state) :, :3] += shift
    source = torch.cat([torch.arange(len(state), device=picked.device), picked])
    grown = state_of(x, state.shN[source])
    old = torch.ones(len(state), dtype=torch.bool, device=picked.device)
    old[picked] = False
    rows = torch.nonzero(old)[:, 0]
    grown.x0[rows], grown.units[rows] = state.x0[rows], state.units[rows]
    for name in ("m", "v", "box_shares", "min_sizes", "origins"):
        setattr(grown, name, getattr(state, name)[source])
    return grown


def step_gradients(
    state: FitState,
    level: PhotoLevel,
    view: int,
    background: Tensor,
    kept: Tensor | None,
    look: Look,
    weights: tuple[float, float],
) -> tuple[StepGradients, Tensor]:
    """Differentiate one view's loss, and sum its weighted squared errors.

    ``kept [n]``: opacities of what is drawn, None: the state's own. ``weights``: see
    :func:`gsmerge.fit.full.loss_weights`.
    """
    photos = level.photos
    shape = (state.means, state.quats, state.scales, state.opacities if kept is None else kept)
    with torch.enable_grad():
        leaves = [tensor.detach().requires_grad_() for tensor in (*shape, state_colors(state, photos, view))]
        drawn = leaves[0], leaves[1], leaves[2], leaves[3]
        image, reached = draw(
            drawn, leaves[4], photos, view, background, eps2d=look.eps2d, antialiased=look.antialiased
        )
    wanted, error = loss_gradient(image.detach(), photos.images[view], level.means[view], level.weight(view), *weights)
    of_means, of_quats, of_scales, of_opacities, of_colors = torch.autograd.grad(image, leaves, wanted)
    return StepGradients(of_means, of_quats, of_scales, of_opacities, of_colors, reached), error


def fog_gradients(state: FitState, outside: DevicePhotos, weights: Tensor, view: int) -> StepGradients:
    """Differentiate the fog of a view outside, see :func:`gsmerge.fit.outside.fog_gradients`."""
    with torch.enable_grad():
        means, quats, scales, opacities = (tensor.detach().requires_grad_() for tensor in state_shape(state))
        white = torch.ones_like(state.colors)
        image = draw_black((means, quats, scales, opacities), white, outside, view)  # the opacity, three times
    wanted = (weights[view] / (3 * weights[view].numel()))[..., None].expand_as(image)
    of_means, of_quats, of_scales, of_opacities = torch.autograd.grad(
        image, (means, quats, scales, opacities), wanted.contiguous()
    )
    touched = of_opacities.abs() > TOUCHED
    return StepGradients(of_means, of_quats, of_scales, of_opacities, torch.zeros_like(white), touched)


def leave_out(state: FitState, dropout: float, generator: torch.Generator) -> Tensor:
    """Return opacities ``[n]`` with a share of the Gaussians left out, the others a little more opaque."""
    kept = torch.rand(len(state), device=state.x.device, generator=generator) >= dropout
    return kept * (state.opacities / (1 - dropout)).clamp_max(float(MAX_ALPHA))


def fit_full(
    gaussians: Gaussians,
    photos: tuple[DevicePhotos, DevicePhotos],
    options: FitOptions,
    count: int,
    seed: int,
    progress: Progress | None,
    baseline_start: Gaussians | None,
    look: None = None,  # what the CPU's fit takes over from the look before
    fixed: None = None,  # Gaussians that stay as they are, which only the CPU can do
    outside: Photos | None = None,
) -> tuple[Gaussians, FitReport]:
    """Fit as :func:`gsmerge.fit.full.fit_full` does; report progress every ``READ_EVERY`` steps."""
    plan = replace(plan_run((photos[0].host, photos[1].host), options, seed), outside=outside)
    run = _Run(start_state(gaussians), make_levels(photos, plan), plan, seed, progress)
    judged = torch.from_numpy(np.stack(plan.weights[1])).to(gaussians.means.device)
    half = photos[1]
    own, run.state.box_shares, run.state.min_sizes = initial_scores(run.state, photos, judged, options)

    def judge() -> tuple[float, float]:
        score = partial(holdout_score, photos=half, weights=judged, min_gain=options.tuning.min_gain)
        after = score(run.state)
        if baseline_start is None or after > own:
            return own, after
        return min(own, score(start_state(baseline_start))), after

    run.score, before, after = own, own, None
    run.start_clock()
    while run.step < run.steps:
        if run.step / run.steps >= plan.half_part and after is None:
            before, after = judge()
            run.score = after
            if after <= before:
                break
        due = options.grows and run.step / run.steps >= GROWTH
        if due and len(run.state) < count:
            run.state = grow_to(run.state, half, count)
        run.take_step()
    if after is None:
        before, after = judge()
    if after <= before:
        why = f"held-out parts of the photos were no better after {run.step} steps"
        rows = np.arange(len(gaussians))
        return gaussians, FitReport("none", False, run.step, before, after, why, origins=rows)
    if options.grows and len(run.state) < count:  # a time budget may end before the growth
        run.state = grow_to(run.state, half, count)
    why = "time budget spent" if options.time_budget is not None else "all steps done"
    fitted = gaussians_of(run.tail.of(run.state.x), run.state.shN)
    rows = run.state.origins.cpu().numpy()
    return fitted, FitReport("full", True, run.step, before, after, why, origins=rows)


class _Run:
    """State of a run and its steps."""

    def __init__(
        self,
        state: FitState,
        levels: tuple[PhotoLevel, PhotoLevel],
        plan: FitPlan,
        seed: int,
        progress: Progress | None,
    ):
        device, options = state.x.device, plan.options
        self.state, self.levels, self.plan, self.progress = state, levels, plan, progress
        self.step, self.steps, self.started, self.score = 0, options.steps, 0.0, 0.0
        self.tail, self.error = TailMean(), torch.zeros((), device=device)
        most = max(self.steps, MAX_STEPS) if options.time_budget is not None else self.steps
        self.views, backgrounds = draw_order(seed, len(levels[0].photos), most)
        self.backgrounds = torch.from_numpy(backgrounds).to(device)
        self.generator = torch.Generator(device).manual_seed(seed)
        self.rates = self._all_rates()
        if plan.outside is not None:
            self.outside = upload_photos(plan.outside, device)
            self.empty = torch.as_tensor(plan.outside.weights, device=device)

    def _all_rates(self) -> Tensor:
        """Return the sizes ``[steps,14]`` of all steps."""
        options = self.plan.options
        rows = [step_sizes(options.tuning, step / self.steps, options.steps) for step in range(self.steps)]
        return torch.from_numpy(np.stack(rows)).to(self.state.x.device)

    def start_clock(self) -> None:
        """Start the clock of a time budget, after a step on a copy: loading kernels is not timed."""
        if self.plan.options.time_budget is not None:
            self._move(deepcopy(self.state), None)
            float(self.error)  # waits for the device
            self.started = time.perf_counter()

    def _move(self, state: FitState, kept: Tensor | None) -> Tensor:
        """Move a state by the present step, and return the mean squared error of the view before it."""
        progress, options = self.step / self.steps, self.plan.options
        look = self.plan.look_at(self.step + 1, progress)
        level, view = self.levels[look.size], self.views[self.step]
        background, weights = self.backgrounds[self.step], loss_weights(options.tuning, progress)
        gradients, error = step_gradients(state, level, view, background, kept, look, weights)
        adam_step(state, gradients, options, self.rates[self.step], self.step + 1)
        return error / max(3 * level.counts[view], 1)

    def take_step(self) -> None:
        """Take one step on one view."""
        options, dropout = self.plan.options, self.plan.dropout
        mean = self._move(self.state, leave_out(self.state, dropout, self.generator) if dropout > 0 else None)
        self.error.lerp_(mean, 1 / min(self.step + 1, 10))
        outside_view = self.plan.outside_view(self.step + 1, self.step / self.steps)
        if outside_view is not None:
            gradients = fog_gradients(self.state, self.outside, self.empty, outside_view)
            adam_step(self.state, gradients, options, self.rates[self.step], self.step + 1)
        self.step += 1
        if self.step > self.steps * (1 - options.tuning.average_share):
            self.tail.add(self.state.x)
        if options.time_budget is not None and self.step == PROBE:
            float(self.error)  # waits for the device
            self.steps = affordable_steps(time.perf_counter() - self.started, self.plan)
            self.rates = self._all_rates()
        if self.progress and (self.step % READ_EVERY == 0 or self.step == self.steps):
            self.progress(self.step, self.steps, -10 * np.log10(max(float(self.error), 1e-12)), self.score)
