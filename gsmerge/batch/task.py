"""Compact one scene of a batch, unless it is done, and record it.

A kill is safe at any moment: locks on a scene and on the folder end with their process.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import socket
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from gsmerge import __version__
from gsmerge.batch.batch_options import BatchOptions
from gsmerge.batch.find import Job, result_names
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
)
from gsmerge.compaction.files import Outputs, compact_files
from gsmerge.errors import SceneError, UsageError, error_line
from gsmerge.io.atomic import remove_stale
from gsmerge.io.jsonl import append_line
from gsmerge.report import SCHEMA_VERSION, file_sha256, finite
from gsmerge.scene.content_hash import content_hash, digest, filled, read_files
from gsmerge.scene.files import SceneFiles, find_scene_files
from gsmerge.settings.compact import CHECKPOINTS

PREFIX = ".batch-"  # of the names of all files here, which are in the output folder
RUN_TIMEOUT = 10.0  # seconds: other runs look at the lock of a run for an instant only


@dataclass(frozen=True)
class Task:
    """A scene to compact, with its former result and the number of the attempt."""

    job: Job  # the scene
    known: DoneResult | None  # its result of former runs; None without one
    attempt: int = 1  # from 1


@dataclass(frozen=True)
class BatchContext:
    """The folder and the options that all tasks of a run share."""

    folder: Path  # the output folder
    options: BatchOptions  # of the run, with the threads of a scene
    start: int  # byte of the records up to which ``Task.known`` was read


def run_task(task: Task, context: BatchContext, new_records: RecordIndex) -> dict[str, Any]:
    """Compact a scene, unless it is done, and return its record; ``new_records``: those since the run began.

    The ``status`` of a record that is not written is skipped, busy (another process has the scene), or stuck (records
    cannot be written).
    """
    job = task.job

    def work(begun: Path) -> dict[str, Any]:
        try:
            new_records.read_on()
            outcome = _process(task, context, new_records, begun)
        except Exception as error:  # a bad scene must not end the batch
            outcome = record(FAILED, job.scene, job.output, error=error_line(error), attempt=task.attempt)
        done = new_records.known.get(job.output, task.known)
        if outcome["status"] != SKIPPED or (done is not None and done.failed_since):
            append_line(context.folder / RECORDS, outcome)
        begun.unlink(missing_ok=True)
        return outcome

    return _locked(job, context, work)


def run_recorded(task: Task, context: BatchContext) -> dict[str, Any]:
    """Compact a scene with an index of new records that the process keeps between calls; see :func:`run_task`."""
    return run_task(task, context, make_index(context.folder, context.start))


@lru_cache(maxsize=1)
def make_index(folder: Path, start: int) -> RecordIndex:
    """Return the index of records since the run began; one per process."""
    return RecordIndex(folder, start)


def _locked(job: Job, context: BatchContext, work: Callable[[Path], dict[str, Any]]) -> dict[str, Any]:
    """Work under the scene's lock; the record says if another process has it."""
    try:
        with scene_lock(context.folder, job.output) as begun:
            return work(begun)
    except BusyError:
        return record(BUSY, job.scene, job.output)
    except SceneError as error:  # locks or records cannot be written, whatever the scene
        return record(STUCK, job.scene, job.output, error=str(error))


def _process(task: Task, context: BatchContext, new_records: RecordIndex, begun: Path) -> dict[str, Any]:
    """Skip or compact a scene, and return its record."""
    job, options = task.job, context.options
    files = _files_of(job, options)
    key = _key_of(job, files, options)
    before, since = task.known, new_records.known.get(job.output)
    for done in (since, None if options.rerun else before):
        if done is not None and done.holds(context.folder, key):
            files_of = _describe(context.folder, done.files)
            return record(SKIPPED, job.scene, job.output, key=key, files=files_of, worse=done.worse)
    result_files = {name for done in (before, since) if done is not None for name, _ in done.files}
    names = [name for name in result_names(job.output, options) if os.path.lexists(context.folder / name)]
    foreign = [] if begun.exists() else [name for name in names if name not in result_files]
    if foreign and not options.overwrite:
        problem = "exists already, and no batch wrote it; pass --overwrite to replace it"
        raise UsageError(f"{context.folder / foreign[0]}: {problem}")
    if not foreign:
        try:
            begun.write_text(f"{os.getpid()} {socket.gethostname()}", encoding="utf-8")
        except OSError as error:
            raise SceneError(context.folder, f"could not be written to ({error.strerror})") from error
    return _compact(task, context, files, key)


def _compact(task: Task, context: BatchContext, files: SceneFiles, key: str) -> dict[str, Any]:
    job, options = task.job, context.options
    out = context.folder / job.output
    out.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        if job.work is None:
            document = compact_files(
                files,
                options.settings,
                Outputs(out, overwrite=True),
                opacity=options.opacity,
                hints=options.hints,
                hashed=True,
            )
            written = [out, *(Path(level["path"]) for level in document["levels"])]
        else:
            document, written = job.work.run(files, options, out)
    document["notes"] += list(dict.fromkeys(str(warning.message) for warning in caught))
    hashes = [(os.path.relpath(path, context.folder), file_sha256(path)) for path in written]
    facts = {"key": key, "files": _describe(context.folder, hashes), "report": finite(document)}
    return record(DONE, job.scene, job.output, attempt=task.attempt, **facts)


