"""All settings of a run as a user gives them: the stages' settings in one place, by flat names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from gsmerge.runtime import MOST_THREADS
from gsmerge.runtime.plugins import METHODS, find_plugins
from gsmerge.settings.budget import BudgetOptions
from gsmerge.settings.fit import FitOptions
from gsmerge.settings.reading import OF_SCENE
from gsmerge.settings.setting import Setting, Settings, change_settings, flat_settings, perhaps, setting, settings_of
from gsmerge.settings.stages import (
    BlockOptions,
    CleanOptions,
    DecodeOptions,
    MatchOptions,
    PrepareOptions,
    SegmentOptions,
)

OURS = "gsmerge"  # the method that is no plugin
EFFORT_NAMES = ("draft", "fast", "default", "best")  # what each means: gsmerge.plan
CHECKPOINTS = ("auto", "shipped", "paper", "none")  # names that are no files
# Settings under one name; what is set besides goes before. "paper": the superpixel merging paper's own chain: 12,000
# superpixels of 476 x 476 pixels by BASS from saliency seeds, networks whose outputs are absolute, matching by latents
# and boxes, no fit, and no pruning but by opacity.
RECIPES: Mapping[str, Mapping[str, Any]] = {
    "paper": {
        "superpixels": "5.3%", "segmentation": "bass-st", "match": "aabb", "fit": "none", "min_contribution": 0.0,
        "k_low": 100 / 3, "k_high": 200 / 3, "checkpoint": "paper", "require_checkpoint": True,
    },
}  # fmt: skip


def method_names() -> tuple[str, ...]:
    """Return the names of all methods: ours, and those of installed plugins."""
    return (OURS, *find_plugins(METHODS))


@dataclass(frozen=True)
class CompactOptions(Settings):
    """Every setting of :func:`gsmerge.compact`, stage by stage.

    Raises ValueError also for settings that exclude each other: a PSNR target with a crop or without the sky, a method
    other than ``"gsmerge"`` that is to find the number of Gaussians, or a required checkpoint that is not named.

    Example:
        >>> options = gsmerge.CompactOptions().with_settings({"k": 2, "effort": "draft"})
        >>> options.decode.k, options.to_dict()["effort"]
        (2, 'draft')
    """

    prepare: PrepareOptions = setting(
        PrepareOptions(), "What may be changed before anything is merged.", acts_on="views"
    )
    segment: SegmentOptions = setting(SegmentOptions(), "Superpixels.", acts_on="superpixels")
    match: MatchOptions = setting(MatchOptions(), "Merging across views.", acts_on="superpixels")
    decode: DecodeOptions = setting(DecodeOptions(), "Gaussians per group.", acts_on="superpixels")
    fit: FitOptions = setting(FitOptions(), "Fit to the photos.")
    clean: CleanOptions = setting(CleanOptions(), "What is left out of the result.")
    budget: BudgetOptions = setting(BudgetOptions(), "What decides the number of Gaussians.")
    blocks: BlockOptions = setting(BlockOptions(), "Parts in which scenes of many views are compacted.")
    method: str = setting(OURS, "gsmerge, or a baseline to compare it with, such as voxel or contribution.",
        "All but `gsmerge` need a number of Gaussians.", choices=method_names, metavar="NAME", common=True,
        whole="value", replaces=True)  # fmt: skip
    effort: str = setting("default", "Quality for time: best is sharper and takes two to three times as "
        "long; fast and draft take less than half.",
        "It decides what their own settings leave open.", choices=EFFORT_NAMES)  # fmt: skip
    checkpoint: str = setting("auto", "Trained networks that correct the analytic stages: a file, shipped, paper, "
        "none, or auto: the shipped networks where they improve the result.",
        "They do if no fit follows; a draft or a fast run uses only their decoder heads.",
        metavar="FILE|NAME", neutral=("none",), replaces=True)  # fmt: skip
    recipe: str | None = setting(None, "Settings that belong together. paper: the superpixel merging paper's own "
        "method, with networks that have absolute outputs.", choices=tuple(RECIPES), in_trial=None,
        replaces=True)  # fmt: skip
    require_checkpoint: bool = setting(False, "A checkpoint that cannot be used is an error, instead of a note and the "
        "analytic stages.")  # fmt: skip
    new_views: bool | None = setting(None, "Estimate what a new viewpoint gains, from photos that a short fit leaves "
        "out.", "By default where at least four views have photos, but not in a draft or without a fit.",
        in_piece=False)  # fmt: skip
    seed: int = setting(0, "Seed of all random numbers.",
        "Runs with one seed are bit-identical.", least=0, common=True)  # fmt: skip
    threads: int | None = setting(None, "Threads; the result does not depend on their number.", least=1,
        most=MOST_THREADS, shown="all processors", common=True)  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.recipe == "paper" and self.checkpoint in ("auto", "none"):
            raise ValueError(f'recipe paper: expected a checkpoint with absolute outputs, got "{self.checkpoint}"')
        if self.require_checkpoint and self.checkpoint == "none":
            raise ValueError('require_checkpoint: expected a checkpoint, got "none"')
        for name in self.clean.hiding if self.budget.target_psnr is not None else ():
            quality = f"quality {self.budget.quality}"
            raise ValueError(f"{name}: expected a budget or superpixels, got {quality}: photos show what it leaves out")
        for name in self.budget.searching if self.method != OURS else ():
            raise ValueError(f"method {self.method}: expected a budget or superpixels, got {name}")

    @property
    def changed_counts(self) -> list[str]:
        """Names of the settings in use that say how many Gaussians there may be."""
        return changed_settings(self, lambda one: one.counts)

    @property
    def decides_count(self) -> bool:
        """Whether settings decide how many Gaussians there are, and not the scene."""
        return self.budget.quality is not None or bool(decided_settings(self, lambda one: one.counts))

    @property
    def replaces_stages(self) -> bool:
        """Whether a method, networks or a recipe take the place of the stages' own formulas."""
        return bool(decided_settings(self, lambda one: one.replaces))

    @property
    def changes_superpixels(self) -> bool:
        """Whether settings say how superpixels are cut, merged and decoded, other than how many there are."""
        return bool(changed_settings(self, lambda one: one.acts_on == "superpixels" and not one.counts))

    @property
    def whole_only(self) -> list[str]:
        """Names of the settings in use that require the scene in one piece."""
        values, names = self.to_dict(), changed_settings(self, lambda one: one.whole == "name")
        for name in changed_settings(self, lambda one: one.whole == "value"):
            names += [f"{name} {part.strip()}" for part in str(values[name]).split(",")]
        return names

    @property
    def uncut(self) -> list[str]:
        """Names of the settings in use that keep a scene in one piece, while views of it may still come in batches."""
        values, declared = self.to_dict(), flat_settings(CompactOptions)
        return [f"{name} {values[name]}" for name, one in declared.items() if values[name] in one.uncut]

    @property
    def compact_only(self) -> list[str]:
        """Names of the settings in use that Feature Gaussians of ``extend`` cannot honour."""
        return [*self.whole_only, *self.blocks.asked]

    def to_dict(self) -> dict[str, Any]:
        """Return all settings by their flat names, as plain values."""
        flat: dict[str, Any] = {}
        for name, declared in settings_of(CompactOptions).items():
            value = getattr(self, name)
            names = flat_settings(declared.kind) if declared.is_group else ()
            flat |= {inner: getattr(value, inner) for inner in names} or {name: value}
        return flat

    def with_settings(self, settings: Mapping[str, Any]) -> CompactOptions:
        """Change settings by flat name (``k=2``), on top of a recipe's; raise ValueError for unknown names."""
        all_settings = flat_settings(CompactOptions)
        unknown = sorted(settings.keys() - all_settings.keys())
        if unknown:
            near = perhaps(unknown[0], all_settings)
            if unknown[0] in OF_SCENE:
                near = f": read_scene(path, {unknown[0]}=...) takes it"
            known = "" if near else f"; known: {', '.join(sorted(all_settings))}"
            raise ValueError(f"unknown setting {unknown[0]!r}{near or known}")
        return change_settings(self, {**RECIPES.get(str(settings.get("recipe")), {}), **settings})


def changed_settings(options: CompactOptions, is_one: Callable[[Setting], Any]) -> list[str]:
    """Return the flat names of settings with a declaration as asked for whose values are not the defaults."""
    values, declared = options.to_dict(), flat_settings(CompactOptions)
    return [name for name, one in declared.items() if is_one(one) and values[name] != one.default]


def decided_settings(options: CompactOptions, is_one: Callable[[Setting], Any]) -> list[str]:
    """Return those of the changed settings whose values are not neutral: they leave less to the scene."""
    values, declared = options.to_dict(), flat_settings(CompactOptions)
    return [name for name in changed_settings(options, is_one) if values[name] not in declared[name].neutral]
