"""A plan: all decisions about a run, made before the first superpixel is cut.

It has four parts: how many Gaussians, how they are merged, how they are fitted, and what is scored. Each stage takes
its own part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.fit import Fitted
from gsmerge.method.stages.limits import CountLimits
from gsmerge.method.stages.pair_merge import POWERS
from gsmerge.method.stages.segment import SuperpixelChoices
from gsmerge.settings.fit import FitOptions
from gsmerge.settings.stages import CleanOptions, DecodeOptions, MatchOptions
from gsmerge.types import Cameras, Gaussians

if TYPE_CHECKING:
    from gsmerge.method.networks.checkpoint import Checkpoint
    from gsmerge.method.networks.weights import NetworkWeights
    from gsmerge.method.raster.photos import PhotoScore


@dataclass(frozen=True)
class FileSize:
    """Largest size of the output in bytes."""

    num_bytes: int
    ending: str  # Of the output's name, which is that of its format
    packed: bool  # The size depends on the content, so that the file has to be made to measure it
    # Returns the bytes of a file with Gaussians, cameras, and names of these, or an upper bound if it is a page
    measure: Callable[[Gaussians, Cameras, Sequence[str]], int]
    # How many Gaussians fit without harmonics above degree 0; None if the scene has none
    count_without_harmonics: int | None = None


@dataclass(frozen=True, eq=False)
class CountPlan:
    """How many Gaussians a result has."""

    limits: CountLimits  # Limits of the number of Gaussians
    target_psnr: float | None  # PSNR (dB) that the result has to reach; None: no target, or not known yet
    keeps_fidelity: bool  # See :func:`gsmerge.plan.counts.keeps_fidelity`
    max_drop: float | None  # Allowed loss in dB against the best of the curve; None: no target
    auto_count: bool  # The scene's own curve decides the number of Gaussians
    levels: int  # Levels of detail
    file_size: FileSize | None = None  # Largest size of the output's file; None: any

    @property
    def has_quality(self) -> bool:
        """Return whether a quality or the scene's curve decides the number of Gaussians."""
        return self.target_psnr is not None or self.max_drop is not None or self.auto_count or self.keeps_fidelity


@dataclass(frozen=True, eq=False)
class MergePlan:
    """How views are cut into superpixels, merged, and decoded."""

    superpixels: SuperpixelChoices  # How each view is cut
    match: MatchOptions  # Merging across views
    decode: DecodeOptions  # Gaussians per group
    checkpoint: Checkpoint | None = None  # Networks, from a file; None: closed formulas alone
    power: float = POWERS[0]  # Power of the masses by which pairs are merged

    @property
    def networks(self) -> NetworkWeights | None:
        """Networks that correct the results of the stages; None: closed formulas."""
        return None if self.checkpoint is None else self.checkpoint.networks

    @property
    def network_facts(self) -> dict[str, Any]:
        """Facts about the networks that a report has, by name; empty without networks."""
        return {} if self.checkpoint is None else {"networks": self.checkpoint.facts()}

    @property
    def by_contribution(self) -> bool:
        """Return whether blending weights decide to which superpixel a Gaussian belongs, as in the paper."""
        return self.networks is not None and self.networks.options.makes_children

    @property
    def weakens(self) -> bool:
        """Return whether a group starts with less opacity if other views see surfaces behind it.

        The lower opacity may leave holes, which a long fit closes.
        """
        return self.superpixels.start_share < 1 and self.checkpoint is None


@dataclass(frozen=True, eq=False)
class ScorePlan:
    """In which views, and over which pixels, the input and its results are scored."""

    output: str  # Name of the output's file, whose format may round values; "": no file
    new_views: bool  # Estimate the quality of new views
    views: tuple[int, ...] = ()  # Ids of the views in which input and result are scored
    samples: bool = False  # Only a sample of the pixels is scored, because only the report needs the scores
    before: PhotoScore | None = None  # Score of the input, if the result has to keep its quality on photos
    # [h,w] bool for each scored view: the pixels that the input covers, if it leaves gaps and its renders stand for
    # photos
    covered: tuple[np.ndarray, ...] | None = None


@dataclass(frozen=True)
class Pipeline:
    """A way from a prepared scene to the fitted Gaussians of a result."""

    name: str
    build: Callable[[Prepared, Plan, int | None], Fitted]  # builds a number of Gaussians; None: the usual number


@dataclass(frozen=True, eq=False)
class Plan:
    """All decisions about a run, made before the first superpixel is cut."""

    count: CountPlan  # How many Gaussians
    merge: MergePlan  # How they are made
    fit: FitOptions  # How they are fitted to the photos
    score: ScorePlan  # How results are scored
    clean: CleanOptions  # What is left out of the result
    pipeline: Pipeline  # How Gaussians are built
    seed: int  # All random choices depend on this number alone
    settings: dict[str, Any]  # All settings by flat name, for reports
    free_poses: bool = False  # The options ask the fit to move cameras, even if the scene does not need it
    is_trial: bool = False  # The result is only scored on left-out photos, so gaps need not be filled

    @property
    def prunes(self) -> bool:
        """Return whether Gaussians that no photo shows are dropped after the fit."""
        return self.fit.min_contribution > 0

    @property
    def searches(self) -> bool:
        """Return whether several counts may be built: for a quality, for the file's size, or to clean up a result."""
        size = self.count.file_size
        has_choice = size is not None and (size.packed or size.count_without_harmonics is not None)
        return self.count.has_quality or has_choice or self.clean.asked

    def with_fixed_cameras(self) -> Plan:
        """Return the plan with a fit that does not move cameras."""
        return replace(self, fit=replace(self.fit, move_cameras=False))

    def with_fit(self, fit: FitOptions) -> Plan:
        """Return the plan with the fit ``fit``, which starts with all Gaussians."""
        superpixels = replace(self.merge.superpixels, start_share=1.0)
        return replace(self, fit=fit, merge=replace(self.merge, superpixels=superpixels))
