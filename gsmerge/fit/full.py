"""Gaussians -> fitted Gaussians: a short optimisation of all parameters, confined to a box about the start.

One view per step: L1 of pixels and of their differences, and structural similarity, on a random
background, half-size photos first, Adam with rates in units of each Gaussian's own size. Longer runs
begin with fewer Gaussians than they may have and spend the rest where the error is.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.fit.fit_options import EARLIER, LONG_STEPS, FitOptions, FitReport, Tuning
from gsmerge.fit.fit_state import State, gaussians_of, grow_to, start_state
from gsmerge.fit.loss import image_gradient
from gsmerge.fit.outside import fog_gradients
from gsmerge.fit.photo_sizes import HIDDEN, holdout_psnr, reduced, training_weights
from gsmerge.fit.survey import Survey, survey_photos
from gsmerge.geometry import motion_matrices
from gsmerge.kernels.elementary import log, power
from gsmerge.kernels.gaussians import optimise as kernels
from gsmerge.kernels.gaussians.optimise import LOGIT, QUAT
from gsmerge.kernels.matrices import matmul
from gsmerge.kernels.raster.blend import MAX_ALPHA
from gsmerge.raster import plan_view
from gsmerge.raster.composite import blend, view_colors
from gsmerge.raster.gradient import Gradients, gradients_of
from gsmerge.raster.metrics import decibels
from gsmerge.raster.photos import Photos, render_photos
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Array, Gaussians

ROWS = 16384  # Gaussians per piece of an optimiser step
GROWTH = 0.5  # part of the run after which Gaussians are added
FEW_VIEWS = 5  # views up to which a run of MANY_STEPS memorises the photos, unless Gaussians are dropped
MANY_STEPS = 150
DROPOUT = 0.1  # share of the Gaussians that a step leaves out with few views
LONG_DROPOUT = 0.05  # the same in runs of LONG_STEPS that look at each view often
LONG_LOOKS = 30
LARGE_STEPS = (0, 2)  # of every five, look at larger photos; with more of them the views' own size gets worse
PROBE = 6  # steps that are timed to plan a time budget
MAX_STEPS = 2000
LONG_RUN = 300  # steps beyond which the last ones shrink in proportion
# How steps after those on half-size photos draw, in turn: whether at half size, the low-pass as a share of the
# viewers' own, and whether small Gaussians are made clearer by what it adds to them. Some viewers do that, enlarged
# twice the low-pass is a quarter, and from afar it covers more of the scene: what was fitted to one way alone looks
# thin or fat in the others (Mip-Splatting, Yu et al. 2024).
LOOKS = (
    (0, 1.0, True), (0, 1.0, False), (0, 0.25, False), (1, 1.0, False),
    (0, 1.0, False), (0, 1.0, False), (0, 0.25, False), (0, 1.0, False),
    (0, 1.0, True), (1, 1.0, False), (0, 0.25, False), (0, 1.0, False),
    (0, 1.0, False), (0, 1.0, False), (0, 0.25, False), (1, 1.0, False),
)  # fmt: skip

Progress = Callable[[int, int, float, float], None]  # step, steps, PSNR of the photos and of their held-out blocks
EPS = 1e-15  # of Adam


@dataclass(frozen=True)
class Look:
    """How a step looks at the scene."""

    size: int  # Of the photos: 0 full, 1 half, 2 larger
    eps2d: float  # Low-pass, pixels squared
    antialiased: bool = False  # Whether small Gaussians are made clearer by it


@dataclass(frozen=True)
class FitPlan:
    """Plan of a full fit: photos, weights, shares of the steps."""

    photos: tuple[Photos, ...]  # At full and at half size, and larger ones where there are any
    # [h,w] float32 of each photo at either size: 0 on held-out blocks, `HIDDEN` on pixels that
    # neither steps nor scores use, 1 elsewhere
    weights: tuple[list[np.ndarray], list[np.ndarray]]
    # The same as a step uses them: 0 on hidden pixels; at full size 1 on held-out blocks, too, and
    # larger photos count everywhere
    step_weights: tuple[list[np.ndarray], ...]
    options: FitOptions  # What a step does
    dropout: float  # Share of the Gaussians that a step leaves out
    half_part: float  # Share of the steps, the first ones, on half-size photos
    poses: PoseState | None = None  # The motions of the cameras; None where they are fixed
    fixed: np.ndarray | None = None  # [n] bool, Gaussians that stay as they are; None: none
    outside: Photos | None = None  # Views whose weights say where the start is empty; None: none

    def outside_view(self, step: int, progress: float) -> int | None:
        """Return the view from outside that is looked at after a step, from 1; None: none."""
        rates = self.options.tuning
        if self.outside is None or progress < rates.outside_from or step % rates.outside_every:
            return None
        return step // rates.outside_every % len(self.outside)

    def look_at(self, step: int, progress: float) -> Look:
        """Return how a step looks at the scene.

        Half-size photos come first. Then photos are drawn in turn in the ways of viewers; larger
        ones in between show what an enlarged view shows.
        """
        if progress < self.half_part:
            return Look(1, self.photos[1].eps2d)
        if len(self.photos) > 2 and step % 5 in LARGE_STEPS:
            return Look(2, self.photos[2].eps2d)
        size, share, antialiased = LOOKS[step % len(LOOKS)]
        # From afar costs short runs more than it gains; beside larger photos, which are for looking
        # closely, every third such look is enough
        if not self.options.grows or (len(self.photos) > 2 and step % 3):
            size = 0
        return Look(size, share * self.photos[0].eps2d, antialiased)


def plan_run(photos: tuple[Photos, ...], options: FitOptions, seed: int) -> FitPlan:
    """Plan a fit: held-out blocks, pixels outside masks, and dropout where there are few views."""
    full = training_weights(photos[0], options.holdout, seed)
    few = len(photos[0]) <= FEW_VIEWS and options.steps >= MANY_STEPS
    long = options.steps >= max(LONG_STEPS, LONG_LOOKS * len(photos[0]))
    default = DROPOUT if few else LONG_DROPOUT if long else 0.0
    dropout = default if options.dropout is None else options.dropout
    weights = full, reduced(full, photos[1])
    everywhere, *larger = (_weights_of(one) for one in (photos[0], *photos[2:]))
    trained = [np.where(weight == HIDDEN, np.float32(0), weight) for weight in weights[1]]
    if len(photos[0]) == 1:  # no other photo shows what is held out: the fit is judged by all that it sees
        weights = weights[0], [np.where(weight == 1, np.float32(0), weight) for weight in weights[1]]
    half_part = options.half_res_part
    if len(photos) > 2 and options.half_res_share is None:
        half_part -= EARLIER
    poses = None
    if options.move_cameras:
        poses, photos = start_poses(photos)
    return FitPlan(photos, weights, (everywhere, trained, *larger), options, dropout, half_part, poses)


def _weights_of(photos: Photos) -> list[np.ndarray]:
    """Return the weights ``[h,w]`` of all pixels of each photo."""
    if photos.weights is None:
        return [np.ones((photos.height, photos.width), np.float32)] * len(photos)
    return list(photos.weights)


def fit_step(state: State, plan: FitPlan, view: int, step: int, progress: float, rng: np.random.Generator) -> float:
    """Take one Adam step on one view; return the mean squared error of its training pixels."""
    look = plan.look_at(step, progress)
    photos = plan.photos[look.size]
    weight = plan.step_weights[look.size][view]
    background, opacities = rng.random(3, dtype=np.float32), None
    if plan.dropout > 0:
        kept = rng.random(len(state.x), dtype=np.float32) >= plan.dropout
        opacities = kept * np.minimum(state.splats.opacities / np.float32(1 - plan.dropout), MAX_ALPHA)
    camera = photos.camera(view) | {"eps2d": look.eps2d, "antialiased": look.antialiased}
    drawn = plan_view(state.splats, **camera, opacities=opacities)
    all_colors = state.view_colors()
    colors = view_colors(drawn) if all_colors is None else all_colors.take(drawn.ids, 0)
    image, transmittance = blend(drawn, colors, background)
    rates = plan.options.tuning
    gradient, error = image_gradient(image, photos.image(view), weight, *loss_weights(rates, progress))
    g = gradients_of(drawn, colors, image, transmittance, gradient, None, with_viewmat=plan.poses is not None)
    if plan.poses is not None and g.viewmat is not None:  # that harmonics change with the camera is left out
        plan.poses.step(view, g.viewmat, rates, progress)
    if plan.fixed is not None:
        g = g[~plan.fixed[g.ids]]
    move(state, plan, g, step, progress)
    return error / max(3 * float(weight.sum()), 1)


def clear_fog(state: State, plan: FitPlan, view: int, step: int, progress: float) -> None:
    """Take one Adam step against what shows in a view from outside where the start shows nothing."""
    assert plan.outside is not None
    g = fog_gradients(state.splats, plan.outside, view)
    move(state, plan, g if plan.fixed is None else g[~plan.fixed[g.ids]], step, progress)


def move(state: State, plan: FitPlan, g: Gradients, step: int, progress: float) -> None:
    """Take one Adam step along gradients."""
    s, rates, count = state.splats, plan.options.tuning, max(len(state.x), 1)
    steps = step_sizes(rates, progress, plan.options.steps)
    limits = np.array([rates.max_mean_shift, rates.max_scale_change, rates.max_opacity_change], np.float32)
    betas = np.array([rates.beta1, rates.beta2], np.float32)
    regs = np.array([rates.opacity_reg / count, rates.scale_reg / count], np.float32)

    def update(first: int) -> None:
        last = min(first + ROWS, len(g.ids))
        kernels.adam(
            state.x, state.x0, state.m, state.v, state.units, state.box_shares, state.min_sizes, g.ids,
            g.means, g.quats, g.scales, g.opacities, g.colors, steps, limits, betas, regs, step,
            first, last, s.means, s.quats, s.scales, s.opacities, state.colors,
        )  # fmt: skip

    parallel_map(update, range(0, len(g.ids), ROWS))


def loss_weights(rates: Tuning, progress: float) -> tuple[float, float]:
    """Return the weights of structural similarity and of edges in the loss of a step."""
    return rates.ssim_lambda, rates.edge_weight * progress


def step_sizes(rates: Tuning, progress: float, steps: int) -> np.ndarray:
    """Return the step of each of the fourteen columns, decaying geometrically, and farther in longer runs."""
    decay = rates.decay * min(1.0, LONG_RUN / steps)
    each = [rates.means_lr, rates.scales_lr, rates.quats_lr, rates.opacities_lr, rates.colors_lr]
    return (np.repeat(each, [3, 3, 4, 1, 3]) * power(decay, progress)).astype(np.float32)


def initial_scores(look: Survey, plan: FitPlan) -> tuple[float, np.ndarray, np.ndarray]:
    """Score the start: PSNR (dB) of the held-out half-size blocks, ``[n]`` box shares, ``[n]`` least log scales.

    The share of its box that a Gaussian may use is ``single_view_share`` to 1, by how many photos
    show it: the effective number of them, (sum w)^2 / sum w^2 of its blending weights w in them.
    Its least scale is ``min_scale`` pixels of the largest photo that it is nearest to (the 3D
    filter of Mip-Splatting); none where no photo shows it.
    """
    rates = plan.options.tuning
    photos_each = look.sums**2 / np.maximum(look.squares, 1e-12)
    box_shares = np.clip(photos_each - 1, rates.single_view_share, 1).astype(np.float32)
    pixels = np.where(np.isfinite(look.pixels), look.pixels, 0)
    min_sizes = log(rates.min_scale * pixels).astype(np.float32)
    return holdout_psnr(look.images, plan.photos[1], plan.weights[1], rates.min_gain), box_shares, min_sizes


def holdout_score(state: State, plan: FitPlan) -> float:
    """Return the PSNR (dB) of the half-size held-out blocks."""
    images = render_photos(state.splats, plan.photos[1], colors=state.view_colors())
    return holdout_psnr(images, plan.photos[1], plan.weights[1], plan.options.tuning.min_gain)


def judge(
    state: State, own: float, baseline_start: Gaussians | None, photos: tuple[Photos, ...], plan: FitPlan
) -> tuple[float, float]:
    """Return the PSNR (dB) of the held-out blocks that a fit has to beat, and its own.

    To beat are ``own``, of its start, or a worse baseline: networks learn to show whole photos, and a
    fit to the other blocks then makes the held-out ones worse and new views better. The baseline is
    looked at only where the fit does not beat its start, with the cameras of ``photos``.
    """
    after = holdout_score(state, plan)
    if baseline_start is None or after > own:
        return own, after
    return min(own, holdout_score(start_state(baseline_start), replace(plan, photos=photos))), after


@dataclass
class TailMean:
    """Mean of parameters ``[n,14]``, an array or a tensor, over the last steps, which are noisy one by one."""

    total: Array = None
    count: int = 0

    def add(self, x: Array) -> None:
        """Add one more step; the first one after Gaussians were added starts anew."""
        if self.total is None or len(self.total) != len(x):
            self.total, self.count = 0 * x, 0
        self.count += 1
        self.total += x

    def of(self, x: Array) -> Array:
        """Return the mean with unit quaternions; ``x`` itself without a step of as many Gaussians."""
        if self.total is None or len(self.total) != len(x):
            return x
        mean = self.total / self.count
        quats = mean[:, QUAT:LOGIT]
        quats /= (quats * quats).sum(1)[:, None] ** 0.5
        return mean


def fit_full(
    gaussians: Gaussians,
    photos: tuple[Photos, ...],
    options: FitOptions,
    count: int = 0,
    seed: int = 0,
    progress: Progress | None = None,
    baseline_start: Gaussians | None = None,
    look: Survey | None = None,
    fixed: np.ndarray | None = None,
    outside: Photos | None = None,
) -> tuple[Gaussians, FitReport]:
    """Fit all parameters to the photos.

    Two states can be returned, judged by blocks of the photos that the half-size steps leave out:
    the start, or the end if the blocks were better after those steps. The full-size steps then use
    every block.

    ``photos`` come at full and at half size, and larger if the fit is to see them. ``count``:
    number of Gaussians to grow to, where the run is long enough. ``baseline_start``: another start that the fit
    may beat instead, see :func:`judge`. ``look``: a survey of the Gaussians, where there is
    one already. ``fixed [n]``: Gaussians that stay as they are. ``outside``: views in which some
    steps look for fog, see :func:`gsmerge.fit.outside.outside_views`. ``progress`` is
    called after every step.
    """
    rng, state, plan = np.random.default_rng(seed), start_state(gaussians), plan_run(photos, options, seed)
    plan = replace(plan, fixed=fixed, outside=outside)
    tail = TailMean()
    look = survey_photos(gaussians, photos) if look is None else look
    own, state.box_shares[:], state.min_sizes[:] = initial_scores(look, plan)
    before = after = own
    queue: list[int] = []
    grows, step, steps, error, judged = options.grows, 0, options.steps, 0.0, not options.judged
    started = time.perf_counter()
    while step < steps:
        part = step / steps
        if part >= plan.half_part and not judged:  # before growth: halves that were never fitted show less
            (before, after), judged = judge(state, own, baseline_start, photos, plan), True
            if after <= before:
                break
        if grows and part >= GROWTH and len(state.x) < count:
            state = grow_to(state, plan.photos[1], count)
        if not queue:
            queue = rng.permutation(len(photos[0])).tolist()
        error += (fit_step(state, plan, queue.pop(), step + 1, part, rng) - error) / min(step + 1, 10)
        step += 1
        outside_view = plan.outside_view(step, part)
        if outside_view is not None:
            clear_fog(state, plan, outside_view, step, part)
        if step > steps * (1 - options.tuning.average_share):
            tail.add(state.x)
        if options.time_budget is not None and step == PROBE:
            steps = affordable_steps(time.perf_counter() - started, plan)
        if progress:
            progress(step, steps, decibels(error), after)
    if not judged:
        before, after = judge(state, own, baseline_start, photos, plan)
    if options.judged and after <= before:
        why = f"held-out parts of the photos were no better after {step} steps"
        return gaussians, FitReport("none", False, step, before, after, why, origins=np.arange(len(gaussians)))
    if grows and len(state.x) < count:  # a time budget may end before the growth
        state = grow_to(state, plan.photos[1], count)
    why = "time budget spent" if options.time_budget is not None else "all steps done"
    viewmats = None if plan.poses is None else plan.poses.viewmats
    fitted = gaussians_of(tail.of(state.x), state.splats.shN)
    return fitted, FitReport("full", True, step, before, after, why, viewmats, origins=state.origins)


def affordable_steps(seconds: float, plan: FitPlan) -> int:
    """Return the steps that fit into the time budget, from the time of the first PROBE steps at half size.

    A step at full size costs up to three times as much, one on larger photos more by their pixels.
    """
    budget, coarse = plan.options.time_budget, plan.half_part
    assert budget is not None
    pixels = [photos.height * photos.width for photos in plan.photos]
    mean_step = seconds / PROBE * (coarse + 3 * (1 - coarse) * (1 + max(pixels) / pixels[0]) / 2)
    return int(np.clip((budget - seconds) / mean_step + PROBE, PROBE + 1, MAX_STEPS))


@dataclass(eq=False)
class PoseState:
    """Motions of the views under optimisation; their mean stays zero, so that the scene stays where it is."""

    start: np.ndarray  # [v,4,4] viewmats before the fit
    viewmats: np.ndarray  # [v,4,4] float64, updated by steps, shared with all photos
    # [v,6] motion of each, see gsmerge.geometry.motion_vectors: about the scene's middle, where
    # turns and shifts of a camera show differently
    x: np.ndarray
    m: np.ndarray  # First moment
    v: np.ndarray  # Second moment
    counts: np.ndarray  # [v] steps of each
    pixel: float  # Angle of a pixel, radians; also its size at the scene's depth

    def step(self, view: int, gradient: np.ndarray, rates: Tuning, progress: float) -> None:
        """Take one Adam step of a view by the gradient ``[4,4]`` of its viewmat; steps fall to zero at the end."""
        turns = matmul(self.viewmats[view, :3, :3].T, gradient[:3])
        (_, ab, ac), (ba, _, bc), (ca, cb, _) = turns[:, :3]
        slope = np.array([cb - bc, ac - ca, ba - ab, *turns[:, 3]])
        self.counts[view] += 1
        for moment, beta, value in ((self.m, rates.beta1, slope), (self.v, rates.beta2, slope**2)):
            moment[view] += (1 - beta) * (value - moment[view])
        first_left, second_left = power([rates.beta1, rates.beta2], self.counts[view])
        first, second = self.m[view] / (1 - first_left), self.v[view] / (1 - second_left)
        self.x[view] -= rates.poses_lr * self.pixel * (1 - progress) * first / (np.sqrt(second) + EPS)
        self.x -= self.x.mean(0)
        self.viewmats[:] = matmul(self.start, motion_matrices(self.x))


def start_poses(photos: tuple[Photos, ...]) -> tuple[PoseState, tuple[Photos, ...]]:
    """Return zero motions at the poses of some photos, and the photos with viewmats shared with them."""
    start = photos[0].viewmats.astype(np.float64)
    zero, shared = np.zeros((len(start), 6)), start.copy()
    pixel = 1 / float(photos[0].Ks[:, [0, 1], [0, 1]].mean())
    state = PoseState(start, shared, zero, zero.copy(), zero.copy(), np.zeros(len(start), np.int64), pixel)
    return state, tuple(replace(some, viewmats=shared) for some in photos)
