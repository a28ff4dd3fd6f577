"""From a state's file and a batch's files to the next state's file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import Any

from gsmerge.compact_file import read_input
from gsmerge.errors import SceneError, UsageError
from gsmerge.io import AUTO, ReadHints, SceneFiles, atomic_output
from gsmerge.io.formats.ply import OpacityChoice
from gsmerge.online.compactor import settled
from gsmerge.online.extend import extend
from gsmerge.online.file import load_state, save_state
from gsmerge.report import document_head, seconds_document
from gsmerge.runtime.memory import peak_memory
from gsmerge.runtime.run_log import Progress

Mark = tuple[int, int, int] | None


def extend_file(
    path: Path,
    files: SceneFiles,
    settings: Mapping[str, Any],
    *,
    opacity: OpacityChoice = "auto",
    hints: ReadHints = AUTO,
    progress: Progress | None = None,
    seconds_before: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Add a batch of views to the state in a file, or make the file if there is none.

    The file is replaced when all is done, and not at all if anything goes wrong or someone else has changed it.

    Args:
        path: The state, or an encoded scene.
        files: The new views.
        settings: As of :class:`gsmerge.Compactor`; what is not given is as the state has it.
        opacity: How opacities are stored.
        hints: What is told of the batch's file instead of found.
        progress: See :func:`gsmerge.compact`.
        seconds_before: Wall time by name of what the caller did before.

    Returns:
        What was done, in plain JSON types.

    Raises:
        SceneError: If the state or the scene cannot be read, or the state cannot be written or was changed meanwhile.
        UsageError: If a setting is unknown, out of range, or asks for what a state or the scene does not have.
    """
    start, mark = perf_counter(), _mark(path)
    state = None if mark is None else load_state(path)
    try:
        options, online = settled(settings, state)
    except ValueError as error:
        raise UsageError(str(error)) from error
    with atomic_output(path, overwrite=mark is not None) as temporary:
        loaded = perf_counter()
        given = read_input(files, options.segment, opacity=opacity, hints=hints)
        read = perf_counter()
        state, report = extend(state, given.scene, options, online, progress=progress)
        done = perf_counter()
        save_state(temporary, state, overwrite=True)
        if _mark(path) != mark:
            raise SceneError(path, "was changed by another process meanwhile", "extend it again; it is as that left it")
    seconds = {**(seconds_before or {}), "load": loaded - start, "read": read - loaded, **report.seconds}
    seconds["other"] = done - read - sum(report.seconds.values())
    numbers = {name: value for name, value in asdict(report).items() if name not in ("seconds", "notes", "options")}
    return {
        **document_head(),
        "input": {"path": str(files.ply), **given.recognised},
        **numbers,
        "state": {"path": str(path), "bytes": path.stat().st_size, "num_batches": len(state.about["batches"])},
        "options": dict(report.options),
        **seconds_document(seconds | {"write": perf_counter() - done}),
        "peak_memory_bytes": peak_memory(),
        "notes": [*given.notes, *report.notes],
    }


def _mark(path: Path) -> Mark:
    """What tells one file of this name from the next; None where there is none."""
    try:
        found = os.stat(path)
    except OSError:  # what is wrong with it shows when it is written
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size
