"""Define the settings of a training run, each with a default, and named presets."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from gsmerge.frozen import asdict, dataclass
from gsmerge.method.kernels.raster.step import WINDOW_SIDE
from gsmerge.method.networks.options import SLOTS, NetworkOptions
from gsmerge.scoring.lpips import require_lpips
from gsmerge.settings.setting import Settings, setting
from gsmerge.settings.stages import SEGMENTATIONS, MatchMethod, MatchOptions

COUNT_LIMITS: dict[str, Any] = {"least": 1, "most": 10**9}
FROM_0_LIMITS: dict[str, Any] = {"least": 0, "most": 10**9}
SHARE_LIMITS: dict[str, Any] = {"least": 0, "most": 1}
RATE_LIMITS: dict[str, Any] = {"least": 1e-12, "most": 1e6}
WEIGHT_LIMITS: dict[str, Any] = {"least": 0, "most": 1e6}
LIST_OPTIONS = ("levels", "densities", "views", "random_views")


@dataclass(frozen=True)
class TrainOptions(Settings):
    """Settings of a training run: data, networks and losses."""

    network: NetworkOptions = setting(NetworkOptions(), "Sizes of the networks.")
    views: tuple[int, ...] = setting((3, 6, 0), "Numbers of views, evenly spread; 0 means all.",
        "A scene gives an example for each number. The photos of the other views are novel views.", least=0,
        most=10**6, filled=True)  # fmt: skip
    random_views: tuple[int, ...] = setting((), "Least and most views of a subset that is drawn for every window, such "
        "as `[1, 12]` in the paper; it replaces `views`. Empty: not used.", least=1, most=10**6)  # fmt: skip
    recolor: bool = setting(False, "Change the colours of every window at random: order of channels, contrast, "
        "negatives.",
        "Few scenes have few colours, and networks would learn these.")  # fmt: skip
    densities: tuple[float, ...] = setting((0.025, 0.044), "Superpixels per pixel; a scene gives an example for each.",
        "There are two by default, since a full fit starts with 57 % of the usual number.", least=1e-6, most=1,
        filled=True)  # fmt: skip
    segmentation: str = setting("rdseg", "Superpixel method.", choices=SEGMENTATIONS)
    match: MatchMethod = setting("overlap", "Merging across views.",
        "The networks' results for a window are matched in every step.")  # fmt: skip
    overlap: float = setting(0.7, "Least overlap of a match by `overlap`.", **SHARE_LIMITS)
    iou: float = setting(0.2, "Least intersection over union of the boxes of a match by `aabb`.", **SHARE_LIMITS)
    similarity: float = setting(0.8, "Least cosine of the latents of a match by `aabb`.", least=-1, most=1)
    levels: tuple[int, ...] = setting(SLOTS, "Numbers of children K whose heads are trained.", choices=SLOTS,
        filled=True, unique=True)  # fmt: skip
    joint: bool = setting(False, "Train the heads of all levels on every window, as in the paper; otherwise the head "
        "of a random level.")  # fmt: skip
    buffer: int = setting(10, "Number of examples that stay in memory. A window is of a random example, which is read "
        "if it is not in memory.", **COUNT_LIMITS)  # fmt: skip
    steps: int = setting(6000, "Steps of the training.", **COUNT_LIMITS)
    warmup: int = setting(200, "Steps over which the learning rate increases.", **FROM_0_LIMITS)
    rate: float = setting(1e-3, "Highest learning rate.", **RATE_LIMITS)
    least_rate: float = setting(1e-5, "Rate at the end of the cosine.", **RATE_LIMITS)
    decay: float = setting(1e-4, "Weight decay (AdamW).", **WEIGHT_LIMITS)
    clip: float = setting(1.0, "Largest norm of the gradient.", **RATE_LIMITS)
    average: float = setting(0.998, "Share of the previous mean in the running mean of the networks' weights, which "
        "is validated and saved; less in the first steps.", **SHARE_LIMITS)  # fmt: skip
    crops: int = setting(2, "Windows per step, computed in parallel.", **COUNT_LIMITS)
    novel: float = setting(0.75, "Share of the windows in novel views, if there are any.", **SHARE_LIMITS)
    photo_scale: int = setting(2, "Factor by which the sides of the photos are divided.", **COUNT_LIMITS)
    photo_side: int = setting(0, "Pixels of the longer side to which larger photos are reduced; it replaces "
        "`photo_scale`. 476 in the paper; 0: not used.", **FROM_0_LIMITS)  # fmt: skip
    window: int = setting(96, "Side of a window of a photo that is rendered, pixels.", least=WINDOW_SIDE, most=10**9)
    most: int = setting(
        4000, "Feature Gaussians that may reach into a window; a window with more is halved.", **COUNT_LIMITS
    )
    photo_loss: str = setting("l1", "Colour loss: `l1` or `mse` (as in the paper).", choices=("l1", "mse"))
    photo_weight: float = setting(0.8, "Weight of the colour loss.", **WEIGHT_LIMITS)
    ssim_weight: float = setting(0.2, "Weight of 1 - SSIM.", **WEIGHT_LIMITS)
    lpips_weight: float = setting(0.0, "Weight of LPIPS (VGG), whose weights must be installed; a step takes twice as "
        "long with it.", **WEIGHT_LIMITS)  # fmt: skip
    lpips_start: float = setting(0.0, "Share of the steps after which LPIPS has its weight.", **SHARE_LIMITS)
    teacher_weight: float = setting(0.0, "Weight of the distance from the moments of the groups (paper eq. "
        "teacher_mean, teacher_cov).", **WEIGHT_LIMITS)  # fmt: skip
    teacher_steps: int = setting(2000, "Steps over which `teacher_weight` falls to 0.", **COUNT_LIMITS)
    diversity_weight: float = setting(0.0, "Weight of the loss that keeps siblings apart. This loss is at most the "
        "weight times the photometric loss.", **WEIGHT_LIMITS)  # fmt: skip
    diversity_steps: int = setting(50_000, "Steps over which `diversity_weight` falls to 0.", **COUNT_LIMITS)
    opacity_shift: float = setting(0.0, "Number that saved heads add to the raw correction of the opacity.",
        "New captures have holes that scenes in training lack.", least=-8, most=8)  # fmt: skip
    save_every: int = setting(200, "Steps between checkpoints, validation and lines of the table.", **COUNT_LIMITS)
    validation_examples: int = setting(24, "Most examples for validation, spread evenly over all examples.",
        **COUNT_LIMITS)  # fmt: skip
    validation_windows: int = setting(
        4, "Windows of each validation example, the same in every validation.", **COUNT_LIMITS
    )
    seed: int = setting(0, "Seed of all random numbers.", **FROM_0_LIMITS)

    def __post_init__(self) -> None:
        """Convert lists to tuples, since JSON and TOML have lists, and check all settings."""
        for name in LIST_OPTIONS:
            object.__setattr__(self, name, tuple(getattr(self, name)))
        super().__post_init__()
        if self.random_views and (len(self.random_views) != 2 or self.random_views[0] > self.random_views[1]):
            raise ValueError(f"random_views: expected the least and the most, got {list(self.random_views)}")

    @property
    def example_views(self) -> tuple[int, ...]:
        """Numbers of views. Each scene gives one example for each of these numbers; 0 stands for all views."""
        return (0,) if self.random_views else self.views

    def match_options(self) -> MatchOptions:
        """Return the options for matching Feature Gaussians across views."""
        names = ("match", "overlap", "iou", "similarity")
        return MatchOptions(**{name: getattr(self, name) for name in names})

    def photo_level(self, width: int, height: int) -> float:
        """Return the factor that divides the sides of photos of ``width`` x ``height`` pixels."""
        return max(1.0, max(width, height) / self.photo_side) if self.photo_side else self.photo_scale

    def require_weights(self) -> None:
        """Raise GsmergeError if LPIPS has a weight in the loss but its network weights are not installed."""
        if self.lpips_weight:
            require_lpips("vgg")

    def lpips_weight_at(self, step: int) -> float:
        """Return the weight of LPIPS in a step, counted from 0."""
        return self.lpips_weight if step >= self.lpips_start * self.steps else 0.0

    def regularizer_weights(self, step: int) -> tuple[float, float]:
        """Return the weights of the teacher and diversity losses in a step, counted from 0."""
        teacher_share, diversity_share = (max(0.0, 1 - step / n) for n in (self.teacher_steps, self.diversity_steps))
        return self.teacher_weight * teacher_share, self.diversity_weight * diversity_share

    def rate_at(self, step: int) -> float:
        """Return the learning rate of a step, counted from 0: linear warm-up, then a half cosine."""
        if step < self.warmup:
            return self.rate * (step + 1) / self.warmup
        part = (step - self.warmup) / max(1, self.steps - self.warmup)
        return self.least_rate + (self.rate - self.least_rate) * (1 + math.cos(math.pi * part)) / 2

    def to_dict(self) -> dict[str, Any]:
        """Convert all settings to plain values."""
        return asdict(self) | {name: list(getattr(self, name)) for name in LIST_OPTIONS}


# Hyperparameters from the paper's table and its sections 4.1, 4.4 and 5.1. Settings that the paper does not state have
# their defaults, except for the densities.
PAPER: Mapping[str, Any] = {
    "outputs": "absolute",
    "merger_start": "first",
    "geometry": "carried",
    "group_numbers": False,
    "members": 256,
    "random_views": (1, 12),
    "densities": (0.053,),
    "segmentation": "bass-st",
    "match": "aabb",
    "iou": 0.2,
    "photo_side": 476,
    "levels": (1, 2, 4),
    "joint": True,
    "window": 476,  # whole photos
    "most": 10**9,
    "steps": 300_000,
    "warmup": 2_000,
    "rate": 5e-5,
    "least_rate": 1e-6,
    "clip": 10.0,
    "photo_loss": "mse",
    "photo_weight": 1.0,
    "ssim_weight": 0.05,
    "lpips_weight": 0.05,
    "teacher_weight": 0.25,
    "teacher_steps": 2_000,
    "diversity_weight": 1.0,
    "diversity_steps": 50_000,
}
# Settings of the shipped networks. These networks have no encoder and no merger, because neither raised the PSNR of
# validation. These networks do not correct colours, because corrections of colour learnt the exposure of the training
# photos. docs/internals/networks.md has the figures.
SHIPPED_TRAINING: Mapping[str, Any] = {
    "encoder": False,
    "merger": False,
    "color": 0.0,  # bound of the corrections of colour
    "recolor": True,
    "views": (3, 0),
    "steps": 2_600,
    "lpips_weight": 0.06,
    "lpips_start": 0.8,
    "opacity_shift": 0.3,
    "photo_scale": 1,  # children of K = 4 are smaller than pixels of photos at half the size
    "window": 128,
    "save_every": 100,
    "validation_windows": 6,
}
# Settings of the paper with fewer steps: training takes one and a half hours on two processor cores.
PAPER_SHIPPED: Mapping[str, Any] = {
    **PAPER,
    "recolor": True,
    "steps": 2_600,
    "warmup": 80,
    "rate": 1e-3,
    "least_rate": 1e-5,
    "clip": 1.0,
    "average": 0.995,
    "lpips_weight": 0.0,
    "window": 192,
    "most": 4000,
    "teacher_steps": 500,
    "diversity_steps": 1_000,
    "save_every": 200,
    "validation_examples": 6,
    "validation_windows": 4,
}
PRESETS: Mapping[str, Mapping[str, Any]] = {
    "default": {}, "shipped": SHIPPED_TRAINING, "paper": PAPER, "paper-shipped": PAPER_SHIPPED,
}  # fmt: skip


def preset_options(name: str) -> TrainOptions:
    """Return the settings of a named preset, or raise ValueError if the name is unknown."""
    if name not in PRESETS:
        raise ValueError(f"preset: expected {' or '.join(PRESETS)}, got {name!r}")
    return TrainOptions().with_settings(PRESETS[name])
