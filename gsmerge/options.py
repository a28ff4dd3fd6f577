"""All settings of a run: the stages' options in one place, by flat names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from typing import Any

from gsmerge.budget import BudgetOptions
from gsmerge.stages.assign import ContributionOptions
from gsmerge.stages.backing import BackingOptions
from gsmerge.stages.choose_merge import RobustOptions, photos_choose
from gsmerge.stages.clean import CleanOptions
from gsmerge.stages.decode import MIXED, DecodeOptions
from gsmerge.stages.encode import EncodeOptions
from gsmerge.stages.fit import FitOptions
from gsmerge.stages.match import MatchOptions
from gsmerge.stages.region_tree import AllocateOptions
from gsmerge.stages.segment import SegmentOptions

METHODS = (
    "gsmerge", "unmerged", "unmerged-color", "unmerged-fit", "moment-matching", "voxel", "opacity", "contribution",
    "random", "blocks", "greedy", "splat-transform",
)  # fmt: skip

CHECKPOINTS = ("auto", "shipped", "paper", "none")  # names that are no files
# Settings under one name; what is set besides goes before. "paper": the superpixel merging paper's own chain: BASS from
# saliency seeds, networks whose outputs are absolute, matching by latents and boxes of the decoded geometry, no fit.
RECIPES: Mapping[str, Mapping[str, Any]] = {
    "paper": {
        "segmentation": "bass-st", "match": "aabb", "geometry": "decoded", "robust": False, "fit": "none",
        "k_low": 100 / 3, "k_high": 200 / 3, "checkpoint": "paper", "require_checkpoint": True,
    },
}  # fmt: skip
AUTO_STEPS = 2  # times the usual ones
SHORT_STEPS = 60  # of a fit that a better start still matters to


@dataclass(frozen=True)
class CompactOptions:
    """Every setting of :func:`gsmerge.compact`, stage by stage.

    Args:
        segment: Superpixels.
        allocate: How a budget is spread over the views.
        contribution: Gaussians that are not one per pixel.
        encode: How a group becomes one Gaussian.
        robust: Choice among merges by the photos.
        backing: The coarse layer that the choice may add.
        match: Merging across views.
        decode: Gaussians per group.
        fit: Fit to the photos.
        clean: What is left out of the result.
        budget: What decides the number of Gaussians.
        method: ``"gsmerge"``: the stages above. Any other: a baseline, see :mod:`gsmerge.baselines`, for which
            the number of Gaussians has to be settled beforehand.
        checkpoint: Trained networks that correct what the analytic stages make: a file, or ``"shipped"``, those that
            come with the package; ``"paper"``: those with absolute outputs; ``"none"``: the analytic stages alone;
            ``"auto"``: the shipped ones, unless the analytic start shows the views better, see :meth:`networks`.
        recipe: Name of settings that belong together, which :meth:`with_settings` sets: ``"paper"``, the paper's own
            method, with networks of absolute outputs; None: none.
        require_checkpoint: A checkpoint that cannot be used is an error, instead of a note and the analytic stages.
        seed: Everything random depends on it alone; on the CPU, runs with one seed are bit-identical.
        threads: Threads to use; None: all processors. The result does not depend on it.

    Raises:
        ValueError: If a PSNR is asked for of a crop, or without the sky; if the method is unknown, or another than
            ``"gsmerge"`` is asked to find the number of Gaussians; if a checkpoint is required and none is named.
    """

    segment: SegmentOptions = field(default_factory=SegmentOptions)
    allocate: AllocateOptions = field(default_factory=AllocateOptions)
    contribution: ContributionOptions = field(default_factory=ContributionOptions)
    encode: EncodeOptions = field(default_factory=EncodeOptions)
    robust: RobustOptions = field(default_factory=RobustOptions)
    backing: BackingOptions = field(default_factory=BackingOptions)
    match: MatchOptions = field(default_factory=MatchOptions)
    decode: DecodeOptions = field(default_factory=DecodeOptions)
    fit: FitOptions = field(default_factory=FitOptions)
    clean: CleanOptions = field(default_factory=CleanOptions)
    budget: BudgetOptions = field(default_factory=BudgetOptions)
    method: str = "gsmerge"
    checkpoint: str = "auto"
    recipe: str | None = None
    require_checkpoint: bool = False
    seed: int = 0
    threads: int | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {self.method!r}")
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

    def networks(self, *, photos: bool, aligned: bool = True) -> str:
        """The checkpoint to load: as asked, or the shipped one where it improves results (docs/internals/networks.md).

        That is where no fit follows, or a short one; not where time counts most (drafts, fast runs).

        Args:
            photos: Whether there are any to fit to.
            aligned: Whether there is one Gaussian per pixel, which is what the shipped networks learnt from.
        """
        if self.checkpoint != "auto":
            return self.checkpoint
        if not aligned:
            return "none"
        short = not photos or self.fit.fit == "none" or (self.fit.fit == "full" and self.fit.steps <= SHORT_STEPS)
        hasty = self.fit.effort in ("draft", "fast")
        return "shipped" if short and not hasty and not self.robust.robust and self.encode.rule == "depth" else "none"

    def resolved(self, *, photos: bool) -> dict[str, Any]:
        """As :meth:`to_dict`, with the checkpoint and the matching that are used where nothing else was asked for."""
        robust = photos_choose(self.robust.robust, self.fit.fit, self.fit.effort)
        return self.to_dict() | {
            "checkpoint": self.networks(photos=photos),
            "match": self.match.method,
            "robust": robust,
        }

    def with_auto_steps(self) -> CompactOptions:
        """With ``budget="auto"`` twice the steps, unless given: fewer Gaussians cost less, and need them for detail."""
        if not self.budget.auto or self.fit.fit_steps is not None:
            return self
        return replace(self, fit=replace(self.fit, fit_steps=AUTO_STEPS * self.fit.steps))

    def with_chosen_device(self, num_gaussians: int) -> CompactOptions:
        """With ``device="auto"`` settled for a scene of this size."""
        if self.fit.device != "auto":
            return self
        from gsmerge.render.cuda import chosen_device

        return replace(self, fit=replace(self.fit, device=chosen_device("auto", num_gaussians)))

    @property
    def needs_tree(self) -> bool:
        """Whether the number of Gaussians is searched for, or further levels of detail are cut."""
        return self.budget.quality is not None or self.budget.auto or self.budget.levels > 1

    @property
    def whole_only(self) -> list[str]:
        """What is asked for that only a whole scene, compacted at once, can have."""
        budget = self.budget
        asked = {f"method {self.method}": self.method != "gsmerge", "levels": budget.levels > 1}
        asked |= {f"quality {budget.quality}": budget.quality is not None, "k mixed": self.decode.k == MIXED}
        asked |= {"crop": self.clean.crop is not None, "drop_floaters": self.clean.drop_floaters}
        asked |= {"drop_sky": self.clean.drop_sky}
        return [name for name, wanted in asked.items() if wanted]

    def to_dict(self) -> dict[str, Any]:
        """All settings by their flat names, as plain values."""
        flat: dict[str, Any] = {}
        for f in fields(self):
            value = getattr(self, f.name)
            flat.update(asdict(value) if is_dataclass(value) and not isinstance(value, type) else {f.name: value})
        return flat

    def with_settings(self, settings: Mapping[str, Any]) -> CompactOptions:
        """The options with some settings changed, by flat name (``k=2, superpixels="1%"``).

        A name that several stages share, such as ``effort``, is changed in all of them. A recipe changes all that
        belongs to it, but for what is set here besides.

        Raises:
            ValueError: If a name is unknown.
        """
        changes: dict[str, Any] = {}
        settings = {**RECIPES.get(str(settings.get("recipe")), {}), **settings}
        for f in fields(self):
            value = getattr(self, f.name)
            if is_dataclass(value) and not isinstance(value, type):
                changes[f.name] = replace(
                    value, **{g.name: settings[g.name] for g in fields(value) if g.name in settings}
                )
            elif f.name in settings:
                changes[f.name] = settings[f.name]
        unknown = sorted(settings.keys() - self.to_dict().keys())
        if unknown:
            raise ValueError(f"unknown setting {unknown[0]!r}; known: {', '.join(sorted(self.to_dict()))}")
        return replace(self, **changes)