def _describe(folder: Path, hashes: Iterable[tuple[str, str]]) -> list[dict[str, Any]]:
    """Return name, hash and size of files, as records have them, from names in a folder and hashes."""
    return [{"path": name, "sha256": sha256, "bytes": (folder / name).stat().st_size} for name, sha256 in hashes]


def _files_of(job: Job, options: BatchOptions) -> SceneFiles:
    scene = Path(job.scene)
    return find_scene_files(scene, cameras=filled(options.cameras, scene), images=filled(options.images, scene))


def _key_of(job: Job, files: SceneFiles, options: BatchOptions) -> str:
    return scene_key(files, options) if job.work is None else job.work.key(options)


def scene_key(files: SceneFiles, options: BatchOptions) -> str:
    """Return a digest of everything a result depends on: files, settings, version."""
    content: dict[str, Any] = {"scene": content_hash(read_files(files)), **options.result_settings()}
    checkpoint = Path(options.settings.checkpoint)
    if options.settings.checkpoint not in CHECKPOINTS and checkpoint.is_file():  # by its content, wherever it is
        content["settings"]["checkpoint"] = file_sha256(checkpoint)
    return digest({**content, "tool_version": __version__, "schema_version": SCHEMA_VERSION})


def is_done(task: Task, context: BatchContext) -> bool:
    """Return whether a scene's known result is up to date, so that the scene is skipped."""
    try:
        files = _files_of(task.job, context.options)
        return task.known is not None and task.known.holds(context.folder, _key_of(task.job, files, context.options))
    except SceneError:
        return False


def record_failure(task: Task, context: BatchContext, error: str) -> dict[str, Any]:
    """Record a scene whose process died or timed out, after all retries."""
    failed = record(FAILED, task.job.scene, task.job.output, error=error, attempt=task.attempt)

    def work(begun: Path) -> dict[str, Any]:
        _clean(task.job, context, begun)
        append_line(context.folder / RECORDS, failed)
        return failed

    return _locked(task.job, context, work)


def clean_up(tasks: Iterable[Task], context: BatchContext) -> None:
    """Remove the unfinished files of scenes whose processes were ended on purpose."""
    for task in tasks:
        with suppress(BusyError, SceneError, OSError), scene_lock(context.folder, task.job.output) as begun:
            _clean(task.job, context, begun)


def _clean(job: Job, context: BatchContext, begun: Path) -> None:
    """Remove the files that a killed process left, except the mark of a finished result."""
    paths = [context.folder / name for name in result_names(job.output, context.options)]
    for folder in {path.parent for path in paths}:
        remove_stale(folder)
    if not any(os.path.lexists(path) for path in paths):
        begun.unlink(missing_ok=True)


class BusyError(Exception):
    """Another process holds the lock of the scene."""


@contextmanager
def scene_lock(folder: Path, output: str) -> Iterator[Path]:
    """Lock a result against other processes in the block; BusyError if it is locked, SceneError if locking fails.

    Yields the path of a file that marks a result as begun; a killed process leaves it behind.
    """
    name = hashlib.sha256(output.encode(errors="surrogateescape")).hexdigest()[:32]
    with _lock(folder / f"{PREFIX}{name}.lock"):
        yield folder / f"{PREFIX}{name}.begun"


@contextmanager
def run_lock(folder: Path, name: str) -> Iterator[None]:
    """Lock the folder in the block against runs of another :meth:`BatchOptions.name`.

    UsageError if a run of another name uses the folder, SceneError if the lock cannot be made.
    """
    lock_name = f"{PREFIX}{name[:32]}.{secrets.token_hex(4)}.{os.getpid()}.{socket.gethostname()}.run"
    with _lock(folder / lock_name, RUN_TIMEOUT):  # before others are looked for: of two, one sees the other
        for path in folder.glob(f"{PREFIX}*.run"):
            if path.name == lock_name:
                continue
            try:
                with _lock(path):  # which removes what a killed run left
                    continue
            except BusyError:
                if path.name.startswith(f"{PREFIX}{name[:32]}."):
                    continue
                *_, process, host = path.stem.removeprefix(PREFIX).split(".", 3)
                raise UsageError(
                    f"{folder}: a batch with other settings is at work there (process {process} on {host}); wait for"
                    " it, or name another --output"
                ) from None
        yield


@contextmanager
def _lock(path: Path, seconds: float = 0.0) -> Iterator[None]:
    """Lock a file that is removed after the block; BusyError if another process keeps it."""
    lock = FileLock(path)
    try:
        lock.acquire(timeout=seconds)
    except Timeout:
        raise BusyError from None
    except OSError as error:
        raise SceneError(path, f"cannot be written ({error.strerror})", "name another folder with --output") from error
    try:
        yield
    finally:
        path.unlink(missing_ok=True)  # before the release: who waits for it sees that the file is nobody's any more
        lock.release()
