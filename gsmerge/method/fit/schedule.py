"""Plan each step of a full fit: its view, background, Gaussians, draw mode and rates."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gsmerge.frozen import dataclass
from gsmerge.method.fit.edges import Edges
from gsmerge.method.fit.outside import Outside
from gsmerge.method.fit.photo_sizes import HIDDEN_WEIGHT, reduced, training_weights
from gsmerge.method.kernels.elementary import power
from gsmerge.method.raster.photos import WHOLE_PHOTO, Photos, Sample
from gsmerge.settings.fit import LONG_STEPS, SAMPLED_STEPS, FitOptions, Tuning
from gsmerge.types import Region

GROWTH = 0.5  # share of the steps after which Gaussians are added
# Shares of the steps after which Gaussians are cut at the edges of the views. The first cuts come early, so that the
# Gaussians are fitted without their parts beyond the edges. Gaussians become larger again after a cut, so the last cut
# comes shortly before the steps over which parameters are averaged
CUTS = (0.0, 0.15, 0.3, 0.5, 0.7)
CLEARS = (0.6, 0.7, 0.8)  # shares of the steps after which a run that grows drops its faint Gaussians
SCORED = 0.7  # largest share of the steps after which held-out patches are scored; later samples draw them, too
FEW_VIEWS = 5  # with no more views, a run of MANY_STEPS or more memorises the photos, unless it has a dropout
MANY_STEPS = 150
# Most of the first steps draw a sample of a photo's pixels, each time a different sample: every STRIDE-th pixel in both
# directions. A sample costs as much as the photo at half size, and shows details that are lost at half size
STRIDE = 2
OFFSETS = ((0, 0), (1, 1), (1, 0), (0, 1))  # first column and first row of each sample, one sample after the other
DROPOUT = 0.1  # share of the Gaussians that each step leaves out if there are at most FEW_VIEWS
# Share of the Gaussians that each step leaves out if there are more than FEW_VIEWS views, in runs of at least
# LONG_STEPS steps that draw each view LONG_ROUNDS times
LONG_DROPOUT = 0.05
LONG_ROUNDS = 30  # steps for each view
# If there are photos larger than the views, the steps LARGE_STEPS (counted from 0) of each LARGE_CYCLE steps draw them.
# If more steps drew larger photos, renders at the size of the views would become worse
LARGE_CYCLE = 5
LARGE_STEPS = (0, 2)
# The steps use the draw modes one after the other. A mode is the size (0 full, 1 half), the variance of the low-pass
# filter as a share of the variance in viewers, and whether small Gaussians are made fainter to offset the low-pass, as
# some viewers do. The low-pass of a viewer is smaller relative to the scene from near by, and larger from afar.
# Gaussians that are fitted to one mode alone look thin or fat in the other modes (Mip-Splatting, 2024). The first steps
# have several modes too, because the sizes of Gaussians are decided early
FIRST_MODES = (0, 1.0, False), (0, 0.25, False), (0, 1.0, False), (1, 1.0, False)
DRAW_MODES = (
    (0, 1.0, True), (0, 1.0, False), (0, 0.25, False), (1, 1.0, False),
    (0, 1.0, False), (0, 1.0, False), (0, 0.25, False), (0, 1.0, False),
    (0, 1.0, True), (0, 1.0, False), (0, 0.25, False), (0, 1.0, False),
    (0, 1.0, False), (0, 1.0, False), (0, 0.25, False), (1, 1.0, False),
)  # fmt: skip

# Takes the step's number, the number of all steps, the PSNR (dB) of the last photos, and FitRun.half_part
OnStep = Callable[[int, int, float, float], None]


@dataclass(frozen=True, eq=False)
class FitJob:
    """What a fit is asked to do: photos, options, and limits of the result."""

    photos: tuple[Photos, ...]  # At full size, at half size, and larger if the fit uses larger photos
    options: FitOptions
    count: int = 0  # Number of Gaussians to grow to, if the run is long enough to grow
    most_growth: int | None = None  # Largest factor by which the number of Gaussians grows; None for no limit
    seed: int = 0
    progress: OnStep | None = None  # Called after each step
    fixed: np.ndarray | None = None  # [n] bool, true for Gaussians that must not change; None if all may
    # If renders stand for photos, the result is scored on the first `num_scored` renders. If there are real photos,
    # `num_scored` is None, and the result is scored on all photos
    num_scored: int | None = None
    held_out: Photos | None = None  # If given, the result is scored on these photos instead; no step draws them
    # Views from outside, in which some steps remove fog and veils; None for no such steps
    outside: Outside | None = None
    edges: Edges | None = None  # Edges of the views, at which Gaussians are cut; None for no cuts
    region: Region | None = None  # Region that no centre may leave; None for no limit

    def scored_photos(self, size: int) -> Photos:
        """Return the photos that a result is scored on if none are held out; :class:`DrawMode` explains ``size``."""
        photos = self.photos[size]
        return photos[range(len(photos))[: self.num_scored]]


@dataclass(frozen=True)
class DrawMode:
    """Size of the photos and low-pass with which a step draws the scene."""

    size: int  # Index of the size among the photos of the job: 0 full, 1 half, 2 larger
    eps2d: float  # Variance of the low-pass filter, in squared pixels of this size
    antialiased: bool = False  # True to make small Gaussians fainter, because the low-pass widens them
    stride: int = 1  # Distance from one drawn pixel to the next; pixels in between are left out


@dataclass(frozen=True, eq=False)
class FitRun:
    """A fit that is ready to run: its job, the weights of the pixels, the dropout, and how the first steps draw."""

    job: FitJob
    # [h,w] float32 weights of each photo at half size, for the score: 0 on held-out patches, which are scored;
    # `HIDDEN_WEIGHT` on pixels that neither steps nor scores use; 1 elsewhere
    score_weights: list[np.ndarray]
    # [h,w] float32 weights of each photo at each size, for the steps: 0 on hidden pixels, and the importance of the
    # pixel elsewhere. The weights at half size are also 0 on held-out patches
    step_weights: tuple[list[np.ndarray], ...]
    dropout: float  # Share of the Gaussians that a step leaves out
    half_part: float  # Share of the steps that are the first steps, which draw a quarter of the pixels
    scored_part: float  # Share of the steps after which held-out patches are scored, and all pixels count
    samples: bool = True  # True if most of the first steps draw samples of photos; otherwise all draw half-size photos
    # [h,w] bool of each photo at full size: the pixels that count in the first steps, or None if the same pixels
    # count as in later steps
    first_pixels: tuple[np.ndarray, ...] | None = None

    def weight(self, step: Step) -> np.ndarray:
        """Return the weights ``[h,w]`` of the pixels that a step draws.

        Until the held-out patches are scored, the weights are 0 on them.
        """
        weight = self.step_weights[step.mode.size][step.view][step.sample.pixels]
        if self.first_pixels is None or step.mode.stride == 1 or step.progress >= self.scored_part:
            return np.ascontiguousarray(weight)
        return np.where(self.first_pixels[step.view][step.sample.pixels], weight, np.float32(0))

    def outside_view(self, step: int, progress: float) -> int | None:
        """Return the index of the view from outside to draw after step ``step`` (from 1), or None to draw none."""
        outside = self.job.outside
        rates = self.job.options.tuning
        if outside is None or progress < rates.outside_from or step % rates.outside_every:
            return None
        return step // rates.outside_every % len(outside.views)

    def draw_mode(self, step: int, progress: float) -> DrawMode:
        """Return how step ``step`` (from 1) draws the scene.

        The first steps draw samples of the photos, and later steps draw whole photos. Steps use the modes of different
        viewers one after the other. If there are larger photos, some of the later steps draw the larger photos, which
        has the effect of a viewer who moves closer.
        """
        photos = self.job.photos
        has_larger = len(self.job.photos) > 2
        is_early = progress < self.half_part
        if is_early and not self.samples:
            return DrawMode(1, photos[1].eps2d)
        if has_larger and is_early:  # no step needs a smaller low-pass, because later steps draw the larger photos
            return DrawMode(0, photos[0].eps2d, stride=STRIDE)
        if has_larger and step % LARGE_CYCLE in LARGE_STEPS:
            return DrawMode(2, photos[2].eps2d)
        modes = FIRST_MODES if is_early else DRAW_MODES
        size, low_pass, antialiased = modes[step % len(modes)]
        # In short runs, steps on half-size photos cost more than they gain. If there are larger photos, it is enough
        # that every third step may draw at half size
        half_cycle = 3
        if not self.job.options.grows or (has_larger and step % half_cycle):
            size = 0
        return DrawMode(size, low_pass * photos[0].eps2d, antialiased, STRIDE if is_early and size == 0 else 1)


def prepare_fit(job: FitJob) -> FitRun:
    """Prepare a fit: choose held-out patches, the weights of pixels, the dropout, and how the first steps draw."""
    photos = job.photos
    options = job.options
    num_photos = len(photos[0])
    steps = options.steps
    dropout = options.dropout
    if dropout is None:
        dropout = LONG_DROPOUT if steps >= max(LONG_STEPS, LONG_ROUNDS * num_photos) else 0.0
        if num_photos <= FEW_VIEWS and steps >= MANY_STEPS:
            dropout = DROPOUT
    # The first steps draw samples of photos or, if they cannot, half-size photos. The samples of all photos together
    # need at least as many pixels as there are Gaussians. Cameras that move need half-size photos, whose blur gives a
    # gradient even to a pose with an error of a pixel
    sample_pixels = num_photos * (photos[0].width // STRIDE) * (photos[0].height // STRIDE)
    can_sample = steps >= SAMPLED_STEPS and not options.move_cameras and max(1, job.count) <= sample_pixels
    full_weights, *large_weights = (_weigh(_weights_of(level), level) for level in (photos[0], *photos[2:]))
    score_weights = half_weights = _weights_of(photos[1])
    first_pixels = None
    if options.scored:
        holdout_weights = training_weights(photos[0], options.holdout, job.seed)
        first_pixels = tuple((weight != 0) & (weight != HIDDEN_WEIGHT) for weight in holdout_weights)
        score_weights = reduced(holdout_weights, photos[1])
        half_weights = [np.where(weight == HIDDEN_WEIGHT, np.float32(0), weight) for weight in score_weights]
        if num_photos == 1:  # no other photo shows the held-out patches, so the fit is scored on all pixels
            score_weights = [np.where(weight == 1, np.float32(0), weight) for weight in score_weights]
    scored_part = options.half_res_part
    if options.half_res_share is None:  # a share that is asked for leaves out the patches of all its samples
        scored_part = min(scored_part, SCORED)
    return FitRun(
        job=job,
        score_weights=score_weights,
        step_weights=(full_weights, _weigh(half_weights, photos[1]), *large_weights),
        dropout=dropout,
        half_part=options.half_res_part,
        scored_part=scored_part,
        samples=can_sample,
        first_pixels=first_pixels,
    )


def _weights_of(photos: Photos) -> list[np.ndarray]:
    """Return the weights ``[h,w]`` of each photo, all 1 if the photos have none."""
    if photos.weights is None:
        return [np.ones((photos.height, photos.width), np.float32)] * len(photos)
    return list(photos.weights)


def _weigh(weights: list[np.ndarray], photos: Photos) -> list[np.ndarray]:
    """Multiply the weights ``[h,w]`` of each photo by the importance of its pixels."""
    if photos.importance is None:
        return weights
    return [weight * importance for weight, importance in zip(weights, photos.importance, strict=True)]


@dataclass(frozen=True, eq=False)
class Step:
    """What one step of a fit draws: a view, a background, a draw mode, and the Gaussians that take part."""

    number: int  # From 1
    progress: float  # Share of the steps that come before this step
    mode: DrawMode
    view: int
    background: np.ndarray  # [3] float32
    mask: np.ndarray | None  # [n] bool, false for Gaussians that dropout leaves out; None if all are drawn
    sample: Sample = WHOLE_PHOTO  # Pixels of the photo that are drawn


class Schedule:
    """Draw the order of views, the backgrounds and the dropped Gaussians of all steps from one seed.

    One generator draws everything, for each step first its background and then its dropout.
    """

    def __init__(self, run: FitRun):
        self.run, self.rng = run, np.random.default_rng(run.job.seed)
        self.views_left: list[int] = []  # views that the current round over all views has not drawn yet
        # for each view, the index of the next sample in OFFSETS; views begin with different samples
        self.samples = list(range(len(run.job.photos[0])))

    def draw(self, number: int, progress: float, count: int) -> Step:
        """Choose at random what step ``number`` (from 1) draws of ``count`` Gaussians.

        The views come in rounds, each of which has every view once, in random order.
        """
        if not self.views_left:
            self.views_left = self.rng.permutation(len(self.run.job.photos[0])).tolist()
        view = self.views_left.pop()
        background = self.rng.random(3, dtype=np.float32)
        mask = None
        are_renders = self.run.job.num_scored is not None
        if are_renders and number % 2:  # most viewers have a black background
            background = np.zeros(3, np.float32)
        if self.run.dropout > 0:
            mask = self.rng.random(count, dtype=np.float32) >= self.run.dropout
        mode = self.run.draw_mode(number, progress)
        sample = WHOLE_PHOTO
        if mode.stride > 1:
            sample = Sample(mode.stride, *OFFSETS[self.samples[view] % len(OFFSETS)])
            self.samples[view] += 1
        return Step(number, progress=progress, mode=mode, view=view, background=background, mask=mask, sample=sample)


def step_sizes(rates: Tuning, progress: float, steps: int) -> np.ndarray:
    """Return the step size of each of the fourteen parameters.

    Step sizes decay geometrically, and further in longer runs.
    """
    usual_steps = 300  # in a run with twice as many steps, the last step size is half as large
    decay = rates.decay * min(1.0, usual_steps / steps)
    start_rates = [rates.means_lr, rates.scales_lr, rates.quats_lr, rates.opacities_lr, rates.colors_lr]
    widths = [3, 3, 4, 1, 3]  # columns of means, log scales, quaternions, opacity logit and colours
    return (np.repeat(start_rates, widths) * power(decay, progress)).astype(np.float32)


def first_decay(rates: Tuning, rounds: float) -> float:
    """Return the decay of Adam's first moment after a number of ``rounds`` over all views.

    The moment averages about two steps at first, and about one more step after every four rounds, up to
    ``rates.beta1``. Early gradients change quickly, so the average is over few gradients. Later gradients differ mostly
    from view to view, so the average is over more gradients.
    """
    return min(rates.beta1, 1 - 1 / (2 + rounds / 4))
