"""Settings of a training run, each with a default, and settings under a name."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from gsmerge.errors import SceneError
from gsmerge.fit.loss import LOSS_WINDOW
from gsmerge.io.bounds import read_table
from gsmerge.measure.lpips import require_lpips
from gsmerge.networks.options import SLOTS, NetworkOptions
from gsmerge.stages.match import MatchOptions
from gsmerge.stages.superpixels import SegmentOptions

LISTS = ("levels", "densities", "views", "random_views")
COUNTS = (
    "fit_steps", "steps", "crops", "crop", "save_every", "validation_crops", "photo_scale", "most",
    "validation_windows", "teacher_steps", "diversity_steps", "buffer", "refresh", "workers", "validation_examples",
)  # fmt: skip
WEIGHTS = ("photo_weight", "ssim_weight", "lpips_weight", "regression_weight", "teacher_weight", "diversity_weight")
RANGES: tuple[tuple[tuple[str, ...], float, float, bool], ...] = (  # settings, least, most, whole numbers
    (COUNTS, 1, 10**9, True),
    (("warmup", "seed", "photo_side"), 0, 10**9, True),
    (("window",), LOSS_WINDOW, 10**9, True),
    (("average", "photo_start", "novel", "lpips_start", "overlap", "iou"), 0, 1, False),
    (("rate", "least_rate", "clip"), 1e-12, 1e6, False),
    (("decay", "turn_weight", *WEIGHTS), 0, 1e6, False),
    (("inner",), 1e-6, 1, False),
    (("opacity_shift",), -8, 8, False),
    (("similarity",), -1, 1, False),
)


@dataclass(frozen=True)
class TrainOptions:
    """Settings of a training run: what networks are trained on, and how.

    Args:
        network: Sizes of the networks.
        views: Numbers of views, evenly spread; 0 means all. A scene gives an example for each. The photos of the
            other views are novel views.
        random_views: Least and most views of a subset that is drawn anew for every window, as ``[1, 12]`` in the
            paper, in place of ``views``; empty: those. Not with a loss that uses the fit, whose result is that of one
            subset.
        recolor: Whether every window has colours of its own: channels in any order, less contrast, negatives. Few
            scenes have few colours, and networks learn these.
        densities: Superpixels per pixel; a scene gives an example for each. Two by default, since the full fit starts
            with 57 % of the usual number.
        segmentation: Superpixel method.
        match: Merging across views, see :class:`gsmerge.stages.match.MatchOptions`. Where no fit is used, what the
            networks make of a window is matched in every step.
        overlap: Least overlap of a match by ``"overlap"``, 0 to 1.
        iou: Least intersection over union of the boxes of a match by ``"aabb"``, 0 to 1.
        similarity: Least cosine of the latents of a match by ``"aabb"``, -1 to 1.
        geometry: What is matched in every step: ``"analytic"``: the moments, ``"decoded"``: the K = 1 head's output.
        fit_steps: Steps of the full fit whose result is the target; fitted only where a loss uses it:
            ``regression_weight`` or ``photo_start`` above 0.
        levels: Numbers of children K whose heads are trained, of 1, 2 and 4; each needs a fit, if there is one.
        buffer: Examples in memory for each crop of a step, which draws one of them.
        refresh: Steps after which the next example takes the place of the oldest of these.
        workers: Threads that read examples ahead.
        steps: Steps of the training.
        warmup: Steps over which the learning rate increases.
        rate: Highest learning rate.
        least_rate: Rate at the end of the cosine.
        decay: Weight decay (AdamW).
        clip: Largest norm of the gradient.
        average: Weight of the previous mean in the running mean of the weights, which is validated and saved; less in
            the first steps.
        crops: Crops or windows per step, of all processes together; worked on in parallel.
        crop: Feature Gaussians of a crop: those nearest to one of them.
        inner: Share of a crop that is scored; the rest are neighbours.
        turn_weight: Weight of the rotation in the loss; it is small because axes of similar length have no direction.
        photo_start: Share of the steps after which renders are compared with photos; 1: never. Of two runs of
            400 steps on two scenes, the one with 0.3 ended 0.9 dB below the one with 0.
        novel: Share of the windows in novel views, if there are any.
        photo_scale: Factor by which the sides of the photos are divided.
        photo_side: Longer side of the photos in pixels, where they are larger, in place of ``photo_scale``; 476 in the
            paper; 0: not used.
        window: Side of a window of a photo that is rendered, pixels.
        most: Feature Gaussians that may reach into a window; a window with more is halved.
        photo_loss: Colour loss: ``"l1"`` or ``"mse"`` (as in the paper).
        photo_weight: Weight of the colour loss.
        ssim_weight: Weight of 1 - SSIM.
        lpips_weight: Weight of LPIPS (VGG), whose weights must be installed; a step takes twice as long with it.
        lpips_start: Share of the steps after which LPIPS has its weight.
        regression_weight: Weight of the regression when renders are compared; it falls to 0 until the end of the run.
        teacher_weight: Weight of the distance from the moments of the groups (paper eq. teacher_mean, teacher_cov).
        teacher_steps: Steps that compare renders over which it falls to 0.
        diversity_weight: Weight of the diversification of several children.
        diversity_unit: Unit of the volumes by which pairs of children are weighted: ``"group"``: the size of theirs,
            so that weights start near 1. ``"scene"``: the scene's median depth, which is closest to the paper's letter
            and leaves nothing of the loss.
        diversity_steps: Steps that compare renders over which it falls to 0.
        opacity_shift: Added to the raw correction of the opacity by the heads of the checkpoints. New captures have
            holes that scenes in training lack.
        save_every: Steps between checkpoints, validation and lines of the table.
        validation_examples: Most examples for validation, evenly spread over those that there are.
        validation_crops: Crops of each of them, always the same; only where a loss uses the fit.
        validation_windows: Windows of each of them, always the same.
        seed: Seed of all random numbers.

    Raises:
        ValueError: If a setting is out of range.
    """

    network: NetworkOptions = field(default_factory=NetworkOptions)
    views: tuple[int, ...] = (3, 6, 0)
    random_views: tuple[int, ...] = ()
    recolor: bool = False
    densities: tuple[float, ...] = (0.025, 0.044)
    segmentation: str = "rdseg"
    match: str = "overlap"
    overlap: float = 0.7
    iou: float = 0.2
    similarity: float = 0.8
    geometry: str = "analytic"
    fit_steps: int = 300
    levels: tuple[int, ...] = SLOTS
    buffer: int = 4
    refresh: int = 4
    workers: int = 1
    steps: int = 6000
    warmup: int = 200
    rate: float = 1e-3
    least_rate: float = 1e-5
    decay: float = 1e-4
    clip: float = 1.0
    average: float = 0.998
    crops: int = 2
    crop: int = 512
    inner: float = 0.6
    turn_weight: float = 0.1
    photo_start: float = 0.0
    novel: float = 0.75
    photo_scale: int = 2
    photo_side: int = 0
    window: int = 96
    most: int = 4000
    photo_loss: str = "l1"
    photo_weight: float = 0.8
    ssim_weight: float = 0.2
    lpips_weight: float = 0.0
    lpips_start: float = 0.0
    regression_weight: float = 0.1
    teacher_weight: float = 0.0
    teacher_steps: int = 2000
    diversity_weight: float = 0.0
    diversity_unit: str = "group"
    diversity_steps: int = 50_000
    opacity_shift: float = 0.0
    save_every: int = 200
    validation_examples: int = 24
    validation_crops: int = 8
    validation_windows: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        for names, low, high, whole in RANGES:
            for name in names:
                self._expect(name, getattr(self, name), low, high, whole=whole)
        for name in LISTS:  # JSON and TOML have lists
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name, least in (("views", 0), ("random_views", 1)):
            for count in getattr(self, name):
                self._expect(name, count, least, 10**6, whole=True)
        for density in self.densities:
            self._expect("densities", density, 1e-6, 1)
        for name in ("views", "densities"):
            if not getattr(self, name):
                raise ValueError(f"{name}: expected at least one number, got none")
        if self.random_views and (len(self.random_views) != 2 or self.random_views[0] > self.random_views[1]):
            raise ValueError(f"random_views: expected the least and the most, got {list(self.random_views)}")
        if self.random_views and self.uses_fit:
            raise ValueError("random_views: expected regression_weight 0 and photo_start 0, got a loss that uses a fit")
        if self.diversity_unit not in ("group", "scene"):
            raise ValueError(f'diversity_unit: expected "group" or "scene", got {self.diversity_unit!r}')
        if not isinstance(self.recolor, bool):
            raise ValueError(f"recolor: expected true or false, got {self.recolor!r}")
        if self.photo_loss not in ("l1", "mse"):
            raise ValueError(f'photo_loss: expected "l1" or "mse", got {self.photo_loss!r}')
        if not self.levels or len(set(self.levels)) < len(self.levels) or not set(self.levels) <= set(SLOTS):
            raise ValueError(f"levels: expected some of 1, 2 and 4, got {list(self.levels)}")
        if self.match is None:
            raise ValueError('match: expected "overlap", "aabb" or "none", got None')
        SegmentOptions(segmentation=self.segmentation)
        self.match_options()

    @staticmethod
    def _expect(name: str, value: Any, low: float, high: float, *, whole: bool = False) -> None:
        kind = int if whole else int | float
        if isinstance(value, bool) or not isinstance(value, kind) or not low <= value <= high:
            number = "a whole number" if whole else "a number"
            raise ValueError(f"{name}: expected {number} from {low:g}, got {value!r}")

    @property
    def uses_fit(self) -> bool:
        """Whether a loss compares corrections with those of a full fit."""
        return self.regression_weight > 0 or self.photo_start > 0

    @property
    def example_views(self) -> tuple[int, ...]:
        """Numbers of views of a scene's examples; random subsets are drawn from all."""
        return (0,) if self.random_views else self.views

    def match_options(self) -> MatchOptions:
        """Return the options of matching Feature Gaussians across views."""
        names = ("match", "overlap", "iou", "similarity", "geometry")
        return MatchOptions(**{name: getattr(self, name) for name in names})

    def photo_level(self, width: int, height: int) -> float:
        """Return the factor by which the sides of photos of ``width`` by ``height`` pixels are divided."""
        return max(1.0, max(width, height) / self.photo_side) if self.photo_side else self.photo_scale

    def require_weights(self) -> None:
        """Raise a GsmergeError if LPIPS has a weight, and its weights are not installed."""
        if self.lpips_weight:
            require_lpips("vgg")

    def lpips_weight_at(self, step: int) -> float:
        """Return the weight of LPIPS in a step, counted from 0."""
        return self.lpips_weight if step >= self.lpips_start * self.steps else 0.0

    @property
    def photo_step(self) -> int:
        """Number of the first step, counted from 0, that compares renders with photos."""
        return math.ceil(self.photo_start * self.steps)

    def regularizer_weights(self, step: int) -> tuple[float, float, float]:
        """Return the weights of regression, teacher and diversification in a step that compares renders."""
        done = step - self.photo_step

        def left(steps: int) -> float:
            return max(0.0, 1 - done / max(1, steps))

        return (
            self.regression_weight * left(self.steps - self.photo_step),
            self.teacher_weight * left(self.teacher_steps),
            self.diversity_weight * left(self.diversity_steps),
        )

    def rate_at(self, step: int) -> float:
        """Return the learning rate of a step, counted from 0: a linear increase, then half a cosine."""
        if step < self.warmup:
            return self.rate * (step + 1) / self.warmup
        part = (step - self.warmup) / max(1, self.steps - self.warmup)
        return self.least_rate + (self.rate - self.least_rate) * (1 + math.cos(math.pi * part)) / 2

    def to_dict(self) -> dict[str, Any]:
        """Convert all settings to plain values."""
        return asdict(self) | {name: list(getattr(self, name)) for name in LISTS}

    def with_settings(self, values: Mapping[str, Any]) -> TrainOptions:
        """Change some settings by name, also those in the tables ``network`` and ``bounds``.

        A ValueError if a name is unknown or a value out of range.
        """
        unknown = sorted(values.keys() - {f.name for f in fields(TrainOptions)})
        if unknown:
            raise ValueError(f"unknown setting {unknown[0]!r}")
        table = values.get("network", {})
        if not isinstance(table, Mapping):
            raise ValueError(f"network: expected a table, got {table!r}")
        present, bounds = asdict(self.network), table.get("bounds", {})
        if isinstance(bounds, Mapping):
            table = {**table, "bounds": present["bounds"] | dict(bounds)}
        return replace(self, **{**values, "network": NetworkOptions.from_dict(present | dict(table))})


