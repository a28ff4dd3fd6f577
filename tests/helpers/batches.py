"""Batches for tests: tiny scenes, and options under which each takes a fraction of a second."""

from __future__ import annotations

import csv
import hashlib
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gsmerge.batch import BatchOptions, Job
from gsmerge.batch.find import output_name
from gsmerge.batch.records import RECORDS, SUMMARY, RecordIndex
from gsmerge.batch.task import BatchContext, Task, make_index
from gsmerge.settings.compact import CompactOptions

NAMES = [f"room{number}.ply" for number in range(4)]  # results of the fixture ``rooms``
PATIENCE = 180  # seconds, on a machine that is busy with other things
FAST = ("--effort", "draft", "--fit", "none")
QUICK = BatchOptions(CompactOptions().with_settings({"effort": "draft", "fit": "none", "threads": 1}))


def records(folder: Path) -> list[dict[str, Any]]:
    """All records of an output folder; every line must be whole."""
    return [json.loads(line) for line in (folder / RECORDS).read_text().splitlines()]


def statuses(folder: Path) -> dict[str, list[str]]:
    """What was recorded of every result, in order."""
    actual: dict[str, list[str]] = {}
    for record in records(folder):
        actual.setdefault(record["output"], []).append(record["status"])
    return actual


def results(folder: Path) -> dict[str, str]:
    """SHA-256 of every file but the records: whatever is left half-done shows."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name not in (RECORDS, SUMMARY)]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def rows(folder: Path) -> list[dict[str, str]]:
    """The rows of the summary."""
    with (folder / SUMMARY).open(newline="") as file:
        return list(csv.DictReader(file))


def start(*arguments: object) -> subprocess.Popen[str]:
    """``gsmerge batch ...`` in a process of its own."""
    command = [sys.executable, "-m", "gsmerge", "batch", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(*arguments: object) -> int:
    """Exit code of ``gsmerge batch ...``."""
    process = start(*arguments)
    process.communicate()
    return process.returncode


def until(condition: Callable[[], Any], process: subprocess.Popen[str]) -> Any:
    """Wait for a condition; returns what it comes to, or None if the process ended before."""
    deadline = time.monotonic() + PATIENCE
    while not (actual := condition()):
        if process.poll() is not None:
            return None
        assert time.monotonic() < deadline
        time.sleep(0.005)
    return actual


def holders(folder: Path) -> list[int]:
    """Processes that have begun to compact scenes."""
    actual = []
    for path in folder.glob(".batch-*.begun"):
        try:
            actual.append(int(path.read_text().split()[0]))
        except (OSError, IndexError):
            continue  # it is being written, or has just gone
    return actual


class InlinePool:
    """In place of :class:`gsmerge.runtime.processes.ProcessPool`: one call after the other in this process."""

    def __init__(self, *_: object, **__: object) -> None:
        make_index.cache_clear()  # as in a new process
        self.ended: list[tuple[Any, Any]] = []

    @property
    def has_room(self) -> bool:
        return not self.ended

    def submit(self, key: Any, function: Callable[..., Any], *arguments: Any, memory: int = 0) -> None:
        self.ended.append((key, function(*arguments)))

    def wait(self, _: float | None) -> list[tuple[Any, Any]]:
        ended, self.ended = self.ended, []
        return ended

    def close(self) -> list[Any]:
        return []


def one_task(scene: Path, out: Path, options: BatchOptions = QUICK) -> tuple[Task, BatchContext, RecordIndex]:
    """What :func:`run_task` takes for a single scene, as a run would have it that begins now."""
    out.mkdir(exist_ok=True)
    index = RecordIndex(out)
    index.read_on()
    name = output_name(options, scene, 0)
    return (
        Task(Job(0, str(scene), name, 0), index.known.get(name)),
        BatchContext(out, options, index.end),
        RecordIndex(out, index.end),
    )
