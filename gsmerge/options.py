"""All settings of a run as a user gives them: the stages' options in one place, by flat names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

from gsmerge.budget import BudgetOptions
from gsmerge.facts.partition import BlockOptions
from gsmerge.facts.prepare import PrepareOptions
from gsmerge.fit import FitOptions
from gsmerge.runtime.plugins import METHODS, find_plugins
from gsmerge.stages.clean import CleanOptions
from gsmerge.stages.decode import MIXED, DecodeOptions
from gsmerge.stages.match import MatchOptions
from gsmerge.stages.superpixels import SegmentOptions

OURS = "gsmerge"  # the method that is no plugin
EFFORTS = ("draft", "fast", "default", "best")  # what each means: gsmerge.plan
DEVICES = ("cpu", "cuda", "auto")
CHECKPOINTS = ("auto", "shipped", "paper", "none")  # names that are no files
# Settings under one name; what is set besides goes before. "paper": the superpixel merging paper's own chain: BASS from
# saliency seeds, networks whose outputs are absolute, matching by latents and boxes of the decoded geometry, no fit.
RECIPES: Mapping[str, Mapping[str, Any]] = {
    "paper": {
        "segmentation": "bass-st", "match": "aabb", "geometry": "decoded", "fit": "none",
        "k_low": 100 / 3, "k_high": 200 / 3, "checkpoint": "paper", "require_checkpoint": True,
    },
}  # fmt: skip


def method_names() -> tuple[str, ...]:
    """Return the names of all methods: ours, and those that installed packages add."""
    return (OURS, *find_plugins(METHODS))


def setting_names(options: type) -> list[str]:
    """Return the names of the fields of an options class that a user may set."""
    return [f.name for f in fields(options) if f.metadata.get("setting", True)]


@dataclass(frozen=True)
class CompactOptions:
    """Every setting of :func:`gsmerge.compact`, stage by stage.

    Args:
        prepare: What may be changed before anything is merged.
        segment: Superpixels.
        match: Merging across views.
        decode: Gaussians per group.
        fit: Fit to the photos.
        clean: What is left out of the result.
        budget: What decides the number of Gaussians.
        blocks: Parts in which scenes of many views are compacted.
        method: ``"gsmerge"``: the stages above. Any other: one that a package adds by an entry point, see
            :class:`gsmerge.compaction.methods.Method`, for which the number of Gaussians has to be settled beforehand.
        effort: ``"draft"``, ``"fast"``, ``"default"`` or ``"best"``: how much work goes into superpixels, merging and
            fit, as far as their own settings leave it open.
        device: Where the fit and the scores run: ``"cpu"``; ``"cuda"``, which draws with gsplat, whose sums have no
            fixed order, so that runs differ in the last bits; ``"auto"``: CUDA where it can be used and the scene is
            large enough that it pays.
        checkpoint: Trained networks that correct what the analytic stages make: a file, or ``"shipped"``, those that
            come with the package; ``"paper"``: those with absolute outputs; ``"none"``: the analytic stages alone;
            ``"auto"``: the shipped ones where no fit follows or a short one, unless the analytic start shows the views
            better; of these, a draft or a fast run without a fit takes the decoder heads alone, one with a fit none.
        recipe: Name of settings that belong together, which :meth:`with_settings` sets: ``"paper"``, the paper's own
            method, with networks of absolute outputs; None: none.
        require_checkpoint: A checkpoint that cannot be used is an error, instead of a note and the analytic stages.
        seed: Everything random depends on it alone; on the CPU, runs with one seed are bit-identical.
        threads: Threads to use; None: all processors. The result does not depend on it.

    Raises:
        ValueError: If a PSNR is asked for of a crop, or without the sky; if a name is unknown, or another method than
            ``"gsmerge"`` is asked to find the number of Gaussians; if a checkpoint is required and none is named.
    """

    prepare: PrepareOptions = field(default_factory=PrepareOptions)
    segment: SegmentOptions = field(default_factory=SegmentOptions)
    match: MatchOptions = field(default_factory=MatchOptions)
    decode: DecodeOptions = field(default_factory=DecodeOptions)
    fit: FitOptions = field(default_factory=FitOptions)
    clean: CleanOptions = field(default_factory=CleanOptions)
    budget: BudgetOptions = field(default_factory=BudgetOptions)
    blocks: BlockOptions = field(default_factory=BlockOptions)
    method: str = "gsmerge"
    effort: str = "default"
    device: str = "cpu"
    checkpoint: str = "auto"
    recipe: str | None = None
    require_checkpoint: bool = False
    seed: int = 0
    threads: int | None = None

    def __post_init__(self) -> None:
        methods = (OURS,) if self.method == OURS else method_names()
        for name, known in (("method", methods), ("effort", EFFORTS), ("device", DEVICES)):
            if getattr(self, name) not in known:
                raise ValueError(f"{name}: expected one of {', '.join(known)}, got {getattr(self, name)!r}")
        if self.recipe not in (None, *RECIPES):
            raise ValueError(f"recipe: expected {', '.join(RECIPES)}, got {self.recipe!r}")
        if self.recipe == "paper" and self.checkpoint in ("auto", "none"):
            raise ValueError(f'recipe paper: expected a checkpoint with absolute outputs, got "{self.checkpoint}"')
        if self.require_checkpoint and self.checkpoint == "none":
            raise ValueError('require_checkpoint: expected a checkpoint, got "none"')
        for name, wanted in {"crop": self.clean.crop is not None, "drop_sky": self.clean.drop_sky}.items():
            if wanted and self.budget.target_psnr is not None:
                quality = f"quality {self.budget.quality}"
                raise ValueError(
                    f"{name}: expected a budget or superpixels, got {quality}: photos show what it leaves out"
                )
        if self.method == "gsmerge":
            return
        asked = {"budget auto": self.budget.auto, "levels": self.budget.levels > 1}
        asked |= {f"quality {self.budget.quality}": self.budget.quality is not None}
        for name in (name for name, wanted in asked.items() if wanted):
            raise ValueError(f"method {self.method}: expected a budget or superpixels, got {name}")

    @property
    def whole_only(self) -> list[str]:
        """Names of the settings in use that need a scene in one piece."""
        budget = self.budget
        asked = {f"method {self.method}": self.method != "gsmerge", "levels": budget.levels > 1}
        asked |= {f"quality {budget.quality}": budget.quality is not None, "crop": self.clean.crop is not None}
        asked |= {"drop_floaters": self.clean.drop_floaters, "drop_sky": self.clean.drop_sky}
        return [name for name, wanted in asked.items() if wanted]

    @property
    def compact_only(self) -> list[str]:
        """Names of the settings in use that ``encode`` and ``extend`` cannot honour."""
        asked = {"k mixed": self.decode.k == MIXED, f"blocks {self.blocks.blocks}": isinstance(self.blocks.blocks, int)}
        return [*self.whole_only, *(name for name, wanted in asked.items() if wanted)]

    def to_dict(self) -> dict[str, Any]:
        """Return all settings by their flat names, as plain values."""
        flat: dict[str, Any] = {}
        for f in fields(self):
            value = getattr(self, f.name)
            names = setting_names(type(value)) if is_dataclass(value) else []
            flat.update({name: getattr(value, name) for name in names} if names else {f.name: value})
        return flat

    def with_settings(self, settings: Mapping[str, Any]) -> CompactOptions:
        """Change settings by flat name (``k=2``), on top of a recipe's; raise ValueError for unknown names."""
        changes: dict[str, Any] = {}
        settings = {**RECIPES.get(str(settings.get("recipe")), {}), **settings}
        for f in fields(self):
            value = getattr(self, f.name)
            if is_dataclass(value) and not isinstance(value, type):
                names = setting_names(type(value))
                changes[f.name] = replace(value, **{name: settings[name] for name in names if name in settings})
            elif f.name in settings:
                changes[f.name] = settings[f.name]
        unknown = sorted(settings.keys() - self.to_dict().keys())
        if unknown:
            raise ValueError(f"unknown setting {unknown[0]!r}; known: {', '.join(sorted(self.to_dict()))}")
        return replace(self, **changes)
