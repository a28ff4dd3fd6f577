"""Processes on this machine: each takes scene after scene, and one that dies affects no other scene."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from gsmerge.batch.records import LOST, RecordIndex, record
from gsmerge.batch.task import BatchContext, Task, clean_up, run_task

SCENES_PER_PROCESS = 200  # then it is replaced by a new one, so that what libraries leave in memory cannot add up
STARTED = "begun"  # what a process sends when it takes a scene
LIBRARIES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Worker:
    """A process and its scene."""

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

    def give(self, task: Task) -> None:
        """Send it a scene; that a process has ended already shows in :meth:`LocalPool.wait`."""
        self.task, self.since = task, None
        self.count += 1
        with suppress(OSError):
            self.pipe.send(task)

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
    """Up to ``jobs`` processes."""

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
        idle.give(task)

    def wait(self, seconds: float) -> list[tuple[Task, dict[str, Any]]]:
        """Scenes that ended, after at most so many seconds: their records, or that the process was lost."""
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
        """How a scene ended; None if it has not."""
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
    """How a process ended."""
    code = process.exitcode
    if code is None or code >= 0:
        return f"its process ended unexpectedly (exit code {code})"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = str(-code)
    hint = "; perhaps out of memory, fewer --jobs or --max-memory help" if -code == signal.SIGKILL else ""
    return f"its process was killed ({name}{hint})"


@contextmanager
def _library_threads(count: int) -> Iterator[None]:
    """A block whose new processes let numpy's libraries use ``count`` threads."""
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
    """A process: work on the tasks from the pipe until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run handles it, and ends its processes
    os.dup2(2, 1)  # only the run itself prints to stdout
    threading.Thread(target=_end_with, args=(multiprocessing.parent_process(),), daemon=True).start()
    new_records = RecordIndex(context.folder, context.start)
    with suppress(EOFError, OSError):  # raised when the run has ended
        while True:
            task = pipe.recv()
            pipe.send(STARTED)
            pipe.send(run_task(task, context, new_records))


def _end_with(parent: BaseProcess | None) -> None:
    """End this process, whatever it is doing, when its parent ends."""
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
