"""Name the settings of :func:`gsmerge.compact` for type checkers and editors, with their types."""

from __future__ import annotations

from typing import Literal, TypedDict

from gsmerge.settings.fit import Fit
from gsmerge.settings.stages import Exposure, Extent, KRule, Look, MatchMethod, Poses


class CompactSettings(TypedDict, total=False):
    """Settings of :class:`gsmerge.CompactOptions` by flat name."""

    poses: Poses
    exposure: Exposure
    look: Look
    extent: Extent
    superpixels: int | str
    segmentation: str
    rectangles: float | None
    early_sweeps: int | None
    compactness: float
    match: MatchMethod | None
    overlap: float
    iou: float
    similarity: float
    max_color: float
    neighbors: int | None
    cluster_size: int | None
    k: int | Literal["mixed", "auto"]
    k_low: float
    k_high: float
    k_rule: KRule
    min_opacity: float
    fit: Fit
    fit_steps: int | None
    photo_scale: float | Literal["auto"]
    dropout: float | None
    half_res_share: float | None
    holdout: float
    min_contribution: float
    crop: str | None
    drop: str | None
    budget: int | str | None
    fill: bool
    quality: str | None
    levels: int
    blocks: int | Literal["auto", "none"]
    method: str
    effort: str
    checkpoint: str
    recipe: str | None
    require_checkpoint: bool
    new_views: bool | None
    seed: int
    threads: int | None


class BatchSettings(CompactSettings, total=False):
    """These settings, and those of :class:`gsmerge.settings.extend.ExtendOptions`."""

    max_views: int
    other_world: bool
