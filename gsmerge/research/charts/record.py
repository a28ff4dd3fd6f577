"""What one run measured: flat, and the same in memory as in the results file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from gsmerge.budget import new_settings

SCHEMA_VERSION = 1
INPUT = "input"  # the method of a run that merges nothing
METRICS = ("psnr", "ssim", "lpips_vgg", "lpips_alex")
SPLITS = ("context", "target")
SCORES = tuple(f"{metric}_{split}{part}" for metric in METRICS for split in SPLITS for part in ("", "_visible"))
HIGHER_IS_BETTER = {"psnr": True, "ssim": True, "lpips_vgg": False, "lpips_alex": False}


_TEXTS = ("key", "scene", "scene_sha256", "method", "command")
_TABLES = {  # and their values
    "settings": (str, int, float, bool, type(None)),
    "environment": (str,),
    "stages": (int, float),
}
_LISTS = ("pictures", "notes")


def _fits(name: str, value: object) -> bool:
    """Whether a value read from JSON is of the kind that a field has."""
    if name in _TEXTS:
        return isinstance(value, str)
    if name in _TABLES:
        return isinstance(value, Mapping) and all(isinstance(inner, _TABLES[name]) for inner in value.values())
    if name in _LISTS:
        return isinstance(value, list | tuple) and all(isinstance(inner, str) for inner in value)
    if name == "error":
        return value is None or isinstance(value, str)
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return value is None or number


@dataclass(frozen=True)
class RunRecord:
    """One finished run, well or badly.

    Scores are means over the views of a split: ``context`` are the views that the scene was made of, ``target``
    held-out ones; ``_visible`` counts only pixels that the context views see. None where there is nothing to measure
    by.

    Args:
        key: Of the experiment, see :func:`gsmerge.research.charts.store.experiment_key`.
        scene: Name for people.
        scene_sha256: Of everything that was read.
        method: ``gsmerge``, the name of another method, or ``input``: the scene as it is.
        settings: What was set, by flat name; the rest are defaults.
        views_asked: Number of views that was asked for; None: all.
        command: The command line of the run.
        environment: Processor, threads and versions.
        views: Views that went in.
        num_input: Gaussians of those views.
        count: Gaussians of the result.
        ratio: ``count / num_input``.
        bytes: Size of the result as a ``.ply``.
        seconds: Wall time of the merge with everything but reading, writing and scoring.
        stages: The same by stage, scoring included.
        render_ms: Milliseconds that one view takes to render, the median.
        pictures: Names of the views whose pictures were kept.
        notes: What the reader and the run had to say.
        error: Why the run failed, in one line; None if it did not.
        schema_version: Of this record.
    """

    key: str
    scene: str
    scene_sha256: str
    method: str
    settings: Mapping[str, Any]
    views_asked: int | None
    command: str
    environment: Mapping[str, str]
    views: int | None = None
    num_input: int | None = None
    count: int | None = None
    ratio: float | None = None
    bytes: int | None = None
    seconds: float | None = None
    stages: Mapping[str, float] = field(default_factory=dict)
    render_ms: float | None = None
    pictures: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    error: str | None = None
    psnr_context: float | None = None
    psnr_context_visible: float | None = None
    psnr_target: float | None = None
    psnr_target_visible: float | None = None
    ssim_context: float | None = None
    ssim_context_visible: float | None = None
    ssim_target: float | None = None
    ssim_target_visible: float | None = None
    lpips_vgg_context: float | None = None
    lpips_vgg_context_visible: float | None = None
    lpips_vgg_target: float | None = None
    lpips_vgg_target_visible: float | None = None
    lpips_alex_context: float | None = None
    lpips_alex_context_visible: float | None = None
    lpips_alex_target: float | None = None
    lpips_alex_target_visible: float | None = None
    schema_version: int = SCHEMA_VERSION

    def score(self, name: str) -> float | None:
        """A score by its name, such as ``psnr_target_visible``."""
        if name not in SCORES:
            raise ValueError(f"score: expected one of {', '.join(SCORES)}, got {name!r}")
        value: float | None = getattr(self, name)
        return value

    def to_dict(self) -> dict[str, Any]:
        """The record as plain JSON types."""
        return asdict(self)

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> RunRecord:
        """The record that :meth:`to_dict` gave, through JSON.

        Raises:
            ValueError: If it is of another schema version, or a field is missing or of another kind.
        """
        version = values.get("schema_version")
        if version != SCHEMA_VERSION:
            raise ValueError(f"expected a run record of schema version {SCHEMA_VERSION}, got {version!r}")
        known = {f.name: values[f.name] for f in fields(RunRecord) if f.name in values}
        odd = next((name for name, value in known.items() if not _fits(name, value)), None)
        if odd is not None:
            raise ValueError(f"expected a run record, got one with another {odd}")
        for name in ("pictures", "notes"):
            known[name] = tuple(known.get(name, ()))
        known["settings"] = new_settings(known.get("settings", {}))
        try:
            return RunRecord(**known)
        except TypeError as error:
            raise ValueError(f"expected a run record, got one with a field missing ({error})") from error
