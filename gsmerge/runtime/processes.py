"""Make calls in a pool of processes on this machine. Each process makes one call after the other."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from gsmerge.runtime.memory import memory_problem
from gsmerge.runtime.work import Call, LostProcess, WorkerPool

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
LOST = "its process was killed or ended unexpectedly"
FEWER = "perhaps out of memory, try fewer --jobs"


class ProcessPool(WorkerPool):
    """A pool of up to ``jobs`` processes. Each has an executor of its own, so a process that dies loses only its call.

    The calls that run at the same time may together need ``memory`` bytes. A call that needs more than ``memory`` runs
    alone.
    """

    def __init__(self, jobs: int, threads: int, memory: float) -> None:
        self.capacity = jobs
        self.threads = threads
        self.memory = memory
        self.idle: list[ProcessPoolExecutor] = []
        self.calls: dict[Future[Any], tuple[Call, ProcessPoolExecutor]] = {}  # running calls, each with its executor

    def has_room(self, call: Call) -> bool:
        """Return true if a call fits into the memory beside the calls that run, or if no call runs."""
        needed = call.memory + sum(running.memory for running, _ in self.calls.values())
        return not self.calls or needed <= self.memory

    def submit(self, function: Callable[..., Any], call: Call) -> None:
        """Start a call."""
        executor = self.idle.pop() if self.idle else ProcessPoolExecutor(
            1, multiprocessing.get_context("spawn"), initializer=begin_worker
        )  # fmt: skip
        # The first call of an executor starts its process, in which libraries that NumPy uses get as many threads
        before = {name: os.environ[name] for name in THREAD_VARIABLES if name in os.environ}
        os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(self.threads)))
        try:
            self.calls[executor.submit(function, *call.arguments)] = call, executor
        finally:
            for name in THREAD_VARIABLES:
                del os.environ[name]
            os.environ.update(before)

    def wait(self) -> list[tuple[Any, Any]]:
        """Wait until a call ends; return the keys and results of all calls that have ended."""
        ended = []
        for future in wait(self.calls, return_when=FIRST_COMPLETED).done:
            call, executor = self.calls.pop(future)
            if isinstance(future.exception(), BrokenProcessPool):
                ended.append((call.key, LostProcess(f"{LOST}; {memory_problem(call.memory) or FEWER}")))
            else:
                self.idle.append(executor)  # before result(), which raises the error of a failed call
                ended.append((call.key, future.result()))
        return ended

    def close(self) -> None:
        """End all processes. Processes that make a call are killed."""
        busy = [executor for _, executor in self.calls.values()]
        for executor in busy:
            for process in [*executor._processes.values()]:  # before Python 3.14 no public method ends a running call
                process.kill()
        for executor in [*self.idle, *busy]:
            executor.shutdown(cancel_futures=True)


def begin_worker() -> None:
    """Prepare a process of the pool, so that it ignores Ctrl-C, writes to stderr only, and ends with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.dup2(2, 1)
    parent = multiprocessing.parent_process()

    def end_with_parent() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)  # at once, even within a call

    threading.Thread(target=end_with_parent, daemon=True).start()
