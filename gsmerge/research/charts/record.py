"""One run and its measurements, flat, and the results folder: one line per finished run, written at once."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from itertools import product
from pathlib import Path
from typing import Any

from gsmerge import __version__
from gsmerge.io.content_hash import digest
from gsmerge.runtime.jsonl import append_line, read_lines

SCHEMA_VERSION = 1
INPUT = "input"  # the method of a run that merges nothing
HIGHER_IS_BETTER = {"psnr": True, "ssim": True, "lpips_vgg": False, "lpips_alex": False}
SCORES = tuple(map("".join, product(HIGHER_IS_BETTER, ("_context", "_target"), ("", "_visible"))))


def _holds(container: type | tuple[type, ...], *kinds: type) -> Callable[[Any], bool]:
    """Whether a value is a container of values of some types alone."""

    def check(given: Any) -> bool:
        values = given.values() if isinstance(given, Mapping) else given
        return isinstance(given, container) and all(isinstance(value, kinds) for value in values)

    return check


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


CHECKS: dict[str, Callable[[Any], bool]] = {  # of values read from JSON, by the type of their field
    "str": lambda value: isinstance(value, str),
    "str | None": lambda value: value is None or isinstance(value, str),
    **dict.fromkeys(("int", "float"), _is_number),
    **dict.fromkeys(("int | None", "float | None"), lambda value: value is None or _is_number(value)),
    "tuple[str, ...]": _holds((list, tuple), str),
    "Mapping[str, Any]": _holds(Mapping, str, int, float, bool, type(None)),
    "Mapping[str, str]": _holds(Mapping, str),
    "Mapping[str, float]": _holds(Mapping, int, float),
}


def known_fields(kind: type, values: Mapping[str, Any]) -> dict[str, Any]:
    """The values that a dataclass has fields for; a ValueError if one is of another type than its field."""
    known = {f.name: values[f.name] for f in fields(kind) if f.name in values}
    wrong = next((f.name for f in fields(kind) if f.name in known and not CHECKS[str(f.type)](known[f.name])), None)
    if wrong is not None:
        raise ValueError(f"expected a run record, got one with another {wrong}")
    return known


@dataclass(frozen=True)
class RunRecord:
    """One finished run, successful or not.

    Scores are means over the views of a split: ``context`` are the views that the scene was made of, ``target``
    held-out ones; ``_visible`` counts only pixels that the context views see. None where nothing was measured.
    """

    key: str  # of the experiment, see experiment_key
    scene: str  # its name
    scene_sha256: str  # hash of everything that was read
    method: str  # gsmerge, the name of a baseline, or input: the scene as it is
    settings: Mapping[str, Any]  # settings by flat name; the rest are defaults
    views_asked: int | None  # number of views that was asked for; None: all
    command: str  # the command line of the run
    environment: Mapping[str, str]  # processor, threads and versions
    views: int | None = None  # views that went in
    num_input: int | None = None  # Gaussians of those views
    count: int | None = None  # Gaussians of the result
    ratio: float | None = None  # count / num_input
    bytes: int | None = None  # size of the result as a .ply
    seconds: float | None = None  # wall time of the merge with everything but reading, writing and scoring
    stages: Mapping[str, float] = field(default_factory=dict)  # the same by stage, scoring included
    render_ms: float | None = None  # milliseconds that one view takes to render, the median
    pictures: tuple[str, ...] = ()  # names of the views whose pictures were kept
    notes: tuple[str, ...] = ()  # of the reader and of the run
    error: str | None = None  # why the run failed, in one line; None if it did not
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
    schema_version: int = SCHEMA_VERSION  # of this record

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
        """The record that :meth:`to_dict` gave, through JSON; a ValueError if it is of another version or damaged."""
        version = values.get("schema_version")
        if version != SCHEMA_VERSION:
            raise ValueError(f"expected a run record of schema version {SCHEMA_VERSION}, got {version!r}")
        known = known_fields(RunRecord, values)
        for name in ("pictures", "notes"):
            known[name] = tuple(known.get(name, ()))
        try:
            return RunRecord(**known)
        except TypeError as error:
            raise ValueError(f"expected a run record, got one with a field missing ({error})") from error


RUNS, PROXIES, PICTURES, CHARTS, PAGE = "runs.jsonl", "proxies.jsonl", "pictures", "charts", "index.html"


def experiment_key(scene_sha256: str, method: str, settings: Mapping[str, Any], views: int | None) -> str:
    """The key of a run: a hash of the scene's content, all settings, the number of views asked for, and versions."""
    return digest(
        {
            "scene": scene_sha256,
            "method": method,
            "settings": dict(settings),
            "views": views,
            "tool_version": __version__,
            "schema_version": SCHEMA_VERSION,
        }
    )


def read_runs(folder: Path) -> tuple[dict[str, RunRecord], tuple[str, ...]]:
    """All runs of a results folder by key, the newest of each, and notes on lines that were left out."""
    lines = read_lines(folder / RUNS)
    records: dict[str, RunRecord] = {}
    foreign = 0
    for value in lines.values:
        try:
            record = RunRecord.from_dict(value)
        except ValueError:
            foreign += 1
            continue
        records.pop(record.key, None)  # a repeated run moves to the end
        records[record.key] = record
    skipped = [f"{folder / RUNS}: {foreign} line(s) of another version were passed over"] if foreign else []
    return records, (*lines.notes, *skipped)


def append_run(folder: Path, record: RunRecord) -> None:
    """Store a finished run."""
    append_line(folder / RUNS, record.to_dict())


def picture_path(folder: Path, owner: str, view: int, kind: str) -> Path:
    """Path of a picture of a run (by its key) or of a scene (by its hash); ``kind``: photo, render or error."""
    suffix = "png" if kind == "error" else "jpg"
    return folder / PICTURES / owner[:16] / f"{view}.{kind}.{suffix}"
