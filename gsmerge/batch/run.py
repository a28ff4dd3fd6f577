"""The batch: scenes are dispatched to a pool, tried again if their process died, and reported as they end."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from gsmerge.batch.find import Job
from gsmerge.batch.local import LocalPool
from gsmerge.batch.locks import run_lock
from gsmerge.batch.options import BatchOptions
from gsmerge.batch.plan import Schedule, make_schedule
from gsmerge.batch.records import BUSY, LOST, RECORDS, STUCK, RecordIndex, check_folder
from gsmerge.batch.task import BatchContext, Task, record_failure
from gsmerge.errors import SceneError

POLL_SECONDS = 0.5  # between two queries of the pool
BUSY_RETRY_SECONDS = 1.0  # until a scene that another run works on is tried again


class Pool(Protocol):
    """Where scenes are compacted."""

    @property
    def has_room(self) -> bool:
        """Whether another scene can be taken."""

    def submit(self, task: Task) -> None:
        """Take a scene."""

    def wait(self, seconds: float) -> list[tuple[Task, dict[str, Any]]]:
        """Scenes that ended, after at most so many seconds, and their outcomes."""

    def close(self) -> None:
        """End all processes; unfinished scenes are left as they were."""


def run_batch(
    jobs: Sequence[Job],
    folder: Path,
    options: BatchOptions,
    *,
    index: RecordIndex | None = None,
    schedule: Schedule | None = None,
) -> Generator[dict[str, Any], None, None]:
    """Compact scenes, each on its own; those that are done are skipped.

    Each is recorded in ``folder/batch.jsonl`` before its record is yielded, in any order, so that a run that ends at
    any moment can be continued. Runs with the same settings may share a folder: each scene is compacted by one of them.
    ``index``, the folder's records, and ``schedule`` are made if they are not given.

    Raises:
        SceneError: If the folder cannot be written.
        UsageError: If a batch with other settings uses the folder, or the engine is not installed.
    """
    schedule = schedule or make_schedule(jobs, options)
    check_folder(folder)
    if index is None:
        index = RecordIndex(folder)
        index.read_on()
    with ExitStack() as stack:
        stack.enter_context(run_lock(folder, options.name()))
        pool, context = _pool(folder, options, schedule, index.end)
        stack.callback(pool.close)
        yield from dispatch((Task(job, index.known.get(job.output)) for job in jobs), pool, context)


def _pool(folder: Path, options: BatchOptions, schedule: Schedule, start: int) -> tuple[Pool, BatchContext]:
    """Where the scenes are compacted, and what they share."""
    options = replace(options, settings=replace(options.settings, threads=schedule.threads))
    if options.engine == "ray":
        from gsmerge.batch.ray_engine import RayPool, with_whole_paths

        context = BatchContext(folder.absolute(), with_whole_paths(options), start)
        return RayPool(context, schedule.jobs), context
    context = BatchContext(folder, options, start)
    return LocalPool(context, schedule.jobs), context


def dispatch(tasks: Iterator[Task], pool: Pool, context: BatchContext) -> Iterator[dict[str, Any]]:
    """Keep a pool busy until every scene has ended; a SceneError if nothing can be recorded any more."""
    retried: deque[Task] = deque()  # their process died
    busy: deque[tuple[float, Task]] = deque()  # another run works on them; when to try again, and the task
    active = 0
    while True:
        while pool.has_room and (task := _next(tasks, retried, busy)) is not None:
            pool.submit(task)
            active += 1
        if not active and not busy:
            return
        if not active:
            time.sleep(max(0.0, min(POLL_SECONDS, busy[0][0] - time.monotonic())))
            continue
        for task, outcome in pool.wait(POLL_SECONDS):
            active -= 1
            if outcome["status"] == LOST and task.attempt <= context.options.retries:
                retried.append(replace(task, attempt=task.attempt + 1))
                continue
            if outcome["status"] == LOST:
                outcome = record_failure(task, context, outcome["error"])
            if outcome["status"] == BUSY:
                busy.append((time.monotonic() + BUSY_RETRY_SECONDS, task))
            elif outcome["status"] == STUCK:
                raise SceneError(context.folder / RECORDS, f"the batch cannot go on: {outcome['error']}")
            else:
                yield outcome


def _next(tasks: Iterator[Task], retried: deque[Task], busy: deque[tuple[float, Task]]) -> Task | None:
    """The next task: first the lost ones, then new ones, then those that other runs had; None if there is none yet."""
    if retried:
        return retried.popleft()
    task = next(tasks, None)
    if task is None and busy and busy[0][0] <= time.monotonic():
        return busy.popleft()[1]
    return task
