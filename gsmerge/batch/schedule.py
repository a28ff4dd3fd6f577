"""Run a batch: schedule its scenes, and keep a pool busy until every scene has ended."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from heapq import nlargest
from itertools import accumulate
from pathlib import Path
from typing import Any

from gsmerge.batch.batch_options import BatchOptions, with_whole_paths
from gsmerge.batch.find import Job
from gsmerge.batch.records import BUSY, RECORDS, STUCK, RecordIndex, check_folder
from gsmerge.batch.task import BatchContext, Task, clean_up, record_failure, run_lock, run_recorded
from gsmerge.errors import SceneError, UsageError
from gsmerge.plan import plan_whole
from gsmerge.runtime.estimate import IMPORT_SECONDS, work_seconds
from gsmerge.runtime.memory import human_bytes, machine_memory
from gsmerge.runtime.processes import ProcessPool
from gsmerge.runtime.threads import available_threads
from gsmerge.runtime.work import SMALL_STORE, Cluster, Lost, RayPool
from gsmerge.scene.content_hash import cameras_of
from gsmerge.scene.files import find_scene_files
from gsmerge.stages.segment import SceneSize

FREE_MEMORY_SHARE = 0.8  # of the free memory that is used by default
POLL_SECONDS = 0.5  # between two queries of the pool
BUSY_RETRY_SECONDS = 1.0  # until a scene that another run works on is tried again


@dataclass(frozen=True)
class Schedule:
    """Number of scenes compacted at once, with their threads and memory."""

    jobs: int  # scenes at once; 0: as many as the cluster has processors for
    threads: int  # of each
    memory: int  # bytes that the largest of them may take together
    notes: tuple[str, ...] = ()  # where it differs from the options


def make_schedule(jobs: Sequence[Job], options: BatchOptions, *, processors: int | None = None) -> Schedule:
    """Plan how many scenes run at once: one thread each if there are enough scenes, as many as memory allows."""
    processors = available_threads() if processors is None else processors
    threads = options.settings.threads
    if options.engine == "ray":
        return Schedule(options.jobs or 0, threads or 1, max((job.memory for job in jobs), default=0))
    count = options.jobs or max(1, processors // (threads or 1))
    sums = list(accumulate(nlargest(max(1, min(count, len(jobs))), (job.memory for job in jobs)))) or [0]
    limit = free_memory() if options.max_memory is None else options.max_memory
    count, notes = len(sums), []
    if limit is not None and (options.jobs is None or options.max_memory is not None):
        count = max(1, sum(total <= limit for total in sums))
        if options.jobs is not None and count < len(sums):
            notes.append(f"{count} at once instead of {len(sums)}: more may take {human_bytes(sums[count])}")
        if sums[0] > limit:
            notes.append(f"the largest scene alone may take {human_bytes(sums[0])}, the limit is {human_bytes(limit)}")
    return Schedule(count, threads or max(1, processors // count), sums[count - 1], tuple(notes))


def free_memory() -> int | None:
    """Return the share of free memory, in bytes, that a run uses by default; None if unknown."""
    with suppress(OSError, KeyError, ValueError), open("/proc/meminfo", encoding="ascii") as file:
        values = dict(line.split(":", 1) for line in file)
        return int(FREE_MEMORY_SHARE * int(values["MemAvailable"].split()[0]) * 1024)
    machine = machine_memory()
    return None if machine is None else int(FREE_MEMORY_SHARE * machine)


def estimate_seconds(jobs: Sequence[Job], options: BatchOptions, schedule: Schedule) -> float:
    """Estimate the wall time of all scenes in seconds, within a factor of about two."""

    total = 0.0
    for job in (job for job in jobs if job.num_gaussians):  # the run says what cannot be read
        views = 1  # where cameras cannot be read
        with suppress(SceneError):
            files = find_scene_files(Path(job.scene))
            cameras = None if files.cameras is None else cameras_of(files.cameras, files.ply.stem)
            views = max(1, len(cameras or ()))
        settings = options.settings if job.work is None else job.work.settings
        size = SceneSize(job.num_gaussians, views, 1, -(-job.num_gaussians // views), aligned=True, photos=True)
        with suppress(UsageError):  # the run says so
            whole = plan_whole(size, settings)
            seconds = work_seconds(
                job.num_gaussians, size.width, whole.settings(settings), photos=True, fit_steps=whole.fit.steps
            )
            total += seconds / min(schedule.threads, views)
    return IMPORT_SECONDS * bool(jobs) + total / max(1, min(schedule.jobs, len(jobs)))


def run_batch(
    jobs: Sequence[Job],
    folder: Path,
    options: BatchOptions,
    *,
    index: RecordIndex | None = None,
    schedule: Schedule | None = None,
) -> Generator[dict[str, Any], None, None]:
    """Compact scenes one by one or in parallel, skipping finished ones; yield a record for each.

    Each record is appended to ``folder/batch.jsonl`` before it is yielded, in any order, so that an interrupted run can
    be continued. Runs with the same settings may share a folder. ``index``, the folder's records, and ``schedule`` are
    made if they are not given. SceneError if the folder cannot be written, UsageError if a batch with other settings
    uses it, or the engine is not installed.
    """
    schedule = schedule or make_schedule(jobs, options)
    check_folder(folder)
    if index is None:
        index = RecordIndex(folder)
        index.read_on()
    with ExitStack() as stack:
        stack.enter_context(run_lock(folder, options.name()))
        options = replace(options, settings=replace(options.settings, threads=schedule.threads))
        context = BatchContext(folder, options, index.end)
        pool: ProcessPool | RayPool = ProcessPool(schedule.jobs, schedule.threads, timeout=options.timeout)
        if options.engine == "ray":  # scenes and output folder must have the same paths on all its nodes
            context = BatchContext(folder.absolute(), with_whole_paths(options), index.end)
            cluster = stack.enter_context(closing(Cluster(options.address, store_bytes=SMALL_STORE)))
            pool = RayPool(cluster, schedule.threads, jobs=schedule.jobs, timeout=options.timeout)
        stack.callback(lambda: clean_up(pool.close(), context))
        tasks = (Task(job, index.known.get(job.output)) for job in jobs)
        yield from dispatch(tasks, pool, context)


def dispatch(tasks: Iterator[Task], pool: ProcessPool | RayPool, context: BatchContext) -> Iterator[dict[str, Any]]:
    """Keep a pool busy until all scenes have ended; SceneError if no record can be written."""
    retried: deque[Task] = deque()  # their process died
    busy: deque[tuple[float, Task]] = deque()  # another run works on them; when to try again, and the task
    active = 0

    def next_task() -> Task | None:
        task = retried.popleft() if retried else next(tasks, None)
        if task is None and busy and busy[0][0] <= time.monotonic():
            return busy.popleft()[1]
        return task

    while True:
        while pool.has_room and (task := next_task()) is not None:
            pool.submit(task, run_recorded, task, context, memory=task.job.memory)
            active += 1
        if not active and not busy:
            return
        if not active:
            time.sleep(max(0.0, min(POLL_SECONDS, busy[0][0] - time.monotonic())))
            continue
        for task, outcome in pool.wait(POLL_SECONDS):
            active -= 1
            if isinstance(outcome, Lost):
                if task.attempt <= context.options.retries:
                    retried.append(replace(task, attempt=task.attempt + 1))
                    continue
                outcome = record_failure(task, context, outcome.reason)
            if outcome["status"] == BUSY:
                busy.append((time.monotonic() + BUSY_RETRY_SECONDS, task))
            elif outcome["status"] == STUCK:
                raise SceneError(context.folder / RECORDS, f"the batch cannot go on: {outcome['error']}")
            else:
                yield outcome
