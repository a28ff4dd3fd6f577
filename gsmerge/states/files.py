"""States in files: extended by the views of a scene's files, and compacted into a file of Gaussians."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from gsmerge.budget import FileSize, file_size
from gsmerge.compaction.file_size import drop_to_bytes
from gsmerge.compaction.files import read_input
from gsmerge.errors import SceneError, UsageError
from gsmerge.fit import FitOptions
from gsmerge.io import atomic_output, lock_folder, lost_harmonics, output_format, write_gaussians
from gsmerge.io.formats.arrays import RESULT_COMMENT, copied_comments
from gsmerge.io.formats.rounding import rounding_notes
from gsmerge.io.formats.table import PLY, count_for_bytes
from gsmerge.plan import resolve_fit
from gsmerge.report import document_head, file_sha256, seconds_document, seconds_line
from gsmerge.runtime.memory import human_bytes, peak_memory
from gsmerge.runtime.record import Progress
from gsmerge.scene.exporters import AUTO, ReadHints
from gsmerge.scene.files import SceneFiles
from gsmerge.scene.read import Loaded
from gsmerge.settings.budget import BudgetOptions
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.extend import merge_settings
from gsmerge.settings.reading import OpacityChoice
from gsmerge.states.decode import check_fit, count_children, decode_state
from gsmerge.states.extend import extend
from gsmerge.states.groups import divide_groups
from gsmerge.states.state import State
from gsmerge.states.state_file import load_state, save_state

REMEDY = "extend a new state by the scene"


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
    """Add a batch of views to the state in a file, or to a new file, and return the report as plain JSON types.

    The file is replaced at the end, and not if anything fails or another process has changed it. If two processes end
    together, the second waits for the first and then sees its change. ``settings``: see :class:`gsmerge.Compactor`; by
    default the state's own. ``seconds_before``: wall time by name of the caller's earlier steps. Raises SceneError if a
    file cannot be read or written or was changed meanwhile, UsageError if a setting is unknown, out of range, or
    requires what the state or the scene does not have.
    """
    start, identity = perf_counter(), _file_identity(path)
    state = None if identity is None else load_state(path)
    try:
        options, extend_options = merge_settings(settings, None if state is None else state.about["options"])
    except ValueError as error:
        raise UsageError(str(error)) from error
    with ExitStack() as until_renamed, atomic_output(path, overwrite=identity is not None) as temporary:
        loaded = perf_counter()
        load = read_input(files, opacity=opacity, hints=hints)
        read = perf_counter()
        is_first = state is None
        state, report = extend(state, load.scene, options, extend_options, progress=progress)
        if is_first:
            state = replace(state, about={**state.about, "source": _source(files, load)})
        done = perf_counter()
        save_state(temporary, state, overwrite=True)
        until_renamed.enter_context(lock_folder(path.resolve().parent))
        if _file_identity(path) != identity:
            raise SceneError(path, "was changed by another process meanwhile", "extend it again; it is as that left it")
    seconds = {**(seconds_before or {}), "load": loaded - start, "read": read - loaded, **report.seconds}
    seconds["other"] = done - read - sum(report.seconds.values())
    numbers = {name: value for name, value in asdict(report).items() if name not in ("seconds", "notes", "options")}
    return {
        **document_head(),
        "input": {"path": str(files.ply), **load.recognised},
        **numbers,
        "state": {"path": str(path), "bytes": path.stat().st_size, "num_batches": len(state.about["batches"])},
        "options": dict(report.options),
        **seconds_document(seconds | {"write": perf_counter() - done}),
        "peak_memory_bytes": peak_memory(),
        "notes": [*load.notes, *report.notes],
    }


def _source(files: SceneFiles, load: Loaded) -> dict[str, Any]:
    """Return facts about the file of a scene as plain JSON types, without its folder."""
    num_bytes = sum(path.stat().st_size for path in files.plys)
    texts = {"comments": list(load.comments), "notes": list(load.notes)}
    return {"name": files.ply.name, "sha256": file_sha256(*files.plys), "bytes": num_bytes, **texts}


def _file_identity(path: Path) -> tuple[int, int, int] | None:
    """Return numbers that change when a file of this name is replaced; None without a file."""
    try:
        status = os.stat(path)
    except OSError:  # other problems show when it is written
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size


def batch_line(document: Mapping[str, Any]) -> str:
    """Describe the report of a batch in one line."""
    state, dropped = document["state"], document["num_covered"] + document["num_hidden"]
    return (
        f"{state['path']}: batch {state['num_batches']}, {document['num_views']} views,"
        f" {document['num_input']:,} Gaussians -> {document['num_new']:,} groups: {document['num_joined']:,} joined"
        f" others, {dropped:,} not needed; {document['num_groups']:,} groups in all,"
        f" {human_bytes(state['bytes'])}; {seconds_line(document)}"
    )


def compact_file(
    path: Path,
    out: Path,
    settings: CompactOptions,
    *,
    k: int | str | None = None,
    budget: int | str | None = None,
    mixed: Mapping[str, Any] | None = None,
    always_fit: bool = False,
    normals: bool = True,
    overwrite: bool = False,
    dry_run: bool = False,
    progress: Progress | None = None,
    seconds_before: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Compact the state in a file, write the Gaussians to a file, and return the report as plain JSON types.

    ``settings``: of the fit and the run; ``always_fit``: refuse a state without photos, which otherwise is not fitted.
    ``dry_run``: write nothing. Other arguments and errors are those of :func:`gsmerge.states.decode.decode_state` and
    :func:`gsmerge.compaction.files.compact_files`.
    """
    start, state = perf_counter(), load_state(path)
    lost, read = lost_harmonics(out, state.sh_degree), perf_counter()
    notes = [lost] if lost else []
    fit_options = resolve_fit(settings) if always_fit or len(state.replay) else FitOptions(fit="none")
    check_fit(state, fit_options)
    size = _file_size(budget, out)
    count = budget if size is None else count_for_bytes(size.file, size.num_bytes, state.sh_degree)
    document: dict[str, Any] = {
        **document_head(),
        "input": {
            "path": str(path), "bytes": path.stat().st_size, "num_groups": len(state),
            "num_gaussians": state.settings.num_input, "state": dict(state.about),
        },
        "k": k,
        "budget": budget,
    }  # fmt: skip
    if dry_run:
        counts = count_children(state, divide_groups(state), k=k, budget=count, mixed=mixed)
        most = int(counts.per_group.sum()) + len(state.kept)
        output = {"dry_run": True, "output": {"path": str(out), "num_gaussians_at_most": most}}
        return document | output | {"notes": [*counts.notes, *notes]}
    with atomic_output(out, overwrite=overwrite) as temporary:
        decoded = decode_state(
            state, k=k, budget=count, mixed=mixed, options=fit_options, seed=settings.seed, threads=settings.threads,
            progress=progress,
        )  # fmt: skip
        gaussians, done = decoded.gaussians, perf_counter()
        if size is not None and size.file is not PLY:
            gaussians = drop_to_bytes(gaussians, [], size.num_bytes, size.file)
        if len(gaussians) == 0:
            raise SceneError(path, "expected visible Gaussians, found none", REMEDY)
        if not all(np.isfinite(getattr(gaussians, name)).all() for name in ("means", "scales", "quats")):
            raise SceneError(path, "expected Gaussians of finite numbers, found others", REMEDY)
        write_gaussians(
            temporary, gaussians, overwrite=True, comments=_comments(state), ending=output_format(out).ending,
            normals=normals,
        )  # fmt: skip
    seconds = {**(seconds_before or {}), "read": read - start, "decode": done - read, "write": perf_counter() - done}
    return document | {
        "output": {"path": str(out), "bytes": out.stat().st_size, "num_gaussians": len(gaussians)},
        "ratio": len(gaussians) / max(state.settings.num_input, 1),
        "fit": decoded.fit and decoded.fit.to_dict(),
        **seconds_document(seconds),
        "notes": [*decoded.notes, *notes, *rounding_notes(out, gaussians)],
    }


def _file_size(budget: int | str | None, out: Path) -> FileSize | None:
    """Return the size in bytes that a budget asks for; None for any other budget."""
    try:
        return None if budget is None else file_size(BudgetOptions(budget, output=out.name))
    except ValueError as error:
        raise UsageError(str(error)) from error


def _comments(state: State) -> list[str]:
    """Return the comments of the header: those of a result, and those copied from the first batch's file."""
    texts = state.about.get("source", {}).get("comments")
    return [RESULT_COMMENT, *copied_comments(texts if isinstance(texts, list) else ())]


def compact_line(document: Mapping[str, Any]) -> str:
    """Describe the report of a compacted state in one line."""
    before, after = document["input"], document["output"]
    if "dry_run" in document:
        return f"would write  {after['path']}: at most {after['num_gaussians_at_most']:,} Gaussians"
    return (
        f"{after['path']}: {before['num_groups']:,} groups -> {after['num_gaussians']:,} Gaussians"
        f" ({100 * document['ratio']:.2f} % of the scene's), {human_bytes(before['bytes'])} ->"
        f" {human_bytes(after['bytes'])}; {seconds_line(document)}"
    )
