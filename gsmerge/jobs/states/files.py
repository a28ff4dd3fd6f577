"""States in files: extend them by scenes, and decode their Feature Gaussians."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from time import perf_counter
from typing import Any

from gsmerge.errors import SceneError, UsageError, count_words
from gsmerge.io.atomic import common_mode
from gsmerge.io.formats.rows import result_comments
from gsmerge.io.formats.table import Contents
from gsmerge.io.locks import lock_file
from gsmerge.jobs.content_hash import content_hash, digest, list_files
from gsmerge.jobs.states.compactor import extend_state
from gsmerge.jobs.states.extend import BATCH
from gsmerge.jobs.states.features import decode_features
from gsmerge.jobs.states.state_file import State, load_state, save_state
from gsmerge.reading.exporters import NO_HINTS, ReadHints
from gsmerge.reading.file_stats import doubt_changed
from gsmerge.reading.input import read_input
from gsmerge.reading.scene_files import SceneFiles, scene_title
from gsmerge.results.lost_values import format_notes
from gsmerge.results.outputs import Outputs, write_outputs
from gsmerge.runtime.documents import document_head, note_entries, seconds_document, seconds_line
from gsmerge.runtime.memory import human_bytes, human_share, peak_memory
from gsmerge.runtime.record import Progress
from gsmerge.settings.extend import batch_settings
from gsmerge.settings.reading import OpacityChoice
from gsmerge.settings.stages import DecodeOptions


def extend_file(
    path: Path,
    files: SceneFiles,
    settings: Mapping[str, Any],
    *,
    opacity: OpacityChoice = "auto",
    hints: ReadHints = NO_HINTS,
    progress: Progress | None = None,
    seconds_before: Mapping[str, float] | None = None,
    dry_run: bool = False,
    tried: State | None = None,
) -> tuple[dict[str, Any], State]:
    """Add a batch of views to the state in a file, which is made if it is missing; return the report and the new state.

    The report has plain JSON types. The file is replaced at the end, and only if nothing fails. Other processes that
    extend the same file wait. A batch that the state already has is left out, with a note. Raises SceneError if a file
    cannot be read or written, or if the batch seems to be in another world. Raises UsageError if a setting is unknown,
    out of range, or impossible for the state or the scene.

    Args:
        path: The file of the state.
        files: The files of the batch.
        settings: See :class:`gsmerge.Compactor`.
        opacity: How opacities are stored in the batch's file.
        hints: Facts about the batch's file that the file does not state.
        progress: Called while the batch is compacted.
        seconds_before: Wall times of the caller's earlier steps, by name.
        dry_run: Write nothing.
        tried: The state that an earlier dry run returned, used in place of the file's state.
    """
    try:
        batch_settings(settings)
    except ValueError as error:
        raise UsageError(str(error)) from error
    with nullcontext() if dry_run else lock_state(path):
        start = perf_counter()
        state = tried or (load_state(path) if os.path.exists(path) else None)
        paths = list_files(files)
        batch_hash = content_hash(paths)
        mode = common_mode(paths)
        document = {**document_head(), "input": {"path": str(files.ply), "content": batch_hash}, "dry_run": dry_run}
        batches = [] if state is None else state.about["batches"]
        known_hashes = [batch.get("content", batch.get("sha256")) for batch in batches]  # "sha256" before version 0.6
        if state is not None and batch_hash in known_hashes:
            number = known_hashes.index(batch_hash) + 1
            note = f"{files.ply}: left out, since the same files are batch {number} of {path.name} already"
            return document | {"repeated": True, "state": _state_facts(path, state), **note_entries([note])}, state
        load_end = perf_counter()
        loaded = read_input(files, opacity=opacity, hints=hints, hashed=True)
        read_end = perf_counter()
        try:
            state, report = extend_state(state, loaded.scene, settings, progress=progress)
        except SceneError as error:
            raise (SceneError(files.ply, error.problem, error.remedy) if error.path == BATCH else error) from error
        *earlier, last = state.about["batches"]
        comments = list(dict.fromkeys([*state.about.get("comments", []), *loaded.comments]))
        about = {**state.about, "batches": [*earlier, last | {"content": batch_hash}], "comments": comments}
        state = replace(state, about=about)
        extend_end = perf_counter()
        if not dry_run:
            save_state(path, state, overwrite=True, mode=mode)
        seconds = {**(seconds_before or {}), "load": load_end - start, "read": read_end - load_end, **report.seconds}
        seconds["other"] = extend_end - read_end - sum(report.seconds.values())
        facts = {name: fact for name, fact in asdict(report).items() if name not in ("seconds", "notes", "options")}
        document["input"] |= loaded.recognised
        document |= {
            **facts,
            "repeated": False,
            "state": _state_facts(path, state),
            "options": dict(report.options),
            **seconds_document(seconds | {"write": perf_counter() - extend_end}),
            "peak_memory_bytes": peak_memory(),
            **note_entries([*loaded.notes, *report.notes, *doubt_changed(loaded.stats)]),
        }
        return document, state


def lock_state(path: Path) -> AbstractContextManager[bool]:
    """Return a context that only one process at a time can enter for the file of a state."""
    path = Path(os.path.realpath(path))
    if not path.parent.is_dir():  # no other process can have a state in a folder that does not exist
        return nullcontext(True)
    return lock_file(path.with_name(f".gsmerge-{digest({'name': path.name})[:16]}.lock"))


def _state_facts(path: Path, state: State) -> dict[str, Any]:
    """Return the facts of a report about the file of a state, which may not exist after a dry run."""
    num_bytes = path.stat().st_size if path.exists() else 0
    return {"path": str(path), "bytes": num_bytes, "num_batches": len(state.about["batches"])}


def batch_line(document: Mapping[str, Any]) -> str:
    """Summarise the report of :func:`extend_file` in one line."""
    state = document["state"]
    would = "would be " if document["dry_run"] else ""
    if document["repeated"]:
        return f"{state['path']}: {would}unchanged, {count_words(state['num_batches'], 'batch')}"
    size = f", {human_bytes(state['bytes'])}; {seconds_line(document)}"
    world = f"; world: {document['choices']['world']}" if state["num_batches"] > 1 else ""
    return (
        f"{state['path']}: {would}batch {state['num_batches']}, {document['num_views']} views,"
        f" {document['num_input']:,} -> {document['num_new']:,} Gaussians; {document['num_gaussians']:,} in all"
        f"{world if document['dry_run'] else size}"
    )


def decode_file(
    path: Path,
    outputs: Outputs,
    options: DecodeOptions,
    *,
    dry_run: bool = False,
    seconds_before: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Decode the Feature Gaussians in a ``.gsm``, write the Gaussians and the cameras, and return the report.

    The output ``out`` has the cameras inside or beside it. With ``dry_run`` nothing is written. Raises SceneError if a
    file cannot be read or written, and UsageError for a K that the networks do not make.
    """
    start = perf_counter()
    out = outputs.result
    state = load_state(path)
    features = state.features
    batches = state.about["batches"]
    if features is None:
        raise SceneError(path, "expected Feature Gaussians, found results", "compact it as a scene")
    num_input = sum(int(batch.get("num_input", 0)) for batch in batches)
    facts = {"path": str(path), "bytes": path.stat().st_size, "num_groups": len(features), "num_gaussians": num_input}
    document: dict[str, Any] = {**document_head(), "input": facts | {"batches": batches}, "k": options.k}
    if dry_run:
        max_count = options.max_k * len(features)
        output = {"path": str(out), "num_gaussians_at_most": max_count}
        return document | {"dry_run": True, "output": output, **note_entries([])}
    read_end = perf_counter()
    gaussians = decode_features(features, options)
    decode_end = perf_counter()
    if len(gaussians) == 0:
        raise SceneError(path, "expected visible Gaussians, found none", "begin a new state with the scene")
    cameras = features.frame.leave_cameras(features.cameras)
    notes = format_notes(out, gaussians, cameras)
    contents = Contents([gaussians], result_comments(None), cameras, features.names, scene_title(path))
    num_bytes = write_outputs(outputs, contents)
    seconds = {**(seconds_before or {}), "read": read_end - start, "decode": decode_end - read_end}
    seconds["write"] = perf_counter() - decode_end
    return document | {
        "output": {"path": str(out), "bytes": num_bytes, "num_gaussians": len(gaussians)},
        "ratio": len(gaussians) / max(num_input, 1),
        **seconds_document(seconds),
        **note_entries(notes),
    }


def decoding_line(document: Mapping[str, Any]) -> str:
    """Summarise the report of :func:`decode_file` in one line."""
    before = document["input"]
    after = document["output"]
    if "dry_run" in document:
        return f"would write  {after['path']}: at most {after['num_gaussians_at_most']:,} Gaussians"
    return (
        f"{after['path']}: {before['num_groups']:,} Feature Gaussians -> {after['num_gaussians']:,} Gaussians"
        f" ({human_share(document['ratio'])} of the scene's), {human_bytes(before['bytes'])} ->"
        f" {human_bytes(after['bytes'])}; {seconds_line(document)}"
    )
