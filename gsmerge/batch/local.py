"""Processes on this machine: each takes scene after scene, and one that dies takes no other scene with it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from gsmerge.batch.records import LOST, Index, record
from gsmerge.batch.task import Task, Work, run_task, tidy

SCENES = 200  # that a process works on before it makes way for a new one: what libraries keep cannot add up
BEGUN = "begun"
LIBRARIES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Worker:
    """A process and what it is doing.

    Args:
        work: What all tasks share.
    """

    def __init__(self, work: Work) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(target=serve, args=(theirs, work), daemon=True)
        with _library_threads(work.options.settings.threads or 1):
            self.process.start()
        theirs.close()
        self.task: Task | None = None
        self.since: float | None = None
        self.count = 0

    def give(self, task: Task) -> None:
        """Hand it a scene; a process that is gone already is found out about later."""
        self.task, self.since = task, None
        self.count += 1
        try:
            self.pipe.send(task)
        except OSError:
            return

    def stop(self, *, now: bool) -> None:
        """End the process: at once, or when it has seen that there is nothing more to do."""
        self.pipe.close()
        if now:
            self.process.kill()
        self.process.join(10)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


class LocalPool:
    """Up to ``jobs`` processes.

    Args:
        work: What all tasks share.
        jobs: Processes at once.
    """

    def __init__(self, work: Work, jobs: int) -> None:
        self.work, self.jobs, self.workers = work, jobs, list[Worker]()

    @property
    def has_room(self) -> bool:
        """Whether another scene can be taken."""
        return sum(worker.task is not None for worker in self.workers) < self.jobs

    def submit(self, task: Task) -> None:
        """Take a scene."""
        idle = next((worker for worker in self.workers if worker.task is None), None)
        if idle is None:
            idle = Worker(self.work)
            self.workers.append(idle)
        idle.give(task)

    def wait(self, seconds: float) -> list[tuple[Task, dict[str, Any]]]:
        """What has ended, after at most so many seconds: records, or that the process was lost."""
        busy = [worker for worker in self.workers if worker.task is not None]
        limit, now = self.work.options.timeout, time.monotonic()
        if limit is not None:
            seconds = min([seconds, *(max(0.0, w.since + limit - now) for w in busy if w.since is not None)])
        wait([w.pipe for w in busy] + [w.process.sentinel for w in busy], seconds)
        ended = []
        for worker in busy:
            found = self._news(worker)
            if found is not None and worker.task is not None:
                ended.append((worker.task, found))
                worker.task = None
                if found["status"] == LOST or worker.count >= SCENES:
                    worker.stop(now=found["status"] == LOST)
                    self.workers.remove(worker)
        return ended

    def _news(self, worker: Worker) -> dict[str, Any] | None:
        """How a scene ended; None if it has not."""
        try:
            while worker.pipe.poll():
                said = worker.pipe.recv()
                if said != BEGUN:
                    return said
                worker.since = time.monotonic()
        except (EOFError, OSError):
            worker.process.join(10)
            return self._lost(worker, _end_of(worker.process))
        if not worker.process.is_alive() and not worker.pipe.poll():
            return self._lost(worker, _end_of(worker.process))
        limit = self.work.options.timeout
        if limit is not None and worker.since is not None and time.monotonic() > worker.since + limit:
            return self._lost(worker, f"took longer than {limit:g} s (--timeout)")
        return None

    def _lost(self, worker: Worker, why: str) -> dict[str, Any]:
        assert worker.task is not None
        return record(LOST, worker.task.job.scene, worker.task.job.output, error=why)

    def close(self) -> None:
        """End all processes; scenes that they are at are left as they were."""
        for worker in self.workers:
            worker.stop(now=worker.task is not None)
            if worker.task is not None:
                tidy(worker.task, self.work)
        self.workers = []


def _end_of(process: BaseProcess) -> str:
    """How a process ended, in words."""
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
    """A block whose new processes let numpy's libraries use so many threads."""
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


def serve(pipe: Connection, work: Work) -> None:
    """Work on what comes through the pipe until it is closed: the whole life of a process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run itself is told, and ends us
    os.dup2(2, 1)  # stdout is the run's: nobody prints into its lines
    threading.Thread(target=_end_with, args=(multiprocessing.parent_process(),), daemon=True).start()
    later = Index(work.folder, work.start)
    with suppress(EOFError, OSError):  # the run has ended
        while True:
            task = pipe.recv()
            pipe.send(BEGUN)
            pipe.send(run_task(task, work, later))


def _end_with(parent: BaseProcess | None) -> None:
    """End this process, whatever it is doing, with the run that it belongs to."""
    waited: Sequence[int] = [] if parent is None else [parent.sentinel]
    if waited:
        wait(waited)
        os._exit(1)
