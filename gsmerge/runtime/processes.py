"""A pool of processes on this machine; each process makes one call after the other."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from gsmerge.runtime.work import CALLS_PER_PROCESS, Call, LostProcess, WorkerPool

LIBRARIES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
END_SECONDS = 10.0  # time that a process gets to end by itself


class Worker:
    """A process of the pool, with the key of its current call."""

    def __init__(self, threads: int) -> None:
        spawn = multiprocessing.get_context("spawn")
        self.pipe, worker_end = spawn.Pipe()
        self.process: BaseProcess = spawn.Process(target=run_worker, args=(worker_end,), daemon=True)
        with _library_threads(threads):
            self.process.start()
        worker_end.close()
        self.key: Any = None
        self.count = 0

    def read_result(self) -> Any:
        """Return the result of the current call; raise its exception; return LostProcess if the process has ended."""
        try:
            succeeded, answer = self.pipe.recv()
        except (EOFError, OSError):
            self.process.join(END_SECONDS)
            return LostProcess(_describe_exit(self.process))
        if not succeeded:
            raise answer  # the exception of the call
        return answer

    def stop(self, *, now: bool) -> None:
        """End the process, either ``now`` or when it notices that the pipe is closed."""
        self.pipe.close()
        if now:
            self.process.kill()
        self.process.join(END_SECONDS)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


class ProcessPool(WorkerPool):
    """A pool of up to ``jobs`` processes on this machine; each makes one call after the other."""

    def __init__(self, jobs: int, threads: int) -> None:
        self.capacity, self.threads, self.workers = jobs, threads, list[Worker]()

    def submit(self, function: Callable[..., Any], call: Call) -> None:
        """Start a call."""
        worker = next((worker for worker in self.workers if worker.key is None), None)
        if worker is None:
            worker = Worker(self.threads)
            self.workers.append(worker)
        worker.key = call.key
        worker.count += 1
        with suppress(OSError):  # if the process has ended already, wait notices it
            worker.pipe.send((function, call.arguments))

    def wait(self) -> list[tuple[Any, Any]]:
        """Wait until a call ends; return key and result of each ended call."""
        busy, ended = [worker for worker in self.workers if worker.key is not None], []
        ready = wait([worker.pipe for worker in busy])
        for worker in [worker for worker in busy if worker.pipe in ready]:
            result = worker.read_result()
            ended.append((worker.key, result))
            worker.key = None
            if isinstance(result, LostProcess) or worker.count >= CALLS_PER_PROCESS:
                worker.stop(now=isinstance(result, LostProcess))
                self.workers.remove(worker)
        return ended

    def close(self) -> None:
        """End all processes."""
        for worker in self.workers:
            worker.stop(now=worker.key is not None)
        self.workers = []


def _describe_exit(process: BaseProcess) -> str:
    """Describe how a process ended."""
    code = process.exitcode
    if code is None or code >= 0:
        return f"its process ended unexpectedly (exit code {code})"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = str(-code)
    hint = "; perhaps out of memory, try fewer --jobs" if name == "SIGKILL" else ""
    return f"its process was killed ({name}{hint})"


@contextmanager
def _library_threads(count: int) -> Iterator[None]:
    """Let NumPy's libraries use ``count`` threads in processes that are started within the block."""
    before = {name: os.environ[name] for name in LIBRARIES if name in os.environ}
    os.environ.update(dict.fromkeys(LIBRARIES, str(count)))
    try:
        yield
    finally:
        for name in LIBRARIES:
            del os.environ[name]
        os.environ.update(before)


def run_worker(pipe: Connection) -> None:
    """Run calls from the pipe until it closes; this is the main function of a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles it and ends this process
    os.dup2(2, 1)  # only the parent prints to stdout
    parent = multiprocessing.parent_process()

    def end_with_parent() -> None:
        if parent is not None:
            wait([parent.sentinel])
            os._exit(1)  # at once, even within a call

    threading.Thread(target=end_with_parent, daemon=True).start()
    with suppress(EOFError, OSError):  # raised when the parent has closed the pipe
        while True:
            function, arguments = pipe.recv()
            try:
                reply = True, function(*arguments)  # as read_result expects
            except Exception as error:
                reply = False, error
            pipe.send(reply)
