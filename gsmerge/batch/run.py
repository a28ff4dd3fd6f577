"""The batch: scenes are handed out, tried again where their process died, and told of as they are done."""

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
from gsmerge.batch.plan import Shape, make_shape
from gsmerge.batch.records import BUSY, LOST, RECORDS, STUCK, Index, check_folder
from gsmerge.batch.task import Task, Work, give_up, with_threads
from gsmerge.errors import SceneError

LOOK = 0.5  # seconds until the pool is asked again
AGAIN = 1.0  # seconds until a scene that another run works on is looked at again


class Pool(Protocol):
    """Where scenes are worked on."""

    @property
    def has_room(self) -> bool:
        """Whether another scene can be taken."""

    def submit(self, task: Task) -> None:
        """Take a scene."""

    def wait(self, seconds: float) -> list[tuple[Task, dict[str, Any]]]:
        """What has ended, after at most so many seconds."""

    def close(self) -> None:
        """End everything; scenes that are under way are left as they were."""


def run_batch(
    jobs: Sequence[Job], folder: Path, options: BatchOptions, *, index: Index | None = None, shape: Shape | None = None
) -> Generator[dict[str, Any], None, None]:
    """Compact scenes, each on its own; what is done already is skipped.

    Each is recorded in ``folder/batch.jsonl`` before it is told of here, so that a run that ends at any moment goes
    on where it was. Runs with the same settings may share a folder: what one works on, the others leave to it.

    Args:
        jobs: See :func:`find_jobs`.
        folder: For the results; made where it does not exist.
        options: How.
        index: What the folder holds, if it is read already.
        shape: How the scenes are spread, if that is settled already.

    Yields:
        One record for each scene as it ends, in any order: ``status`` done, failed or skipped.

    Raises:
        SceneError: If the folder cannot be written.
        UsageError: If a batch with other settings is at work there, or the engine is not installed.
    """
    shape = shape or make_shape(jobs, options)
    check_folder(folder)
    if index is None:
        index = Index(folder)
        index.read_on()
    with ExitStack() as stack:
        stack.enter_context(run_lock(folder, options.name()))
        pool, work = _pool(folder, options, shape, index.end)
        stack.callback(pool.close)
        yield from hand_out((Task(job, index.known.get(job.output)) for job in jobs), pool, work)


def _pool(folder: Path, options: BatchOptions, shape: Shape, start: int) -> tuple[Pool, Work]:
    """Where the scenes are worked on, and what they share."""
    options = with_threads(options, shape.threads)
    if options.engine == "ray":
        from gsmerge.batch.ray_engine import RayPool, with_whole_paths

        work = Work(folder.absolute(), with_whole_paths(options), start)
        return RayPool(work, shape.jobs), work
    work = Work(folder, options, start)
    return LocalPool(work, shape.jobs), work


def hand_out(tasks: Iterator[Task], pool: Pool, work: Work) -> Iterator[dict[str, Any]]:
    """Keep a pool busy until nothing is left; see :func:`run_batch`.

    Raises:
        SceneError: If nothing can be recorded any more.
    """
    again: deque[Task] = deque()  # their process died
    later: deque[tuple[float, Task]] = deque()  # another run works on them
    active = 0
    while True:
        while pool.has_room and (task := _next(tasks, again, later)) is not None:
            pool.submit(task)
            active += 1
        if not active and not later:
            return
        if not active:
            time.sleep(max(0.0, min(LOOK, later[0][0] - time.monotonic())))
            continue
        for task, found in pool.wait(LOOK):
            active -= 1
            if found["status"] == LOST and task.attempt <= work.options.retries:
                again.append(replace(task, attempt=task.attempt + 1))
                continue
            if found["status"] == LOST:
                found = give_up(task, work, found["error"])
            if found["status"] == BUSY:
                later.append((time.monotonic() + AGAIN, task))
            elif found["status"] == STUCK:
                raise SceneError(work.folder / RECORDS, f"the batch cannot go on: {found['error']}")
            else:
                yield found


def _next(tasks: Iterator[Task], again: deque[Task], later: deque[tuple[float, Task]]) -> Task | None:
    """What to do next: first what was lost, then what is new, then what others were at; None while there is nothing."""
    if again:
        return again.popleft()
    task = next(tasks, None)
    if task is None and later and later[0][0] <= time.monotonic():
        return later.popleft()[1]
    return task
