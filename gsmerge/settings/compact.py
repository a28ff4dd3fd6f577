"""Declare all settings of a run.

Settings are grouped by stage. Users give each setting by its flat name, which is its name without the group.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from gsmerge.frozen import dataclass
from gsmerge.runtime import MOST_THREADS
from gsmerge.runtime.plugins import METHODS, find_plugins
from gsmerge.settings.budget import AUTO, BudgetOptions
from gsmerge.settings.fit import FitOptions
from gsmerge.settings.reading import SCENE_ARGUMENTS
from gsmerge.settings.setting import SYNONYMS, Settings, flat_settings, setting, settings_of, suggest_name
from gsmerge.settings.stages import (
    BlockOptions,
    CleanOptions,
    DecodeOptions,
    MatchOptions,
    PrepareOptions,
    SegmentOptions,
)

OURS = "gsmerge"  # name of the built-in method; all others are plugins
EFFORT_NAMES = ("draft", "fast", "default", "best")  # gsmerge.plan.efforts.EFFORTS has the settings of each
CHECKPOINTS = ("auto", "shipped", "paper", "none")  # values of `checkpoint` that are not paths of files
# A recipe stands for several settings. Settings that a user also gives take precedence. "paper" is the method of the
# superpixel merging paper: this recipe cuts 476 x 476 pixels into 12,000 superpixels by BASS, from saliency seeds. The
# recipe "paper" uses networks with absolute outputs, matches by latents and boxes, does not fit, and prunes by opacity
# only
RECIPES: Mapping[str, Mapping[str, Any]] = {
    "paper": {
        "superpixels": "5.3%", "segmentation": "bass-st", "match": "aabb", "fit": "none", "min_contribution": 0.0,
        "k_low": 100 / 3, "k_high": 200 / 3, "checkpoint": "paper", "require_checkpoint": True,
    },
}  # fmt: skip
# Settings that decide the number of Gaussians
COUNTS = ("superpixels", "k", "budget")
# Settings of a run on a part of a scene, such as a block of views. With their usual values, these settings would need
# the whole scene
ONE_PIECE: dict[str, Any] = {"poses": "fixed", "exposure": "fixed", "blocks": "none", "new_views": False}
# Settings of a trial, which is a short run on some of the views
TRIAL: dict[str, Any] = {
    **ONE_PIECE, "budget": None, "quality": None, "levels": 1, "crop": None, "drop": None,
    "photo_scale": 1.0, "recipe": None,
}  # fmt: skip


def method_names() -> tuple[str, ...]:
    """Return the names of all methods: the built-in method, and the methods of installed plugins."""
    return (OURS, *find_plugins(METHODS))


@dataclass(frozen=True)
class CompactOptions(Settings):
    """Every setting of :func:`gsmerge.compact`, stage by stage.

    Settings that contradict each other raise ValueError, such as a PSNR target with ``drop="sky"``, or a search for the
    number of Gaussians with a method other than ``"gsmerge"``.

    Example:
        >>> options = gsmerge.CompactOptions().with_settings({"k": 2, "effort": "draft"})
        >>> options.decode.k, options.to_dict()["effort"]
        (2, 'draft')
    """

    prepare: PrepareOptions = setting(PrepareOptions(), "What may be changed before merging.")
    segment: SegmentOptions = setting(SegmentOptions(), "Superpixels.")
    match: MatchOptions = setting(MatchOptions(), "Merging across views.")
    decode: DecodeOptions = setting(DecodeOptions(), "Gaussians per group.")
    fit: FitOptions = setting(FitOptions(), "Fit to the photos.")
    clean: CleanOptions = setting(CleanOptions(), "Gaussians to leave out of the result.")
    budget: BudgetOptions = setting(BudgetOptions(), "Number of Gaussians.")
    blocks: BlockOptions = setting(BlockOptions(), "Blocks of views, for scenes of many views.")
    method: str = setting(OURS, "Method: gsmerge, or a baseline to compare it with, such as greedy or random.",
        "Baselines need a number of Gaussians.", choices=method_names)  # fmt: skip
    effort: str = setting("default", "Trade time for quality: best is sharper and takes two to three times as "
        "long; fast and draft take less than half.",
        "It sets the defaults of other settings, such as `fit_steps`.", choices=EFFORT_NAMES)  # fmt: skip
    checkpoint: str = setting("auto", "Trained networks that correct the analytic stages: a file, shipped, paper, "
        "none, or auto, which uses the shipped networks where they improve the result.",
        "They improve it if no fit follows, and if there are photos or one Gaussian per pixel. A draft or a fast run "
        "uses only their decoder heads.")  # fmt: skip
    recipe: str | None = setting(None, "A set of settings under one name. paper: the method of the superpixel merging "
        "paper, with networks that have absolute outputs.", choices=tuple(RECIPES))  # fmt: skip
    require_checkpoint: bool = setting(False, "Fail if the checkpoint cannot be used, instead of continuing without "
        "networks and with a note.")  # fmt: skip
    new_views: bool | None = setting(None, "Estimate the quality of new views, on photos that a short fit holds out.",
        "By default if at least four views have photos, but not in a draft or without a fit.")  # fmt: skip
    seed: int = setting(0, "Seed of all random numbers.",
        "Runs with the same seed are bit-identical.", least=0)  # fmt: skip
    threads: int | None = setting(None, "Number of threads; the result does not depend on it.", least=1,
        most=MOST_THREADS)  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.recipe == "paper" and self.checkpoint in ("auto", "none"):
            raise ValueError(f'recipe paper: expected a checkpoint with absolute outputs, got "{self.checkpoint}"')
        if self.require_checkpoint and self.checkpoint == "none":
            raise ValueError('require_checkpoint: expected a checkpoint, got "none"')
        if self.budget.target_psnr is not None and self.clean.visible_drops:
            problem = f"expected a budget or superpixels, got quality {self.budget.quality}"
            raise ValueError(f"{self.clean.visible_drops[0]}: {problem}; photos show what it removes")
        if self.method != OURS and (names := self.budget.search_names):
            raise ValueError(f"method {self.method}: expected a budget or superpixels, got {names[0]}")

    @property
    def changed_counts(self) -> list[str]:
        """Names of the settings that limit the number of Gaussians and differ from their defaults."""
        return self.changed(COUNTS)

    @property
    def scene_decides(self) -> bool:
        """True if no setting decides the number of Gaussians, so that a run may choose it for the scene.

        Also False if settings replace the usual stages, because other stages seldom keep the quality of the input.
        """
        deciding = [name for name in self.changed_counts if name != "budget" or not self.budget.leaves_open]
        return not (deciding or self.budget.quality is not None or self.replaces_stages)

    @property
    def replaces_stages(self) -> bool:
        """True if another method, networks or a recipe replace the usual computations of stages."""
        return self.method != OURS or self.checkpoint not in ("auto", "none") or self.recipe is not None

    @property
    def changes_superpixels(self) -> bool:
        """True if any setting changes how superpixels are cut, merged or decoded.

        The number of superpixels does not count.
        """
        kinds = (SegmentOptions, MatchOptions, DecodeOptions)
        return bool(self.changed([name for kind in kinds for name in flat_settings(kind) if name not in COUNTS]))

    @property
    def whole_only(self) -> list[str]:
        """Names of the settings in use that need the whole scene in one piece."""
        drops = [f"drop {name}" for name in self.clean.drops]
        quality = [] if self.budget.quality is None else [f"quality {self.budget.quality}"]
        method = [] if self.method == OURS else [f"method {self.method}"]
        return [*self.changed(("crop", "levels")), *drops, *quality, *method]

    @property
    def uncut(self) -> list[str]:
        """Names of the settings in use that are not possible in blocks of views.

        Some of these settings are possible for views that arrive in batches, see :attr:`compact_only`.
        """
        values = self.to_dict()
        excluded = {"poses": "free", "exposure": "per-photo", "budget": AUTO}
        return [*self.whole_only, *(f"{name} {value}" for name, value in excluded.items() if values[name] == value)]

    @property
    def compact_only(self) -> list[str]:
        """Names of the settings in use that ``extend`` cannot apply, because a state has only Feature Gaussians."""
        return [*self.whole_only, *self.blocks.asked]

    def changed(self, names: Iterable[str]) -> list[str]:
        """Return those ``names`` of settings whose values differ from the defaults; all names are flat."""
        values = self.to_dict()
        declared = flat_settings(CompactOptions)
        return [name for name in names if values[name] != declared[name].default]

    def to_dict(self) -> dict[str, Any]:
        """Return the values of all settings by flat name."""
        values: dict[str, Any] = {}
        for name, declared in settings_of(CompactOptions).items():
            value = getattr(self, name)
            inner_names = flat_settings(declared.kind) if declared.is_group else ()
            values |= {inner_name: getattr(value, inner_name) for inner_name in inner_names} or {name: value}
        return values

    def with_settings(self, settings: Mapping[str, Any]) -> CompactOptions:
        """Return options with other ``settings``, by flat name; ValueError for an unknown name.

        If ``recipe`` is among the ``settings``, the settings of the recipe are changed first.
        """
        if not isinstance(settings, Mapping):
            raise TypeError(f"settings: expected a dictionary of values by name, got {type(settings).__name__}")
        all_settings = flat_settings(CompactOptions)
        unknown = sorted(settings.keys() - all_settings.keys(), key=str)
        if unknown:
            meant = SYNONYMS.get(unknown[0], unknown[0])
            hint = f"; perhaps {meant}" if meant in all_settings else suggest_name(unknown[0], all_settings)
            if meant in SCENE_ARGUMENTS:
                hint = f": read_scene(path, {meant}=...) takes it"
            if meant in ("output", "overwrite"):
                hint = ": result.save(path) writes the result, in the format of the ending"
            known = f"; known: {', '.join(sorted(all_settings))}"
            raise ValueError(f"unknown setting {unknown[0]!r}{hint or known}")
        return super().with_settings({**RECIPES.get(str(settings.get("recipe")), {}), **settings})
