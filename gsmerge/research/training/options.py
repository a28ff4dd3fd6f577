"""Settings of a training run, each with a default, and settings under a name."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from gsmerge.errors import SceneError
from gsmerge.io.tables import read_table
from gsmerge.networks import NetworkOptions
from gsmerge.networks.modules import SLOTS
from gsmerge.stages.fit.loss import LOSS_WINDOW


@dataclass(frozen=True)
class TrainOptions:
    """How networks are trained to predict what the fit changes.

    Args:
        network: Sizes of the networks.
        views: Numbers of views, evenly spread; 0 means all. A scene gives an example for each. The photos of the
            other views are novel views.
        densities: Superpixels per pixel; a scene gives an example for each. Two by default, since the full fit starts
            with 57 % of the usual number.
        match: Merging across views of the examples, see :class:`gsmerge.stages.match.MatchOptions`.
        fit_steps: Steps of the full fit whose result is the target.
        levels: Numbers of children K whose heads are trained, of 1, 2 and 4; each needs a fit of every scene.
        steps: Steps of the training.
        warmup: Steps over which the learning rate increases.
        rate: Highest learning rate.
        least_rate: Rate at the end of the cosine.
        decay: Weight decay (AdamW).
        clip: Largest norm of the gradient.
        average: Weight of the previous mean in the running mean of the weights, which is validated and saved; less in
            the first steps.
        crops: Crops per step, worked on in parallel.
        crop: Merged Feature Gaussians of a crop: those nearest to one of them.
        inner: Share of a crop that is scored; the rest are neighbours.
        turn_weight: Weight of the rotation in the loss; it is small because axes of similar length have no direction.
        photo_start: Share of the steps after which renders are compared with photos; 1: never. Of two runs of
            400 steps on two scenes, the one with 0.3 ended 0.9 dB below the one with 0.
        novel: Share of the windows in novel views, if there are any.
        photo_scale: Factor by which the sides of the photos are divided.
        window: Side of a window of a photo that is rendered, pixels.
        most: Feature Gaussians that may reach into a window; a window with more is halved.
        photo_loss: Colour loss: ``"l1"`` or ``"mse"`` (as in the paper).
        photo_weight: Weight of the colour loss.
        ssim_weight: Weight of 1 - SSIM.
        lpips_weight: Weight of LPIPS (VGG), whose networks must be installed; a step takes twice as long with it.
        regression_weight: Weight of the regression when renders are compared; it falls to 0 until the end of the run.
        teacher_weight: Weight of the distance from the analytic Gaussians.
        teacher_steps: Steps that compare renders over which it falls to 0.
        diversity_weight: Weight of the diversification of several children.
        diversity_steps: Steps that compare renders over which it falls to 0.
        save_every: Steps between checkpoints, validation and lines of the table.
        validation_crops: Crops of each scene for validation, always the same.
        validation_windows: Windows of each scene for validation, always the same.
        seed: Seed of all random numbers.

    Raises:
        ValueError: If a setting is out of range.
    """

    network: NetworkOptions = field(default_factory=NetworkOptions)
    views: tuple[int, ...] = (3, 6, 0)
    densities: tuple[float, ...] = (0.025, 0.044)
    match: str = "overlap"
    fit_steps: int = 300
    levels: tuple[int, ...] = SLOTS
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
    window: int = 96
    most: int = 4000
    photo_loss: str = "l1"
    photo_weight: float = 0.8
    ssim_weight: float = 0.2
    lpips_weight: float = 0.0
    regression_weight: float = 0.1
    teacher_weight: float = 0.0
    teacher_steps: int = 2000
    diversity_weight: float = 0.0
    diversity_steps: int = 50_000
    save_every: int = 200
    validation_crops: int = 8
    validation_windows: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("fit_steps", "steps", "crops", "crop", "save_every", "validation_crops", "photo_scale", "most",
                     "validation_windows", "teacher_steps", "diversity_steps"):  # fmt: skip
            self._expect(name, getattr(self, name), 1, 10**9, whole=True)
        for name in ("warmup", "seed"):
            self._expect(name, getattr(self, name), 0, 10**9, whole=True)
        self._expect("inner", self.inner, 1e-6, 1)
        self._expect("window", self.window, LOSS_WINDOW, 10**9, whole=True)
        for name in ("average", "photo_start", "novel"):
            self._expect(name, getattr(self, name), 0, 1)
        for name in ("rate", "least_rate", "clip"):
            self._expect(name, getattr(self, name), 1e-12, 1e6)
        weights = [f.name for f in fields(self) if f.name.endswith("_weight")]
        for name in ("decay", *weights):
            self._expect(name, getattr(self, name), 0, 1e6)
        for name in ("levels", "densities", "views"):  # JSON and TOML have lists
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if not self.densities:
            raise ValueError("densities: expected at least one, got none")
        for density in self.densities:
            self._expect("densities", density, 1e-6, 1)
        if not self.views:
            raise ValueError("views: expected at least one number, got none")
        for count in self.views:
            self._expect("views", count, 0, 10**6, whole=True)
        if self.photo_loss not in ("l1", "mse"):
            raise ValueError(f'photo_loss: expected "l1" or "mse", got {self.photo_loss!r}')
        if not self.levels or len(set(self.levels)) < len(self.levels) or not set(self.levels) <= set(SLOTS):
            raise ValueError(f"levels: expected some of 1, 2 and 4, got {list(self.levels)}")
        if self.match not in ("overlap", "aabb", "none"):
            raise ValueError(f'match: expected "overlap", "aabb" or "none", got {self.match!r}')

    @staticmethod
    def _expect(name: str, value: Any, low: float, high: float, *, whole: bool = False) -> None:
        kind = int if whole else int | float
        if isinstance(value, bool) or not isinstance(value, kind) or not low <= value <= high:
            number = "a whole number" if whole else "a number"
            raise ValueError(f"{name}: expected {number} from {low:g}, got {value!r}")

    @property
    def photo_step(self) -> int:
        """The first step, counted from 0, that compares renders with photos."""
        return math.ceil(self.photo_start * self.steps)

    def regularizer_weights(self, step: int) -> tuple[float, float, float]:
        """Weights of regression, teacher and diversification in a step that compares renders."""
        done = step - self.photo_step

        def left(steps: int) -> float:
            return max(0.0, 1 - done / max(1, steps))

        return (
            self.regression_weight * left(self.steps - self.photo_step),
            self.teacher_weight * left(self.teacher_steps),
            self.diversity_weight * left(self.diversity_steps),
        )

    def rate_at(self, step: int) -> float:
        """Learning rate of a step, counted from 0: a linear increase, then half a cosine."""
        if step < self.warmup:
            return self.rate * (step + 1) / self.warmup
        part = (step - self.warmup) / max(1, self.steps - self.warmup)
        return self.least_rate + (self.rate - self.least_rate) * (1 + math.cos(math.pi * part)) / 2

    def to_dict(self) -> dict[str, Any]:
        """All settings as plain values."""
        return asdict(self) | {name: list(getattr(self, name)) for name in ("levels", "densities", "views")}

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> TrainOptions:
        """The defaults with some settings changed; ``network`` is a table in the table.

        Raises:
            ValueError: If a name is unknown or a value out of range.
        """
        return TrainOptions().with_settings(values)

    def with_settings(self, values: Mapping[str, Any]) -> TrainOptions:
        """Some settings changed, as in :meth:`from_dict`; a ``network`` is changed from the default one.

        Raises:
            ValueError: If a name is unknown or a value out of range.
        """
        unknown = sorted(values.keys() - {f.name for f in fields(TrainOptions)})
        if unknown:
            raise ValueError(f"unknown setting {unknown[0]!r}")
        network = values.get("network", asdict(self.network))
        if not isinstance(network, Mapping):
            raise ValueError(f"network: expected a table, got {network!r}")
        return replace(self, **{**values, "network": NetworkOptions.from_dict(network)})


def read_config(path: Path, start: TrainOptions | None = None) -> TrainOptions:
    """``start``, or the defaults, with settings of a TOML or JSON file, named as the fields of :class:`TrainOptions`.

    Raises:
        SceneError: If the file cannot be read or a setting is unknown or out of range.
    """
    table = read_table(path)
    try:
        return (start or TrainOptions()).with_settings(table)
    except (TypeError, ValueError) as error:
        raise SceneError(path, str(error).splitlines()[0]) from error


# Table of hyperparameters and section 5.1 of the paper; settings that it does not give are the defaults.
PAPER: Mapping[str, Any] = MappingProxyType(
    {
        "network": {"outputs": "absolute"},
        "views": tuple(range(1, 13)),
        "match": "aabb",
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
)
PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType({"default": MappingProxyType({}), "paper": PAPER})


def preset_options(name: str) -> TrainOptions:
    """The settings under a name.

    Raises:
        ValueError: If the name is unknown.
    """
    if name not in PRESETS:
        raise ValueError(f"preset: expected {' or '.join(PRESETS)}, got {name!r}")
    return TrainOptions.from_dict(PRESETS[name])
