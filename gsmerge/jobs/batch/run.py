"""Run a batch: make the result of every job that is not done, and record how each ended.

The run may be killed at any moment. A result is written completely or not at all, and its record follows at once. A
process that is killed in between leaves a result without a record. Before each result, a file is written that marks the
result as begun. This file shows that a batch made the result.
"""

from __future__ import annotations

import hashlib
import math
import os
import warnings
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext, suppress
from functools import lru_cache
from pathlib import Path
from statistics import median_low
from typing import Any

from gsmerge.errors import SceneError, count_words, error_line
from gsmerge.frozen import dataclass, replace
from gsmerge.io.atomic import atomic_output, describe_existing, remove_stale
from gsmerge.io.jsonl import append_line
from gsmerge.io.locks import lock_file
from gsmerge.jobs.batch.find import main_file
from gsmerge.jobs.batch.jobs import DISTINGUISH, BatchOptions, Job
from gsmerge.jobs.batch.records import DONE, FAILED, RECORDS, SKIPPED, DoneResult, RecordIndex, prepare_folder, record
from gsmerge.results.outputs import name_outputs
from gsmerge.runtime.documents import file_sha256, finite
from gsmerge.runtime.memory import free_memory
from gsmerge.runtime.processes import ProcessPool
from gsmerge.runtime.threads import available_threads
from gsmerge.runtime.work import SMALL_STORE, Call, Cluster, LostProcess, RayPool, WorkerPool

FREE_MEMORY_SHARE = 0.8  # scenes that run at the same time may by default take this share of the free memory


@dataclass(frozen=True)
class Concurrency:
    """How many scenes are compacted at the same time, and with how many threads each."""

    jobs: int  # 0 for as many as the cluster has processors for
    threads: int  # of each scene
    memory: float = math.inf  # bytes for all scenes at the same time; a scene that needs more runs alone

    def __str__(self) -> str:
        jobs = self.jobs or "as many as the cluster has room for"
        return f"{jobs} at once, {count_words(self.threads, 'thread')} each"


@dataclass(frozen=True)
class Run:
    """Facts that all jobs of a run share."""

    folder: Path  # output folder
    threads: int  # of each job
    overwrite: bool  # True to make all results again


