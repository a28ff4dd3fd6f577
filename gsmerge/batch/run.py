"""Run a batch: make the call of every job, unless its result is done, and record how it ended.

A kill is safe at any moment. Results are whole or not there, and are recorded right after; what a killed process leaves
besides is the lock of its result, which says that a result without a record is of a batch.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import warnings
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from io import FileIO
from pathlib import Path
from typing import Any

from gsmerge.batch.jobs import BatchOptions, Job
from gsmerge.batch.records import DONE, FAILED, RECORDS, SKIPPED, RecordIndex, check_folder, record
from gsmerge.batch.schedule import make_schedule
from gsmerge.errors import SceneError, UsageError, error_line
from gsmerge.io.atomic import remove_stale
from gsmerge.io.jsonl import append_line
from gsmerge.report import file_sha256, finite
from gsmerge.runtime.processes import ProcessPool
from gsmerge.runtime.work import SMALL_STORE, Call, Cluster, Lost, Pool, RayPool


@dataclass(frozen=True)
class Run:
    """What all jobs of a run share."""

    folder: Path  # of the results
    start: int  # size of its records when the run began
    threads: int  # of a call
    overwrite: bool


def run_batch(jobs: Sequence[Job], folder: Path, options: BatchOptions) -> Generator[dict[str, Any], None, None]:
    """Make the results of all jobs in a folder, several at once; yield the record of each as it ends.

    Jobs that are done already are yielded as skipped. Several runs may share a folder; jobs that another run works on
    come last. Close the generator to end the processes. SceneError if the folder cannot be written; UsageError if Ray
    is not installed.
    """
    schedule = make_schedule(jobs, options)
    run = Run(folder, check_folder(folder), schedule.threads, options.overwrite)
    active: dict[str, Job] = {}
    with ExitStack() as stack:
        stack.callback(lambda: remove_unfinished(run, active.values()))
        pool: Pool = ProcessPool(schedule.jobs, schedule.threads)
        if options.engine == "ray":
            cluster = stack.enter_context(closing(Cluster(options.address, store_bytes=SMALL_STORE)))
            pool = RayPool(cluster, schedule.threads, jobs=schedule.jobs)
        stack.enter_context(closing(pool))

        def each_call(jobs: Sequence[Job], *, wait: bool) -> Iterator[Call]:
            for job in jobs:
                active[job.output] = job
                yield Call(job, (job, run, wait), job.memory)

        left, wait = jobs, False
        while left:
            busy: list[Job] = []
            for job, outcome in pool.run(make_result, each_call(left, wait=wait)):
                del active[job.output]
                line = record_loss(job, run, outcome.reason) if isinstance(outcome, Lost) else outcome
                if line is None:
                    busy.append(job)
                else:
                    yield line
            left, wait = busy, True


def make_result(job: Job, run: Run, wait: bool) -> dict[str, Any] | None:
    """Make a result unless it is done, record the outcome, and return the record.

    ``wait``: wait for another process that works on the result; otherwise return None. SceneError if nothing can be
    recorded.
    """
    with lock_result(run.folder, job.output, wait=wait) as lock:
        if lock is None:
            return None
        _clean(job, run, lock)
        try:
            line = _make(job, run, lock)
        except Exception as error:  # a bad scene must not end the batch
            line = record(FAILED, job.scene, job.output, error=error_line(error))
        if line["status"] != SKIPPED:
            append_line(run.folder / RECORDS, line)
        lock.is_left = False
    return line


def _make(job: Job, run: Run, lock: ResultLock) -> dict[str, Any]:
    files = job.find_files()
    key, known = job.call.key(files), read_index(run.folder, run.start).read_on().results.get(job.output)
    is_new = known is not None and known.end > run.start  # by another run, or process of this one
    if known is not None and (is_new or not run.overwrite) and known.holds(run.folder, key):
        return record(SKIPPED, job.scene, job.output, key=key, files=known.files, worse=known.worse)
    if known is not None and is_new and known.key not in (key, ""):
        problem = "another run with other settings has made it meanwhile; wait for that run, or name another --output"
        raise UsageError(f"{run.folder / job.output}: {problem}")
    names = () if known is None else [file["path"] for file in known.files]
    foreign = [name for name in job.outputs if os.path.lexists(run.folder / name) and name not in names]
    if foreign and not lock.is_left and not run.overwrite:
        problem = "exists already, and no batch wrote it; pass --overwrite to replace it"
        raise UsageError(f"{run.folder / foreign[0]}: {problem}")
    lock.leave_if_killed()
    out = run.folder / job.output
    out.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        document, written = job.call.run(files, out, run.threads)
    document["notes"] += list(dict.fromkeys(str(warning.message) for warning in caught))
    made = [
        {"path": os.path.relpath(path, run.folder), "sha256": file_sha256(path), "bytes": path.stat().st_size}
        for path in written
    ]
    return record(DONE, job.scene, job.output, key=key, files=made, report=finite(document))


@lru_cache(maxsize=1)
def read_index(folder: Path, start: int) -> RecordIndex:
    """Return the index of a folder's records, which each process keeps between the calls of a run."""
    return RecordIndex(folder)


