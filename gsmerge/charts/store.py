"""The results folder: one line per finished run, safe against being killed at any moment."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from gsmerge import __version__
from gsmerge.charts.record import SCHEMA_VERSION, RunRecord
from gsmerge.errors import SceneError

RUNS, PROXIES, PICTURES, CHARTS, PAGE = "runs.jsonl", "proxies.jsonl", "pictures", "charts", "index.html"
T = TypeVar("T")


@dataclass(frozen=True)
class Lines:
    """What a file of JSON lines holds.

    Args:
        values: One per line that could be read.
        notes: Lines that were dropped, one sentence each.
    """

    values: tuple[dict[str, Any], ...]
    notes: tuple[str, ...]


def digest(value: Mapping[str, Any]) -> str:
    """SHA-256 of plain JSON types; the order of the keys does not matter."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


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
            "settings": dict(settings),
            "views": views,
            "tool_version": __version__,
            "schema_version": SCHEMA_VERSION,
        }
    )


def read_lines(path: Path) -> Lines:
    """Read a file of JSON lines; what a killed run left half-written is dropped, and said.

    Raises:
        SceneError: If the file cannot be read.
    """
    if not path.exists():
        return Lines((), ())
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SceneError(path, f"cannot be read ({error.strerror})") from error
    *whole, rest = data.split(b"\n")
    values, notes = [], []
    for number, line in enumerate(whole, 1):
        value = _parsed(line)
        if value is None:
            notes.append(f"{path}: line {number} is damaged and was dropped; its run is done again")
        else:
            values.append(value)
    if rest:
        notes.append(f"{path}: the last line is incomplete and was dropped; its run is done again")
    return Lines(tuple(values), tuple(notes))


def _parsed(line: bytes) -> dict[str, Any] | None:
    try:
        value = json.loads(line)
    except ValueError:
        return None
    return value if isinstance(value, dict) else None


def append_line(path: Path, value: Mapping[str, Any]) -> None:
    """Append one JSON line: on the disk when this returns, and after a half-written one it begins a new line.

    Raises:
        SceneError: If the file cannot be written.
        ValueError: If there is NaN or inf among the values.
    """
    line = json.dumps(value, separators=(",", ":"), ensure_ascii=True, allow_nan=False).encode("ascii") + b"\n"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a+b", buffering=0) as file:
            file.truncate(_whole_bytes(path))
            file.write(line)
            os.fsync(file.fileno())
    except OSError as error:
        raise SceneError(path, f"cannot be written ({error.strerror})", "name another folder with --out") from error


def _whole_bytes(path: Path) -> int:
    """Bytes up to the end of the last complete line."""
    with path.open("rb") as file:
        end = file.seek(0, os.SEEK_END)
        while end > 0:
            start = max(0, end - 65536)
            file.seek(start)
            newline = file.read(end - start).rfind(b"\n")
            if newline >= 0:
                return start + newline + 1
            end = start
    return 0


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


def content_hash(files: Sequence[Path]) -> str:
    """SHA-256 over the names and contents of files; of folders, over everything in them."""
    state = hashlib.sha256()
    for given in files:
        inside = sorted(p for p in given.rglob("*") if p.is_file()) if given.is_dir() else [given]
        for path in inside:
            name = path.relative_to(given).as_posix() if given.is_dir() else path.name
            try:
                with path.open("rb") as file:
                    state.update(f"{len(name)}:{name}:{path.stat().st_size}:".encode())
                    while block := file.read(1 << 20):
                        state.update(block)
            except OSError as error:
                raise SceneError(path, f"cannot be read ({error.strerror})") from error
    return state.hexdigest()
