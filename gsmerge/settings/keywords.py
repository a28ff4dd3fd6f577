"""Settings as typed keyword arguments. Made by docs/generate_reference.py from their declarations."""

from __future__ import annotations

from typing import Literal, TypedDict


class CompactKeywords(TypedDict, total=False):
    """Settings of :func:`gsmerge.compact`."""

    poses: Literal["auto", "fixed", "free"]
    exposure: Literal["auto", "fixed", "per-photo"]
    unseen: Literal["drop", "keep"]
    look: Literal["auto", "scene", "photos"]
    extent: Literal["auto", "photos", "beyond"]
    superpixels: int | str
    segmentation: Literal["rdseg", "bass", "bass-st", "slic", "grid"]
    rectangles: float | None
    early_sweeps: int | None
    compactness: float
    match: Literal["overlap", "aabb", "none"] | None
    overlap: float
    iou: float
    similarity: float
    max_color: float
    neighbors: int | None
    cluster_size: int | None
    k: int | Literal["mixed", "auto"]
    k_low: float
    k_high: float
    k_rule: Literal["saliency", "distortion"]
    min_opacity: float
    fit: Literal["full", "none"]
    fit_steps: int | None
    time_budget: float | None
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
    effort: Literal["draft", "fast", "default", "best"]
    checkpoint: str
    recipe: Literal["paper"] | None
    require_checkpoint: bool
    new_views: bool | None
    seed: int
    threads: int | None


class DecodeKeywords(TypedDict, total=False):
    """Settings of :meth:`gsmerge.Compactor.decode`."""

    k: int | Literal["mixed", "auto"]
    k_low: float
    k_high: float
    k_rule: Literal["saliency", "distortion"]
    min_opacity: float


class StateKeywords(CompactKeywords, total=False):
    """Settings of :class:`gsmerge.Compactor`."""

    max_views: int
    other_world: bool