def record_loss(job: Job, run: Run, reason: str) -> dict[str, Any] | None:
    """Record the failure of a job whose process died; None if another process works on it now."""
    with lock_result(run.folder, job.output, wait=False) as lock:
        if lock is None:
            return None
        line = record(FAILED, job.scene, job.output, error=reason)
        _clean(job, run, lock)
        append_line(run.folder / RECORDS, line)
    return line


def remove_unfinished(run: Run, jobs: Iterable[Job]) -> None:
    """Remove the unfinished files of jobs whose processes were ended on purpose."""
    for job in jobs:
        with suppress(SceneError), lock_result(run.folder, job.output, wait=False) as lock:
            if lock is not None:
                _clean(job, run, lock)


def _clean(job: Job, run: Run, lock: ResultLock) -> None:
    """Remove the files of a killed process, except the lock of a result that may have no record yet."""
    if lock.is_left:
        paths = [run.folder / name for name in job.outputs]
        for folder in {path.parent for path in paths}:
            remove_stale(folder)
        lock.is_left = any(map(os.path.lexists, paths))


@dataclass
class ResultLock:
    """A locked file of a result, which is left behind by a process that is killed while it makes the result."""

    file: FileIO
    is_left: bool  # whether a process has left it; whether this one leaves it

    def leave_if_killed(self) -> None:
        """Write the process number into the lock file, so that a kill leaves proof that a batch made the result."""
        self.file.write(f"{os.getpid()}\n".encode())
        os.fsync(self.file.fileno())  # on the disk before the result
        self.is_left = True


@contextmanager
def lock_result(folder: Path, output: str, *, wait: bool) -> Iterator[ResultLock | None]:
    """Lock a result against other processes in the block; SceneError if that fails.

    ``wait``: wait until another process releases it; otherwise yield None.
    """
    name = hashlib.sha256(output.encode(errors="surrogateescape")).hexdigest()[:32]
    path = folder / f".batch-{name}.lock"
    try:
        file = _open_locked(path, wait=wait)
    except OSError as error:
        raise SceneError(path, f"cannot be written ({error.strerror})", "name another folder with --output") from error
    if file is None:
        yield None
        return
    with file:
        lock = ResultLock(file, is_left=bool(os.fstat(file.fileno()).st_size))
        try:
            yield lock
        finally:
            if not lock.is_left:  # removed before the release: who waits for it sees that it is nobody's any more
                path.unlink(missing_ok=True)


def _open_locked(path: Path, *, wait: bool) -> FileIO | None:
    while True:
        file = FileIO(path, "ab")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            file.close()
            return None
        if os.fstat(file.fileno()).st_nlink:
            return file
        file.close()
