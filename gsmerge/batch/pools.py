"""Compact the scenes of a batch side by side: in processes on this machine, or on a Ray cluster.

A process takes scene after scene; one that dies affects no other scene. Ray, an extra, schedules by threads and
memory; scenes and output folder must have the same paths on all its nodes.
"""

from __future__ import annotations

import contextlib
import faulthandler
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from gsmerge.batch.batch_options import BatchOptions
from gsmerge.batch.records import LOST, RecordIndex, record
from gsmerge.batch.task import BatchContext, Task, clean_up, run_task
from gsmerge.runtime.cluster import SMALL_STORE, Cluster
from gsmerge.settings.compact import CHECKPOINTS

SCENES_PER_PROCESS = 200  # then it is replaced by a new one, so that what libraries leave in memory cannot add up
STARTED = "begun"  # what a process sends when it takes a scene
LIBRARIES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
EXTRA_TASKS = 2  # submitted beyond those that the cluster has processors for
CLUSTER_SIZE_SECONDS = 5.0  # between two queries of the cluster's size


class Worker:
    """A process, and the scene that it compacts."""

    def __init__(self, context: BatchContext) -> None:
        spawn = multiprocessing.get_context("spawn")
        self.pipe, theirs = spawn.Pipe()
        self.process: BaseProcess = spawn.Process(target=run_worker, args=(theirs, context), daemon=True)
        with _library_threads(context.options.settings.threads or 1):
            self.process.start()
        theirs.close()
        self.task: Task | None = None
        self.since: float | None = None
        self.count = 0

    def stop(self, *, now: bool) -> None:
        """End the process: at once, or as soon as it reads that the pipe is closed."""
        self.pipe.close()
        if now:
            self.process.kill()
        self.process.join(10)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


class LocalPool:
    """A pool of up to ``jobs`` processes."""

    def __init__(self, context: BatchContext, jobs: int) -> None:
        self.context, self.jobs, self.workers = context, jobs, list[Worker]()

    @property
    def has_room(self) -> bool:
        """Whether another scene can be taken."""
        return sum(worker.task is not None for worker in self.workers) < self.jobs

    def submit(self, task: Task) -> None:
        """Take a scene."""
        idle = next((worker for worker in self.workers if worker.task is None), None)
        if idle is None:
            idle = Worker(self.context)
            self.workers.append(idle)
        idle.task, idle.since = task, None
        idle.count += 1
        with contextlib.suppress(OSError):  # a process that has ended already is noticed by wait
            idle.pipe.send(task)

    def wait(self, seconds: float) -> list[tuple[Task, dict[str, Any]]]:
        """Wait for at most so many seconds; return the scenes that ended, with their records."""
        busy = [worker for worker in self.workers if worker.task is not None]
        limit, now = self.context.options.timeout, time.monotonic()
        if limit is not None:
            seconds = min([seconds, *(max(0.0, w.since + limit - now) for w in busy if w.since is not None)])
        wait([w.pipe for w in busy] + [w.process.sentinel for w in busy], seconds)
        ended = []
        for worker in busy:
            outcome = self._poll(worker)
            if outcome is not None and worker.task is not None:
                ended.append((worker.task, outcome))
                worker.task = None
                if outcome["status"] == LOST or worker.count >= SCENES_PER_PROCESS:
                    worker.stop(now=outcome["status"] == LOST)
                    self.workers.remove(worker)
        return ended

    def _poll(self, worker: Worker) -> dict[str, Any] | None:
        """Return the record of a scene that ended; None if it has not."""
        try:
            while worker.pipe.poll():
                message = worker.pipe.recv()
                if message != STARTED:
                    return message
                worker.since = time.monotonic()
            is_lost = not worker.process.is_alive() and not worker.pipe.poll()
        except (EOFError, OSError):
            worker.process.join(10)
            is_lost = True
        limit = self.context.options.timeout
        is_late = limit is not None and worker.since is not None and time.monotonic() > worker.since + limit
        if worker.task is None or not (is_lost or is_late):
            return None
        reason = _describe_exit(worker.process) if is_lost else f"took longer than {limit:g} s (--timeout)"
        return record(LOST, worker.task.job.scene, worker.task.job.output, error=reason)

    def close(self) -> None:
        """End all processes; unfinished scenes are left as they were."""
        for worker in self.workers:
            worker.stop(now=worker.task is not None)
            if worker.task is not None:
                clean_up(worker.task, self.context)
        self.workers = []


def _describe_exit(process: BaseProcess) -> str:
    """Say how a process ended."""
    code = process.exitcode
    if code is None or code >= 0:
        return f"its process ended unexpectedly (exit code {code})"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = str(-code)
    hint = "; perhaps out of memory, fewer --jobs or --max-memory help" if -code == signal.SIGKILL else ""
    return f"its process was killed ({name}{hint})"