def read_config(path: Path, start: TrainOptions | None = None) -> TrainOptions:
    """Change ``start``, or the defaults, by settings of a TOML or JSON file, named as in :class:`TrainOptions`.

    A SceneError if the file cannot be read or a setting is unknown or out of range.
    """
    table = read_table(path)
    try:
        return (start or TrainOptions()).with_settings(table)
    except (TypeError, ValueError) as error:
        raise SceneError(path, str(error).splitlines()[0]) from error


# Table of hyperparameters, sections 4.1, 4.4 and 5.1 of the paper; settings that it does not give are the defaults, but
# for the densities, of which the fit alone needs two.
PAPER: Mapping[str, Any] = {
    "network": {"outputs": "absolute", "merger_start": "first"},
    "random_views": (1, 12),
    "densities": (0.044,),
    "segmentation": "bass-st",
    "match": "aabb",
    "iou": 0.2,
    "geometry": "decoded",
    "photo_side": 476,
    "levels": (1, 2, 4),
    "steps": 300_000,
    "warmup": 2_000,
    "rate": 5e-5,
    "least_rate": 1e-6,
    "clip": 10.0,
    "photo_start": 0.0,
    "photo_loss": "mse",
    "photo_weight": 1.0,
    "ssim_weight": 0.05,
    "lpips_weight": 0.05,
    "regression_weight": 0.0,
    "teacher_weight": 0.25,
    "teacher_steps": 2_000,
    "diversity_weight": 1.0,
    "diversity_steps": 50_000,
}
# What the package ships is trained with. Encoder and merger gained nothing that validation showed; colour corrections
# learnt the exposure of the training photos. docs/laboratory/networks.md has the figures.
SHIPPED: Mapping[str, Any] = {
    "network": {"encoder": False, "merger": False, "bounds": {"color": 0.0}},
    "recolor": True,
    "views": (3, 0),
    "fit_steps": 100,
    "steps": 2_600,
    "lpips_weight": 0.06,
    "lpips_start": 0.8,
    "opacity_shift": 0.3,
    "photo_scale": 1,  # children of K = 4 are smaller than pixels of photos at half the size
    "window": 128,
    "save_every": 100,
    "validation_crops": 4,
    "validation_windows": 6,
}
# The paper's training, shortened to what two processor cores do in an hour and a half.
PAPER_SHIPPED: Mapping[str, Any] = {
    **PAPER,
    "recolor": True,
    "iou": 0.35,  # at 0.2 clusters that grow and Gaussians that grow feed each other at this rate
    "steps": 2_600,
    "warmup": 80,
    "rate": 1e-3,
    "least_rate": 1e-5,
    "clip": 1.0,
    "average": 0.995,
    "lpips_weight": 0.0,
    "window": 192,
    "teacher_steps": 1_000,
    "diversity_weight": 0.1,
    "diversity_steps": 1_000,
    "save_every": 100,
    "validation_examples": 6,
    "validation_windows": 4,
}
PRESETS: Mapping[str, Mapping[str, Any]] = {
    "default": {}, "shipped": SHIPPED, "paper": PAPER, "paper-shipped": PAPER_SHIPPED,
}  # fmt: skip


def preset_options(name: str) -> TrainOptions:
    """Return the settings under a name; a ValueError if it is unknown."""
    if name not in PRESETS:
        raise ValueError(f"preset: expected {' or '.join(PRESETS)}, got {name!r}")
    return TrainOptions().with_settings(PRESETS[name])
