"""One scene: skipped if it is done, else compacted and recorded, and nothing in between that a kill could spoil."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsmerge import __version__
from gsmerge.batch.find import Job, further_outputs
from gsmerge.batch.locks import BusyError, Lock, scene_lock
from gsmerge.batch.options import BatchOptions
from gsmerge.batch.records import (
    BUSY,
    DONE,
    FAILED,
    RECORDS,
    SKIPPED,
    STUCK,
    Index,
    Known,
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
    """A scene to be worked on.

    Args:
        job: The scene.
        known: What former runs left of it; None: nothing.
        attempt: From 1.
    """

    job: Job
    known: Known | None
    attempt: int = 1


@dataclass(frozen=True)
class Work:
    """What all tasks of a run share.

    Args:
        folder: The output folder.
        options: Of the run; the threads of a scene are settled.
        start: Byte of the records up to which the tasks know them.
    """

    folder: Path
    options: BatchOptions
    start: int


def run_task(task: Task, work: Work, later: Index) -> dict[str, Any]:
    """Work on a scene.

    Args:
        task: The scene.
        work: How.
        later: What was recorded since the run began, kept by the process from task to task.

    Returns:
        Its record; of what is not recorded the ``status`` tells: skipped, busy (another process works on it), or
        stuck (records cannot be written).
    """
    job = task.job
    try:
        with scene_lock(work.folder, _outputs(job, work.options)) as lock:
            try:
                later.read_on()
                found = _worked(task, work, later, lock)
            except Exception as error:  # a bad scene must not end the batch
                found = record(FAILED, job.scene, job.output, error=error_line(error), attempt=task.attempt)
            known = later.known.get(job.output, task.known)
            if found["status"] != SKIPPED or (known is not None and known.failed_since):
                append_line(work.folder / RECORDS, found)
            lock.finish()
            return found
    except BusyError:
        return record(BUSY, job.scene, job.output)
    except SceneError as error:  # locks or records cannot be written: no scene can be done
        return record(STUCK, job.scene, job.output, error=str(error))


def _worked(task: Task, work: Work, later: Index, lock: Lock) -> dict[str, Any]:
    """The scene's record, with its files in place."""
    job, options = task.job, work.options
    if lock.abandoned:
        _clean(job, work)
    files = _files_of(job, options)
    key = scene_key(files, options)
    before, since = task.known, later.known.get(job.output)
    for known in (since, None if options.rerun else before):
        if known is not None and known.holds(work.folder, key):
            return record(SKIPPED, job.scene, job.output, key=key, files=_as_written(work.folder, known))
    own = {name for known in (before, since) if known is not None for name, _ in known.files}
    for name in _outputs(job, options):
        if os.path.lexists(work.folder / name) and name not in own and not (lock.fresh or options.overwrite):
            problem = "exists already, and no batch wrote it; pass --overwrite to replace it"
            raise UsageError(f"{work.folder / name}: {problem}")
    return _compacted(task, work, files, key)


def _compacted(task: Task, work: Work, files: SceneFiles, key: str) -> dict[str, Any]:
    job, options = task.job, work.options
    out = work.folder / job.output
    out.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("default")
        document = compact_files(
            files, options.settings, out, opacity=options.opacity, hints=options.hints, overwrite=True, hashed=True
        )
    document["notes"] += list(dict.fromkeys(str(warning.message) for warning in told))
    names = [job.output, *(os.path.relpath(level["path"], work.folder) for level in document["levels"])]
    facts = {"key": key, "files": written_files(work.folder, names), "report": finite(document)}
    return record(DONE, job.scene, job.output, attempt=task.attempt, **facts)


def _outputs(job: Job, options: BatchOptions) -> list[str]:
    """Names of the result and of its further levels."""
    return [job.output, *further_outputs(job.output, options.settings.budget.levels)]


def _as_written(folder: Path, known: Known) -> list[dict[str, Any]]:
    return [{"path": name, "sha256": sha, "bytes": (folder / name).stat().st_size} for name, sha in known.files]


def _files_of(job: Job, options: BatchOptions) -> SceneFiles:
    scene = Path(job.scene)
    return find_scene_files(scene, cameras=filled(options.cameras, scene), images=filled(options.images, scene))


def scene_key(files: SceneFiles, options: BatchOptions) -> str:
    """What a result is known by: everything that is read, all settings, and the version."""
    told: dict[str, Any] = {"scene": content_hash(read_files(files)), **options.told()}
    checkpoint = Path(options.settings.checkpoint)
    if options.settings.checkpoint not in CHECKPOINTS and checkpoint.is_file():  # by what is in it, wherever it lies
        told["settings"]["checkpoint"] = file_sha256(checkpoint)
    return digest({**told, "tool_version": __version__, "schema_version": SCHEMA_VERSION})


def is_done(job: Job, known: Known, work: Work) -> bool:
    """Whether a result would be skipped."""
    try:
        return known.holds(work.folder, scene_key(_files_of(job, work.options), work.options))
    except SceneError:
        return False


def _clean(job: Job, work: Work) -> None:
    """Remove what a killed process left beside a result and its further levels."""
    for path in (work.folder / name for name in _outputs(job, work.options)):
        if path.parent.is_dir():
            remove_leftovers(path)


def give_up(task: Task, work: Work, error: str) -> dict[str, Any]:
    """The record of a scene whose process died or took too long, as often as may be."""
    job = task.job
    failed = record(FAILED, job.scene, job.output, error=error, attempt=task.attempt)
    try:
        with scene_lock(work.folder, _outputs(job, work.options)) as lock:
            _clean(job, work)
            append_line(work.folder / RECORDS, failed)
            _finish(lock, task, work)
    except BusyError:
        return record(BUSY, job.scene, job.output)
    except SceneError as stuck:
        return record(STUCK, job.scene, job.output, error=str(stuck))
    return failed


def tidy(task: Task, work: Work) -> None:
    """Remove what is left of a scene whose process was ended on purpose."""
    try:
        with scene_lock(work.folder, _outputs(task.job, work.options)) as lock:
            _clean(task.job, work)
            _finish(lock, task, work)
    except (BusyError, SceneError):
        return  # somebody else sees to it, or the next run does


def _finish(lock: Lock, task: Task, work: Work) -> None:
    """The lock's file goes, unless it is all that says that a result is ours."""
    later = Index(work.folder, work.start)
    later.read_on()
    recorded = task.known is not None or task.job.output in later.known
    if recorded or not os.path.lexists(work.folder / task.job.output):
        lock.finish()


def with_threads(options: BatchOptions, threads: int) -> BatchOptions:
    """The options with the threads of a scene settled."""
    return replace(options, settings=replace(options.settings, threads=threads))