@contextlib.contextmanager
def _library_threads(count: int) -> Iterator[None]:
    """Let numpy's libraries use ``count`` threads in processes that are started in the block."""
    before = {name: os.environ.get(name) for name in LIBRARIES}
    os.environ.update(dict.fromkeys(LIBRARIES, str(count)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def run_worker(pipe: Connection, context: BatchContext) -> None:
    """Work on the tasks from the pipe until it is closed, as the main function of a process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run handles it, and ends its processes
    os.dup2(2, 1)  # only the run itself prints to stdout
    parent = multiprocessing.parent_process()

    def end_with_parent() -> None:
        if parent is not None:
            wait([parent.sentinel])
            os._exit(1)  # whatever this process is doing

    threading.Thread(target=end_with_parent, daemon=True).start()
    new_records = RecordIndex(context.folder, context.start)
    with contextlib.suppress(EOFError, OSError):  # raised when the run has ended
        while True:
            task = pipe.recv()
            pipe.send(STARTED)
            pipe.send(run_task(task, context, new_records))


class RayPool:
    """A pool of ``jobs`` tasks of a Ray cluster; 0: as many as it has processors for."""

    def __init__(self, context: BatchContext, jobs: int) -> None:
        self.cluster = Cluster(context.options.address, store_bytes=SMALL_STORE)
        self.ray = self.cluster.ray
        self.context, self.jobs = context, jobs
        self.shared = self.ray.put(context)
        self.function = self.ray.remote(max_retries=0, max_calls=SCENES_PER_PROCESS)(run_remote)
        self.tasks: dict[Any, Task] = {}
        self.counted, self.capacity = float("-inf"), 1

    @property
    def has_room(self) -> bool:
        """Whether another scene can be taken."""
        if self.jobs:
            return len(self.tasks) < self.jobs
        if time.monotonic() > self.counted + CLUSTER_SIZE_SECONDS:
            self.capacity = max(1, self.cluster.processors // self._threads()) + EXTRA_TASKS
            self.counted = time.monotonic()
        return len(self.tasks) < self.capacity

    def _threads(self) -> int:
        return self.context.options.settings.threads or 1

    def submit(self, task: Task) -> None:
        """Take a scene."""
        needs = self.cluster.needs(self._threads(), task.job.memory)
        ref = self.function.options(**needs).remote(task, self.shared)
        self.tasks[ref] = task

    def wait(self, seconds: float) -> list[tuple[Task, dict[str, Any]]]:
        """Wait for at most so many seconds; return the scenes that ended, with their records."""
        ready, rest = self.ray.wait(list(self.tasks), num_returns=1, timeout=seconds)
        if ready and rest:
            ready += self.ray.wait(rest, num_returns=len(rest), timeout=0)[0]
        ended = [(ref, self.tasks.pop(ref)) for ref in ready]
        return [(task, self._result(ref, task)) for ref, task in ended]

    def _result(self, ref: Any, task: Task) -> dict[str, Any]:
        try:
            return self.ray.get(ref)
        except self.ray.exceptions.RayError as error:
            limit = self.context.options.timeout
            reason = f"its process or node was lost ({type(error).__name__})"
            reason += "" if limit is None else f", or it took longer than {limit:g} s (--timeout)"
            return record(LOST, task.job.scene, task.job.output, error=reason)

    def close(self) -> None:
        """End unfinished scenes, and disconnect from the cluster."""
        for ref in self.tasks:
            with contextlib.suppress(self.ray.exceptions.RayError, ValueError):
                self.ray.cancel(ref, force=True)
        self.cluster.close()


def run_remote(task: Task, context: BatchContext) -> dict[str, Any]:
    """Compact a scene in a process of the cluster, which ends if the scene takes too long."""
    with _limited(context.options.timeout):
        return run_task(task, context, _new_records(context.folder, context.start))


@lru_cache(maxsize=1)
def _new_records(folder: Path, start: int) -> RecordIndex:
    """Return the index of records since the run began, one for all tasks of a process."""
    return RecordIndex(folder, start)


@contextlib.contextmanager
def _limited(seconds: float | None) -> Iterator[None]:
    """End the process if the block takes longer, even while it runs compiled code."""
    if seconds is None:
        yield
        return
    with open(os.devnull, "w") as nowhere:
        faulthandler.dump_traceback_later(seconds, exit=True, file=nowhere)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()


def with_whole_paths(options: BatchOptions) -> BatchOptions:
    """Return the options with absolute paths, which mean the same on every node."""
    settings = options.settings
    if settings.checkpoint not in CHECKPOINTS:
        settings = replace(settings, checkpoint=os.path.abspath(settings.checkpoint))
    cameras, images = (
        path if path is None or path.startswith("{") else os.path.abspath(path)
        for path in (options.cameras, options.images)
    )
    return replace(options, settings=settings, cameras=cameras, images=images)