def choose_concurrency(jobs: Sequence[Job], options: BatchOptions) -> Concurrency:
    """Choose by the processors and the free memory how many scenes run at the same time, with how many threads each.

    The free memory limits how many scenes run at once, as if every scene had the median size. While scenes larger than
    the median run, fewer scenes run at the same time.
    """
    threads = options.settings.threads
    processors = available_threads()
    if options.engine == "ray":
        return Concurrency(options.jobs or 0, threads or 1)
    free = math.inf if options.jobs else free_memory() or math.inf
    most = FREE_MEMORY_SHARE * free / median_low([job.memory for job in jobs] or [1])
    count = max(1, min(int(options.jobs or min(processors // (threads or 1), most)), len(jobs)))
    return Concurrency(count, threads or max(1, processors // count), FREE_MEMORY_SHARE * free)


def pending_jobs(jobs: Sequence[Job], folder: Path, options: BatchOptions) -> list[tuple[Job, str | None]]:
    """List the jobs that a run would take on, each with the reason if it would refuse the job, or None.

    A run takes on the jobs whose results are not done, and with ``overwrite`` all jobs.
    """
    results = RecordIndex(folder).read_on().results
    pending = list[tuple[Job, str | None]]()
    for job in jobs:
        known = results.get(job.output)
        try:
            key = job.call.key(job.find_files())
            if options.overwrite or known is None or not known.holds(folder, key):
                pending.append((job, refusal(job, folder, known, key, overwrite=options.overwrite)))
        except Exception as error:  # a bad scene must not end the list
            pending.append((job, _record_failure(job, folder, error_line(error))["error"]))
    return pending


def _record_failure(job: Job, folder: Path, reason: str) -> dict[str, Any]:
    """Return the record of a failure, which says if an earlier result of the scene stays in the folder."""
    known = read_run_index(folder).read_on().results.get(job.output)
    is_kept = known is not None and known.scene == job.scene and os.path.lexists(folder / job.output)
    return record(
        FAILED, job.scene, job.output, error=reason + f"; its earlier result {folder / job.output} stays" * is_kept
    )


def refusal(
    job: Job, folder: Path, known: DoneResult | None, key: str, *, overwrite: bool, begun: bool = False
) -> str | None:
    """Return why a result must not be made, or None if the result can be made.

    ``known`` is the recorded result of this name, and ``key`` is the key of the result to make. ``begun`` is True if a
    killed run may have left files without a record.
    """
    recorded_names = () if known is None else [file["path"] for file in known.files]
    foreign = [folder / name for name in job.outputs if os.path.lexists(folder / name) and name not in recorded_names]
    scene, _, settings = key.partition(".")
    known_scene, _, known_settings = ("" if known is None else known.key).partition(".")
    if job.clash and (foreign or known_scene != scene):
        return job.clash
    if overwrite:
        return None
    if foreign and not begun:
        return (
            f"{foreign[0]}: {describe_existing(foreign[0])} and was not written by a batch;"
            f" {'pass --overwrite to replace it' if foreign[0].is_file() or foreign[0].is_symlink() else 'rename it'}"
        )
    if known is None or not os.path.lexists(folder / job.output):
        return None
    if (
        known_scene != scene
        and os.path.exists(known.scene)
        and len({os.path.realpath(main_file(Path(path))) for path in (known.scene, job.scene)}) == 2
    ):
        return (
            f"{folder / job.output}: is the result of {known.scene}, which is another scene; {DISTINGUISH}, or pass"
            " --overwrite to replace it"
        )
    return None if known_settings == settings else (
        f"{folder / job.output}: was made with other settings; pass --overwrite to make it again, or name another"
        " --output"
    )  # fmt: skip


def run_batch(jobs: Sequence[Job], folder: Path, options: BatchOptions) -> Generator[dict[str, Any], None, None]:
    """Make the results of all jobs in a folder, several at a time; yield the record of each job as it ends.

    The record of a job that was done before says "skipped". Several runs may share a folder. Jobs on which another run
    works come last. A caller that closes the generator ends the processes. SceneError if the folder cannot be written,
    UsageError if Ray is not installed.
    """
    concurrency = choose_concurrency(jobs, options)
    prepare_folder(folder)
    run, active = Run(folder, concurrency.threads, options.overwrite), dict[str, Job]()  # jobs in the pool, by scene
    with ExitStack() as stack:
        stack.callback(lambda: remove_unfinished(run, active.values()))
        pool: WorkerPool = ProcessPool(concurrency.jobs, concurrency.threads, concurrency.memory)
        if options.engine == "ray":
            cluster = stack.enter_context(closing(Cluster(options.address, store_bytes=SMALL_STORE)))
            pool = RayPool(cluster, concurrency.threads, jobs=concurrency.jobs)
        stack.enter_context(closing(pool))

        def make_calls(jobs: Sequence[Job], *, wait: bool) -> Iterator[Call]:
            for job in jobs:
                active[job.scene] = job
                yield Call(job, (job, run, wait), job.memory)

        # A scene that needs more than its share of the memory makes others wait, so it comes last
        remaining = sorted(jobs, key=lambda job: job.memory * concurrency.jobs > concurrency.memory)
        wait = False
        while remaining:
            busy: list[Job] = []
            for job, outcome in pool.run(run_job, make_calls(remaining, wait=wait)):
                del active[job.scene]
                line = run_job(job, run, False, outcome.reason) if isinstance(outcome, LostProcess) else outcome
                if line is None:
                    busy.append(job)
                else:
                    yield line
            remaining = busy
            wait = True


def run_job(job: Job, run: Run, wait: bool, lost: str | None = None) -> dict[str, Any] | None:
    """Make a result unless it is done, record the outcome, and return the record.

    If another process works on the result, the call waits for it, or returns None without ``wait``. ``lost`` says why
    the process that should make the result has ended. If ``lost`` is given, only this failure is recorded. SceneError
    if the record cannot be written.
    """
    with lock_result(run.folder, job.output, wait=wait) as mark:
        if mark is None:
            return None
        _remove_unfinished_files(job, run, mark)
        try:
            line = _make_result(job, run, mark) if lost is None else _record_failure(job, run.folder, lost)
        except Exception as error:  # a bad scene must not end the batch
            line = _record_failure(job, run.folder, error_line(error))
        if line["status"] != SKIPPED:
            append_line(run.folder / RECORDS, line)
        if lost is None:
            mark.unlink(missing_ok=True)
    return line


def _make_result(job: Job, run: Run, mark: Path) -> dict[str, Any]:
    """Make a result, unless it is done or refused, and return its record. The caller has locked the result."""
    files = job.find_files()
    key = job.call.key(files)
    known = read_run_index(run.folder).read_on().results.get(job.output)
    if known is not None and not run.overwrite and known.holds(run.folder, key):
        return record(
            SKIPPED, job.scene, job.output, key=key, files=known.files, doubts=known.doubts, unmet=known.unmet
        )  # fmt: skip
    refused = refusal(job, run.folder, known, key, overwrite=run.overwrite, begun=mark.exists())
    if refused:
        return record(FAILED, job.scene, job.output, key=key, error=refused)
    outputs = name_outputs(run.folder / job.output, overwrite=True)
    if (cameras := outputs.viewer_cameras) is not None:
        # A camera file of this name may be the input's, or may belong to a result of the same name in another format
        owns_cameras = known is not None and any(run.folder / file["path"] == cameras for file in known.files)
        writes_cameras = os.path.realpath(cameras) not in map(os.path.realpath, files.paths) and (
            owns_cameras or run.overwrite or not os.path.lexists(cameras)
        )
        outputs = outputs if writes_cameras else replace(outputs, viewer_cameras=None)
    with atomic_output(mark, overwrite=True) as temporary:  # the mark is on the disk before the result
        temporary.write_text(f"{os.getpid()}\n")
    with warnings.catch_warnings(record=True) as caught_warnings:
        warnings.simplefilter("default")
        document, written = job.call.run(files, outputs, run.threads)
    document["notes"] += list(dict.fromkeys(str(warning.message) for warning in caught_warnings))
    facts = [
        {"path": Path(os.path.relpath(path, run.folder)).as_posix(), "sha256": file_sha256(path)}
        | {"bytes": path.stat().st_size}
        for path in written
    ]
    return record(
        DONE, job.scene, job.output, key=key, files=facts,
        doubts=document["doubts"], unmet=document["unmet"], report=finite(document),
    )  # fmt: skip


@lru_cache(maxsize=1)
def read_run_index(folder: Path) -> RecordIndex:
    """Return the index of a folder's records, which a process keeps for all its jobs."""
    return RecordIndex(folder)


def remove_unfinished(run: Run, jobs: Iterable[Job]) -> None:
    """Remove the unfinished files of jobs that no process works on any more."""
    for job in jobs:
        with suppress(SceneError), lock_result(run.folder, job.output, wait=False) as mark:
            if mark is not None:
                _remove_unfinished_files(job, run, mark)


def _remove_unfinished_files(job: Job, run: Run, mark: Path) -> None:
    """Remove the files that a killed process left of a job.

    The file ``mark`` stays if the result exists, since the result may lack a record.
    """
    if mark.exists():
        paths = [run.folder / name for name in job.outputs]
        for folder in {path.parent for path in paths}:
            remove_stale(folder)
        if not any(map(os.path.lexists, paths)):
            mark.unlink()


@contextmanager
def lock_result(folder: Path, output: str, *, wait: bool) -> Iterator[Path | None]:
    """Lock a result against other processes while the block runs.

    Raises SceneError if the result cannot be locked. Yields the path of the file that marks the result as begun. If
    another process has locked the result, the call waits for it, or yields None without ``wait``. A folder that cannot
    be written needs no lock, because no result is made in it.
    """
    name = hashlib.sha256(output.encode(errors="surrogateescape")).hexdigest()[:32]
    lock = lock_file(folder / f".batch-{name}.lock", wait=wait) if os.access(folder, os.W_OK) else nullcontext(True)
    with lock as is_ours:
        yield folder / f".batch-{name}.begun" if is_ours else None
