"""The results folder: one line per finished run, safe against being killed at any moment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from gsmerge import __version__
from gsmerge.budget import old_settings
from gsmerge.io.content_hash import digest
from gsmerge.research.charts.record import SCHEMA_VERSION, RunRecord
from gsmerge.runtime.jsonl import append_line, read_lines

RUNS, PROXIES, PICTURES, CHARTS, PAGE = "runs.jsonl", "proxies.jsonl", "pictures", "charts", "index.html"
T = TypeVar("T")


def experiment_key(scene_sha256: str, method: str, settings: Mapping[str, Any], views: int | None) -> str:
    """What a run is known by: the scene's content, everything that was set, and the versions that ran.

    Args:
        scene_sha256: Of all files that the run reads.
        method: Name of the method.
        settings: By flat name.
        views: Number of views that was asked for; None: all.
    """
    return digest(
        {
            "scene": scene_sha256,
            "method": method,
            "settings": old_settings(settings),
            "views": views,
            "tool_version": __version__,
            "schema_version": SCHEMA_VERSION,
        }
    )


def read_runs(folder: Path) -> tuple[dict[str, RunRecord], tuple[str, ...]]:
    """All runs of a results folder by key, the newest of each, and notes on what was dropped."""
    return _by_key(folder / RUNS, RunRecord.from_dict, lambda record: record.key)


def _by_key(
    path: Path, make: Callable[[Mapping[str, Any]], T], key: Callable[[T], str]
) -> tuple[dict[str, T], tuple[str, ...]]:
    lines = read_lines(path)
    found: dict[str, T] = {}
    foreign = 0
    for value in lines.values:
        try:
            made = make(value)
        except ValueError:
            foreign += 1
            continue
        found.pop(key(made), None)  # a run that was done again goes to the end
        found[key(made)] = made
    told = [f"{path}: {foreign} line(s) of another version were passed over"] if foreign else []
    return found, (*lines.notes, *told)


def append_run(folder: Path, record: RunRecord) -> None:
    """Keep a finished run."""
    append_line(folder / RUNS, record.to_dict())


def picture_path(folder: Path, owner: str, view: int, kind: str) -> Path:
    """Where a picture of a run (by its key) or of a scene (by its hash) lies; ``kind``: photo, render or error."""
    suffix = "png" if kind == "error" else "jpg"
    return folder / PICTURES / owner[:16] / f"{view}.{kind}.{suffix}"
