"""Plan the steps of a full fit: the view, background, Gaussians, draw mode and rates of each step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gsmerge.fit.edges import Edges
from gsmerge.fit.outside import Outside
from gsmerge.fit.photo_sizes import HIDDEN_WEIGHT, reduced, training_weights
from gsmerge.kernels.elementary import power
from gsmerge.raster.photos import WHOLE_PHOTO, Photos, Sample
from gsmerge.settings.fit import LONG_STEPS, FitOptions, Tuning
from gsmerge.types import Region

GROWTH = 0.5  # share of the steps after which Gaussians are added
# Shares of the steps after which Gaussians are cut at the edges of the views. The first cuts come early, so that photos
# are fitted without Gaussians beyond the edges. Gaussians grow again after a cut, so there are cuts until the mean of
# the last steps begins
CUTS = (0.0, 0.15, 0.3, 0.5, 0.7)
CLEARS = (0.6, 0.7, 0.8)  # shares of the steps after which runs that grow drop faint Gaussians
FEW_VIEWS = 5  # with at most this many views a run of MANY_STEPS memorises the photos, unless Gaussians are dropped
MANY_STEPS = 150  # least steps of such a run
# Most of the first steps draw a sample of a photo's pixels, each time a different sample. A sample costs as much as the
# photo at half size, and shows details that are lost at half size.
STRIDE = 2
OFFSETS = ((0, 0), (1, 1), (1, 0), (0, 1))  # columns and rows of the samples, one after the other
DROPOUT = 0.1  # share of the Gaussians that a step leaves out with few views
LONG_DROPOUT = 0.05  # the same share in runs of LONG_STEPS that draw each view LONG_ROUNDS times
LONG_ROUNDS = 30  # steps for each view
LARGE_CYCLE = 5  # of this many steps, the steps LARGE_STEPS draw larger photos; more would worsen the views' own size
LARGE_STEPS = (0, 2)  # numbers of steps within a cycle, from 0
# Draw modes of steps, one after the other. A mode is 1 for half size or 0 for full size, the low-pass as a share of the
# viewers' own low-pass, and whether small Gaussians are made fainter to offset the low-pass, as some viewers do. In a
# view that is enlarged twice, the low-pass is a quarter; from afar, it covers more of the scene. Gaussians that are
# fitted to one mode alone look thin or fat in the other modes (Mip-Splatting, Yu et al. 2024). The first steps, in
# which Gaussians find their sizes, have several modes too.
FIRST_MODES = (0, 1.0, False), (0, 0.25, False), (0, 1.0, False), (1, 1.0, False)
DRAW_MODES = (
    (0, 1.0, True), (0, 1.0, False), (0, 0.25, False), (1, 1.0, False),
    (0, 1.0, False), (0, 1.0, False), (0, 0.25, False), (0, 1.0, False),
    (0, 1.0, True), (0, 1.0, False), (0, 0.25, False), (0, 1.0, False),
    (0, 1.0, False), (0, 1.0, False), (0, 0.25, False), (1, 1.0, False),
)  # fmt: skip

OnStep = Callable[[int, int, float, float], None]  # step, steps, PSNR of the photos, share of the first steps


@dataclass(frozen=True, eq=False)
class FitJob:
    """Photos to fit to, with options and start conditions."""

    photos: tuple[Photos, ...]  # At full size, at half size, and larger ones if the fit uses them
    options: FitOptions
    count: int = 0  # Gaussians to grow to, where the run is long enough
    most_growth: int | None = None  # Most Gaussians after the growth, relative to those before it; None: any number
    seed: int = 0
    progress: OnStep | None = None  # Called after each step
    fixed: np.ndarray | None = None  # [n] bool, Gaussians that stay unchanged; None: none
    # If renders stand for photos, the result is scored on this number of first photos; None: on all photos
    num_scored: int | None = None
    held_out: Photos | None = None  # Photos that the result is scored on in place of these, and no step draws
    outside: Outside | None = None  # Views from outside, in which some steps clear fog and veils; None: no such steps
    edges: Edges | None = None  # Edges of the views, at which Gaussians are cut; None: no cuts
    region: Region | None = None  # Region in which centres stay; None: everywhere

    def scored_photos(self, size: int) -> Photos:
        """Return the photos that a result is scored on, at a size as of :class:`DrawMode`."""
        photos = self.photos[size]
        return photos[range(len(photos))[: self.num_scored]]


@dataclass(frozen=True)
class DrawMode:
    """Size of the photos and low-pass with which a step draws the scene."""

    size: int  # Of the photos: 0 full, 1 half, 2 larger
    eps2d: float  # Low-pass, pixels squared of this size
    antialiased: bool = False  # Make small Gaussians fainter, to offset that the low-pass widens them
    stride: int = 1  # Distance of the pixels that are drawn; pixels in between are left out


@dataclass(frozen=True, eq=False)
class FitRun:
    """A prepared full fit: weights of the pixels, dropout, and the share of the first steps."""

    job: FitJob
    # [h,w] float32 weights of each photo at half size: 0 on held-out patches, if the fit is scored on them,
    # `HIDDEN_WEIGHT` on pixels that neither steps nor scores use, 1 elsewhere
    weights: list[np.ndarray]
    # [h,w] float32 weights in steps, of each photo at each size: 0 on hidden pixels, elsewhere the importance of the
    # pixel. Held-out patches are 0 only at half size
    step_weights: tuple[list[np.ndarray], ...]
    dropout: float  # Share of the Gaussians that a step leaves out
    half_part: float  # Share of the first steps, which draw a quarter of the pixels
    samples: bool = True  # Whether most of the first steps draw samples of photos; otherwise all draw half-size photos
    # [h,w] bool of each photo at full size: pixels that count in the first steps; None: the same as in all other steps
    first_pixels: tuple[np.ndarray, ...] | None = None

    def weight(self, step: Step) -> np.ndarray:
        """Return the weights ``[h,w]`` of the pixels that a step draws; held-out patches are 0 in the first steps."""
        weight = self.step_weights[step.mode.size][step.view][step.sample.pixels]
        if step.mode.stride == 1 or self.first_pixels is None:
            return np.ascontiguousarray(weight)
        return np.where(self.first_pixels[step.view][step.sample.pixels], weight, np.float32(0))

    def outside_view(self, step: int, progress: float) -> int | None:
        """Return the index of the view from outside that is fitted after step ``step`` (from 1); None: none."""
        outside, rates = self.job.outside, self.job.options.tuning
        if outside is None or progress < rates.outside_from or step % rates.outside_every:
            return None
        return step // rates.outside_every % len(outside.views)

    def draw_mode(self, step: int, progress: float) -> DrawMode:
        """Return how step ``step`` (from 1) draws the scene.

        The first steps draw samples of the photos, later steps draw whole photos, both in the modes of different
        viewers. If there are larger photos, some of the later steps draw these, as an enlarged view does.
        """
        photos, is_early, has_larger = self.job.photos, progress < self.half_part, len(self.job.photos) > 2
        if is_early and not self.samples:
            return DrawMode(1, photos[1].eps2d)
        if has_larger and is_early:  # larger photos will show the scene from near
            return DrawMode(0, photos[0].eps2d, stride=STRIDE)
        if has_larger and step % LARGE_CYCLE in LARGE_STEPS:
            return DrawMode(2, photos[2].eps2d)
        modes = FIRST_MODES if is_early else DRAW_MODES
        size, low_pass, antialiased = modes[step % len(modes)]
        half_cycle = 3  # with larger photos, one of this many half-size steps remains
        # Half-size photos cost short runs more than they gain. If larger photos show the scene from near, a third of
        # the half-size steps is enough
        if not self.job.options.grows or (has_larger and step % half_cycle):
            size = 0
        return DrawMode(size, low_pass * photos[0].eps2d, antialiased, STRIDE if is_early and size == 0 else 1)


def prepare_fit(job: FitJob) -> FitRun:
    """Prepare a fit: held-out patches, pixels outside masks, and dropout where there are few views."""
    photos, options = job.photos, job.options
    dropout = default_dropout(options.steps, len(photos[0])) if options.dropout is None else options.dropout
    everywhere, *larger = (_weigh(_weights_of(level), level) for level in (photos[0], *photos[2:]))
    weights = train_weights = _weights_of(photos[1])
    first_pixels = None
    if options.scored:
        whole = training_weights(photos[0], options.holdout, job.seed)
        first_pixels = tuple((weight != 0) & (weight != HIDDEN_WEIGHT) for weight in whole)
        weights = reduced(whole, photos[1])
        train_weights = [np.where(weight == HIDDEN_WEIGHT, np.float32(0), weight) for weight in weights]
        if len(photos[0]) == 1:  # no other photo shows the held-out patches, so the fit is scored on all pixels
            weights = [np.where(weight == 1, np.float32(0), weight) for weight in weights]
    step_weights = everywhere, _weigh(train_weights, photos[1]), *larger
    return FitRun(job, weights, step_weights, dropout, options.half_res_part, _can_sample(job), first_pixels)


def default_dropout(steps: int, num_photos: int) -> float:
    """Return the share of the Gaussians that a step leaves out, for a run of ``steps`` on ``num_photos``."""
    if num_photos <= FEW_VIEWS and steps >= MANY_STEPS:
        return DROPOUT
    return LONG_DROPOUT if steps >= max(LONG_STEPS, LONG_ROUNDS * num_photos) else 0.0


def _can_sample(job: FitJob) -> bool:
    """Return whether the first steps may draw samples of photos.

    The samples of all photos need at least as many pixels as there are Gaussians. While cameras move, photos have to be
    blurred instead, so that a pose with an error of a pixel still has a gradient.
    """
    photos, options = job.photos[0], job.options
    pixels = len(photos) * (photos.width // STRIDE) * (photos.height // STRIDE)
    min_steps = 30  # shorter runs draw too few samples to see all pixels: .07 dB less at 20 steps, 1 dB at 7
    return options.steps >= min_steps and not options.move_cameras and max(1, job.count) <= pixels


def _weights_of(photos: Photos) -> list[np.ndarray]:
    """Return the weights ``[h,w]`` of all pixels of each photo."""
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
    """One step of the fit: view, background, draw mode, and the Gaussians that are drawn."""

    number: int  # From 1
    progress: float  # Share of the steps before it
    mode: DrawMode
    view: int
    background: np.ndarray  # [3] float32
    mask: np.ndarray | None  # [n] bool, Gaussians that are drawn; dropout leaves out the rest; None: all are drawn
    sample: Sample = WHOLE_PHOTO  # Pixels of the photo that are drawn


class Schedule:
    """Draw the order of views, the backgrounds and the dropped Gaussians of all steps from one seed.

    One generator draws everything, and a step's dropout after its background. A second generator for dropout would
    change the results of few views and of long runs.
    """

    def __init__(self, run: FitRun):
        self.run, self.rng = run, np.random.default_rng(run.job.seed)
        self.views_left: list[int] = []  # views that the current round over all views has not drawn yet
        # index of each view's next sample; views begin with different samples
        self.samples = list(range(len(run.job.photos[0])))

    def draw(self, number: int, progress: float, count: int) -> Step:
        """Draw step ``number`` (from 1) for ``count`` Gaussians; a round over all views has each view once."""
        if not self.views_left:
            self.views_left = self.rng.permutation(len(self.run.job.photos[0])).tolist()
        view, background, mask = self.views_left.pop(), self.rng.random(3, dtype=np.float32), None
        if self.run.job.num_scored is not None and number % 2:  # renders, which most viewers show before black
            background = np.zeros(3, np.float32)
        if self.run.dropout > 0:
            mask = self.rng.random(count, dtype=np.float32) >= self.run.dropout
        mode, sample = self.run.draw_mode(number, progress), WHOLE_PHOTO
        if mode.stride > 1:
            sample = Sample(mode.stride, *OFFSETS[self.samples[view] % len(OFFSETS)])
            self.samples[view] += 1
        return Step(number, progress, mode, view, background, mask, sample)


def step_sizes(rates: Tuning, progress: float, steps: int) -> np.ndarray:
    """Return the step size of each of the fourteen parameters; it decays geometrically, and further in longer runs."""
    usual_steps = 300  # in longer runs the last step sizes shrink in proportion to the number of steps
    decay = rates.decay * min(1.0, usual_steps / steps)
    start_rates = [rates.means_lr, rates.scales_lr, rates.quats_lr, rates.opacities_lr, rates.colors_lr]
    widths = [3, 3, 4, 1, 3]  # columns of means, log scales, quaternions, opacity logit and colours
    return (np.repeat(start_rates, widths) * power(decay, progress)).astype(np.float32)


def first_decay(rates: Tuning, rounds: float) -> float:
    """Return the decay of Adam's first moment after a number of rounds over all views.

    Momentum grows during the fit. At first it averages two steps that show a Gaussian, and one step more after every
    four rounds. Early gradients change from step to step; later gradients differ most between views.
    """
    return min(rates.beta1, 1 - 1 / (2 + rounds / 4))
