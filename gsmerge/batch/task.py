"""One scene: skipped if it is done, otherwise compacted and recorded, safe against a kill at any moment."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsmerge import __version__
from gsmerge.batch.find import Job, result_names
from gsmerge.batch.locks import BusyError, Lock, scene_lock
from gsmerge.batch.options import BatchOptions
from gsmerge.batch.records import (
    BUSY,
    DONE,
    FAILED,
    RECORDS,
    SKIPPED,
    STUCK,
    DoneResult,
    RecordIndex,
    record,
    written_files,
)
from gsmerge.compact_file import compact_files
from gsmerge.errors import SceneError, UsageError, error_line
from gsmerge.io import SceneFiles, find_scene_files
from gsmerge.io.atomic import remove_leftovers
from gsmerge.io.content_hash import content_hash, digest, filled, read_files
from gsmerge.options import CHECKPOINTS
from gsmerge.report import SCHEMA_VERSION, file_sha256, finite
from gsmerge.runtime.jsonl import append_line


@dataclass(frozen=True)
class Task:
    """A scene to be compacted."""

    job: Job  # the scene
    known: DoneResult | None  # its result of former runs; None without one
    attempt: int = 1  # from 1


@dataclass(frozen=True)
class BatchContext:
    """What all tasks of a run share."""

    folder: Path  # the output folder
    options: BatchOptions  # of the run, with the threads of a scene
    start: int  # byte of the records up to which ``Task.known`` was read


def run_task(task: Task, context: BatchContext, new_records: RecordIndex) -> dict[str, Any]:
    """Compact a scene, unless it is done, and return its record.

    One that is not written has the ``status`` skipped, busy (another process has the scene), or stuck (records cannot
    be written). ``new_records``, since the run began, are shared by the tasks of a process.
    """
    job = task.job

    def work(lock: Lock) -> dict[str, Any]:
        try:
            new_records.read_on()
            outcome = _process(task, context, new_records, lock)
        except Exception as error:  # a bad scene must not end the batch
            outcome = record(FAILED, job.scene, job.output, error=error_line(error), attempt=task.attempt)
        known = new_records.known.get(job.output, task.known)
        if outcome["status"] != SKIPPED or (known is not None and known.failed_since):
            append_line(context.folder / RECORDS, outcome)
        lock.finish()
        return outcome

    return _locked(job, context, work)


def _locked(job: Job, context: BatchContext, work: Callable[[Lock], dict[str, Any]]) -> dict[str, Any]:
    """What ``work`` returns under the scene's lock, or that another process has it, or that nothing can be written."""
    try:
        with scene_lock(context.folder, result_names(job.output, context.options)) as lock:
            return work(lock)
    except BusyError:
        return record(BUSY, job.scene, job.output)
    except SceneError as error:  # locks or records cannot be written, whatever the scene
        return record(STUCK, job.scene, job.output, error=str(error))


def _process(task: Task, context: BatchContext, new_records: RecordIndex, lock: Lock) -> dict[str, Any]:
    """The scene's record, with its files in place."""
    job, options = task.job, context.options
    if lock.abandoned:
        _clean(job, context)
    files = _files_of(job, options)
    key = _key_of(job, files, options)
    before, since = task.known, new_records.known.get(job.output)
    for known in (since, None if options.rerun else before):
        if known is not None and known.holds(context.folder, key):
            sizes = {name: (context.folder / name).stat().st_size for name, _ in known.files}
            written = [{"path": name, "sha256": sha256, "bytes": sizes[name]} for name, sha256 in known.files]
            return record(SKIPPED, job.scene, job.output, key=key, files=written)
    own = {name for known in (before, since) if known is not None for name, _ in known.files}
    for name in result_names(job.output, options):
        if os.path.lexists(context.folder / name) and name not in own and not (lock.fresh or options.overwrite):
            problem = "exists already, and no batch wrote it; pass --overwrite to replace it"
            raise UsageError(f"{context.folder / name}: {problem}")
    return _compact(task, context, files, key)


def _compact(task: Task, context: BatchContext, files: SceneFiles, key: str) -> dict[str, Any]:
    job, options = task.job, context.options
    out = context.folder / job.output
    out.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        if job.work is None:
            document = compact_files(
                files, options.settings, out, opacity=options.opacity, hints=options.hints, overwrite=True, hashed=True
            )
            written = [out, *(Path(level["path"]) for level in document["levels"])]
        else:
            document, written = job.work.run(files, options, out)
    document["notes"] += list(dict.fromkeys(str(warning.message) for warning in caught))
    names = [os.path.relpath(path, context.folder) for path in written]
    facts = {"key": key, "files": written_files(context.folder, names), "report": finite(document)}
    return record(DONE, job.scene, job.output, attempt=task.attempt, **facts)


def _files_of(job: Job, options: BatchOptions) -> SceneFiles:
    scene = Path(job.scene)
    return find_scene_files(scene, cameras=filled(options.cameras, scene), images=filled(options.images, scene))


def _key_of(job: Job, files: SceneFiles, options: BatchOptions) -> str:
    return scene_key(files, options) if job.work is None else job.work.key(options)


def scene_key(files: SceneFiles, options: BatchOptions) -> str:
    """Digest of everything that a result depends on: what is read, all settings, and the version."""
    content: dict[str, Any] = {"scene": content_hash(read_files(files)), **options.result_settings()}
    checkpoint = Path(options.settings.checkpoint)
    if options.settings.checkpoint not in CHECKPOINTS and checkpoint.is_file():  # by its content, wherever it is
        content["settings"]["checkpoint"] = file_sha256(checkpoint)
    return digest({**content, "tool_version": __version__, "schema_version": SCHEMA_VERSION})


def is_done(job: Job, known: DoneResult, context: BatchContext) -> bool:
    """Whether a result would be skipped."""
    try:
        return known.holds(context.folder, _key_of(job, _files_of(job, context.options), context.options))
    except SceneError:
        return False


def _clean(job: Job, context: BatchContext) -> None:
    """Remove what a killed process left next to a result and its further levels."""
    for name in result_names(job.output, context.options):
        if (context.folder / name).parent.is_dir():
            remove_leftovers(context.folder / name)


def record_failure(task: Task, context: BatchContext, error: str) -> dict[str, Any]:
    """The record of a scene whose process died or took too long, after all retries."""
    failed = record(FAILED, task.job.scene, task.job.output, error=error, attempt=task.attempt)

    def work(lock: Lock) -> dict[str, Any]:
        _clean(task.job, context)
        append_line(context.folder / RECORDS, failed)
        _finish(lock, task, context)
        return failed

    return _locked(task.job, context, work)


def clean_up(task: Task, context: BatchContext) -> None:
    """Remove unfinished files of a scene whose process was ended on purpose; another process or the next run may."""
    names = result_names(task.job.output, context.options)
    with suppress(BusyError, SceneError), scene_lock(context.folder, names) as lock:
        _clean(task.job, context)
        _finish(lock, task, context)


def _finish(lock: Lock, task: Task, context: BatchContext) -> None:
    """Remove the lock's file, unless only it shows that a batch wrote the result."""
    new_records = RecordIndex(context.folder, context.start)
    new_records.read_on()
    recorded = task.known is not None or task.job.output in new_records.known
    if recorded or not os.path.lexists(context.folder / task.job.output):
        lock.finish()
