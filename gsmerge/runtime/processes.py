"""A pool of processes on this machine, each of which makes one call after the other."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from gsmerge.runtime.work import CALLS_PER_PROCESS, Lost

STARTED = "begun"  # what a process sends when it takes a call
LIBRARIES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Worker:
    """A process of the pool, with its current call."""

    def __init__(self, threads: int) -> None:
        spawn = multiprocessing.get_context("spawn")
        self.pipe, theirs = spawn.Pipe()
        self.process: BaseProcess = spawn.Process(target=run_worker, args=(theirs,), daemon=True)
        with _library_threads(threads):
            self.process.start()
        theirs.close()
        self.key: Any = None
        self.since: float | None = None
        self.count = 0

    def stop(self, *, now: bool) -> None:
        """End the process: ``now``, or when it finds the pipe closed."""
        self.pipe.close()
        if now:
            self.process.kill()
        self.process.join(10)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


class ProcessPool:
    """A pool of up to ``jobs`` processes on this machine; each makes one call after the other."""

    def __init__(self, jobs: int, threads: int, *, timeout: float | None = None) -> None:
        self.jobs, self.threads, self.timeout, self.workers = jobs, threads, timeout, list[Worker]()

    @property
    def has_room(self) -> bool:
        """Whether the pool can take another call."""
        return sum(worker.key is not None for worker in self.workers) < self.jobs

    def submit(self, key: Any, function: Callable[..., Any], *arguments: Any, memory: int = 0) -> None:
        """Start a call of a picklable function."""
        idle = next((worker for worker in self.workers if worker.key is None), None)
        if idle is None:
            idle = Worker(self.threads)
            self.workers.append(idle)
        idle.key, idle.since = key, None
        idle.count += 1
        with suppress(OSError):  # a process that has ended already is noticed by wait
            idle.pipe.send((function, arguments))

    def wait(self, seconds: float | None) -> list[tuple[Any, Any]]:
        """Wait up to ``seconds`` (None: forever) for calls to end; return (key, result or Lost) of each."""
        busy = [worker for worker in self.workers if worker.key is not None]
        wait([worker.pipe for worker in busy] + [worker.process.sentinel for worker in busy], seconds)
        ended = []
        for worker in busy:
            for result in self._results(worker):
                ended.append((worker.key, result))
                worker.key = None
                if isinstance(result, Lost) or worker.count >= CALLS_PER_PROCESS:
                    worker.stop(now=isinstance(result, Lost))
                    self.workers.remove(worker)
        return ended

    def _results(self, worker: Worker) -> list[Any]:
        """Return the result of a call that ended; nothing if it has not."""
        try:
            while worker.pipe.poll():
                message = worker.pipe.recv()
                if message != STARTED:
                    return [message]
                worker.since = time.monotonic()
            is_lost = not worker.process.is_alive() and not worker.pipe.poll()
        except (EOFError, OSError):
            worker.process.join(10)
            is_lost = True
        if is_lost:
            return [Lost(_describe_exit(worker.process))]
        limit, since = self.timeout, worker.since
        if limit is not None and since is not None and time.monotonic() > since + limit:
            return [Lost(f"took longer than {limit:g} s (--timeout)")]
        return []

    def close(self) -> list[Any]:
        """End all processes; return the keys of unfinished calls."""
        for worker in self.workers:
            worker.stop(now=worker.key is not None)
        keys, self.workers = [worker.key for worker in self.workers if worker.key is not None], []
        return keys


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


@contextmanager
def _library_threads(count: int) -> Iterator[None]:
    """Let numpy's libraries use ``count`` threads in processes that are started in the block."""
    before = {name: os.environ[name] for name in LIBRARIES if name in os.environ}
    os.environ.update(dict.fromkeys(LIBRARIES, str(count)))
    try:
        yield
    finally:
        for name in LIBRARIES:
            del os.environ[name]
        os.environ.update(before)


def run_worker(pipe: Connection) -> None:
    """Make the calls that come through the pipe until it closes; main function of a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run handles it, and ends its processes
    os.dup2(2, 1)  # only the run itself prints to stdout
    parent = multiprocessing.parent_process()

    def end_with_parent() -> None:
        if parent is not None:
            wait([parent.sentinel])
            os._exit(1)  # whatever this process is doing

    threading.Thread(target=end_with_parent, daemon=True).start()
    with suppress(EOFError, OSError):  # raised when the run has ended
        while True:
            function, arguments = pipe.recv()
            pipe.send(STARTED)
            pipe.send(function(*arguments))
