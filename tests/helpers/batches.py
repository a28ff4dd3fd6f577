"""Batches for tests are of tiny scenes, under options with which each takes a fraction of a second."""

from __future__ import annotations

import hashlib
import json
import pickle
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gsmerge.jobs.batch import BatchOptions, Job, find_jobs
from gsmerge.jobs.batch.records import RECORDS
from gsmerge.jobs.batch.run import Run, read_run_index
from gsmerge.runtime.work import Call, WorkerPool
from gsmerge.settings.compact import CompactOptions

NAMES = [f"room{number}.ply" for number in range(4)]  # results of the fixture ``rooms``
PATIENCE = 180  # seconds, on a machine that is busy with other things
FAST = ("--effort", "draft", "--set", "fit=none")
QUICK = BatchOptions(CompactOptions().with_settings({"effort": "draft", "fit": "none", "threads": 1}))


def records(folder: Path) -> list[dict[str, Any]]:
    """Return all records of an output folder; every line must be whole."""
    return [json.loads(line) for line in (folder / RECORDS).read_text().splitlines()]


def has_record(folder: Path) -> bool:
    """Return whether a batch that still runs has written a record, whole: what follows it may be half a line."""
    path = folder / RECORDS
    return path.exists() and b"\n" in path.read_bytes()


def statuses(folder: Path) -> dict[str, list[str]]:
    """Return what was recorded of every result, in order."""
    actual: dict[str, list[str]] = {}
    for record in records(folder):
        actual.setdefault(record["output"], []).append(record["status"])
    return actual


def results(folder: Path) -> dict[str, str]:
    """Return hashes of every file but the records, a lock's and cameras of results: what is half-done shows."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name not in (RECORDS, ".gsmerge-lock")]
    files = [path for path in files if path.name.startswith(".") or not path.name.endswith(".cameras.json")]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def start(*arguments: object) -> subprocess.Popen[str]:
    """Start ``gsmerge batch ...`` in a process of its own."""
    command = [sys.executable, "-m", "gsmerge", "batch", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(*arguments: object) -> int:
    """Return the exit code of ``gsmerge batch ...``."""
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
    """Return processes that have begun to make results."""
    texts = [path.read_text() for path in folder.glob(".batch-*.begun")]
    return [int(text) for text in texts if text.endswith("\n")]


class InlinePool(WorkerPool):
    """In place of :class:`gsmerge.runtime.processes.ProcessPool`: one call after the other in this process."""

    capacity = 1

    def __init__(self, *_: object) -> None:
        read_run_index.cache_clear()  # as in a new process
        self.ended: list[tuple[Any, Any]] = []

    def submit(self, function: Callable[..., Any], call: Call) -> None:
        pickle.dumps((function, call.arguments))  # as for another process
        self.ended.append((call.key, function(*call.arguments)))

    def wait(self) -> list[tuple[Any, Any]]:
        ended, self.ended = self.ended, []
        return ended

    def close(self) -> None:
        pass


def one_job(scene: Path, out: Path, options: BatchOptions = QUICK) -> tuple[Job, Run]:
    """Return what :func:`make_result` takes for a single scene, as a run would have it that begins now."""
    out.mkdir(exist_ok=True)
    read_run_index.cache_clear()
    (job,) = find_jobs([str(scene)], out, options)
    return job, Run(out, 1, options.overwrite)


def touch(*names: str) -> None:
    """Write files that look like scenes of seven Gaussians, in folders that are made for them."""
    for name in names:
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        header = b"ply\nformat ascii 1.0\nelement vertex 7\nproperty char f_dc_0\nend_header\n"
        Path(name).write_bytes(header + 7 * b"0\n")
