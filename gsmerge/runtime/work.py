"""Engines that make calls: in this process, in others of this machine, or in those of a Ray cluster.

Ray is an extra, which schedules by threads and memory. A process that dies takes one call with it. Of work in parts,
such a call is made again, elsewhere, and gives the same.
"""

from __future__ import annotations

import faulthandler
import logging
import multiprocessing
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any, TypeVar

from gsmerge.errors import SceneError, UsageError
from gsmerge.runtime.record import Record, record_part, report_progress
from gsmerge.runtime.threads import use_threads

T = TypeVar("T")
CONNECT_TIMEOUT = 10.0  # seconds to reach a cluster
RETRIES = 5  # of a call whose process or node was lost
SMALL_STORE = 100 << 20  # bytes of objects that the calls on a cluster of this machine may share
CALLS_PER_PROCESS = 200  # then it is replaced by a new one, so that what libraries leave in memory cannot add up
STARTED = "begun"  # what a process sends when it takes a call
LIBRARIES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
EXTRA_CALLS = 2  # submitted beyond those that the cluster has processors for
CLUSTER_SIZE_SECONDS = 5.0  # between two queries of the cluster's size


@contextmanager
def start_work(engine: str, address: str | None = None, *, threads: int | None, memory: int) -> Iterator[Work]:
    """Open an engine for calls that each need ``threads`` (None: chosen) and ``memory`` bytes.

    ``engine``: ``"local"``: in this process, one call after the other; ``"ray"``: on the Ray cluster at ``address``.
    """
    with ExitStack() as stack:
        cluster = None if engine == "local" else stack.enter_context(closing(Cluster(address)))
        yield Work(cluster, threads, memory)


class Cluster:
    """A connection to a Ray cluster."""

    def __init__(self, address: str | None, *, store_bytes: int | None = None) -> None:
        self.ray = require_ray()
        _join(self.ray, address, store_bytes)

    @property
    def processors(self) -> int:
        """Processors of all nodes."""
        return int(self.ray.cluster_resources().get("CPU", 1.0))

    def needs(self, threads: int, memory: int) -> dict[str, float]:
        """Return the resources that a task asks for, at most those of the largest node; UsageError without processors.

        Ray would let a task that asks for more wait forever.
        """
        nodes = [node["Resources"] for node in self.ray.nodes() if node["Alive"] and node["Resources"].get("CPU")]
        if not nodes:
            raise UsageError("engine ray: expected nodes with processors, found none in the cluster")
        largest = max(nodes, key=lambda node: (min(memory, node.get("memory", 0.0)), node["CPU"]))
        return {"num_cpus": min(threads, largest["CPU"]), "memory": min(memory, int(largest.get("memory", 0.0)))}

    def close(self) -> None:
        """Disconnect."""
        self.ray.shutdown()


@dataclass(frozen=True)
class Work:
    """An engine that makes calls in this process or on a cluster."""

    cluster: Cluster | None
    threads: int | None
    memory: int

    def share(self, value: Any) -> Any:
        """Return a reference to a large argument, so that several calls can share it."""
        return value if self.cluster is None else self.cluster.ray.put(value)

    def run(
        self, title: str, function: Callable[..., T], count: int, calls: Iterable[tuple[Any, ...]]
    ) -> Iterator[tuple[T, Record]]:
        """Make ``count`` calls of a picklable function; yield (result, record) of each, in order.

        A cluster makes as many at once as it has processors; this process makes one after the other.
        """
        if self.cluster is not None:
            yield from self._run_there(self.cluster, title, function, count, calls)
            return
        place = 0
        for arguments in calls:  # not by enumerate, which would keep them until the next ones are made
            place += 1  # noqa: SIM113
            with record_part(title=f"block {place} of {count}: {title}") as record:
                value = function(*arguments)
            del arguments
            yield value, record

    def _run_there(
        self, cluster: Cluster, title: str, function: Callable[..., T], count: int, calls: Iterable[tuple[Any, ...]]
    ) -> Iterator[tuple[T, Record]]:
        processors = cluster.processors
        needs = cluster.needs(self.threads or max(1, processors // count), self.memory)
        threads, folder = max(1, int(needs["num_cpus"])), os.getcwd()
        pool = RayPool(cluster, threads, jobs=max(1, processors // threads), retries=RETRIES)
        results = dict[int, Any]()

        def wait_for_some() -> None:
            for place, value in pool.wait(None):
                if isinstance(value, Lost):  # an error ends the run at once
                    raise _cause(value.error, title, cluster)
                results[place] = value
                report_progress(f"{title}: {len(results)} of {count} blocks", len(results), count)

        for place, arguments in enumerate(calls):
            while not pool.has_room:
                wait_for_some()
            pool.submit(place, _call_in_part, threads, folder, function, *arguments, memory=self.memory)
        while pool.keys:
            wait_for_some()
        for place in range(len(results)):
            yield results.pop(place)


def _call_in_part(threads: int, folder: str, function: Callable[..., T], *arguments: Any) -> tuple[T, Record]:
    """Make a call with a record of its own, in the folder that relative paths of the caller's files refer to."""
    with suppress(OSError):
        os.chdir(folder)
    with use_threads(threads), record_part() as record:
        value = function(*arguments)
    return value, replace(record, progress=None)


def _cause(error: Any, title: str, cluster: Cluster) -> Exception:
    """Return what a call raised; UsageError if its process was lost each time."""
    if isinstance(error, cluster.ray.exceptions.RayTaskError):
        return error.cause if isinstance(error.cause, Exception) else error
    text = " ".join(str(error).split())[:200]
    problem = f"its process or node was lost {RETRIES + 1} times ({type(error).__name__}: {text})"
    return UsageError(f"engine ray: {title}: {problem}; perhaps out of memory, more blocks help")


@dataclass(frozen=True)
class Lost:
    """Result of a call whose process or node was lost, with the reason."""

    reason: str
    error: Any = None  # Ray's


class RayPool:
    """A pool of up to ``jobs`` calls on a Ray cluster; 0: as many as it has processors."""

    def __init__(
        self, cluster: Cluster, threads: int, *, jobs: int = 0, retries: int = 0, timeout: float | None = None
    ) -> None:
        self.cluster, self.ray = cluster, cluster.ray
        self.threads, self.jobs, self.timeout = threads, jobs, timeout
        self.function = self.ray.remote(max_retries=retries, max_calls=CALLS_PER_PROCESS)(_call)
        self.keys: dict[Any, Any] = {}
        self.counted, self.capacity = float("-inf"), 1

    @property
    def has_room(self) -> bool:
        """Whether the pool can take another call."""
        if self.jobs:
            return len(self.keys) < self.jobs
        if time.monotonic() > self.counted + CLUSTER_SIZE_SECONDS:
            self.capacity = max(1, self.cluster.processors // self.threads) + EXTRA_CALLS
            self.counted = time.monotonic()
        return len(self.keys) < self.capacity

    def submit(self, key: Any, function: Callable[..., Any], *arguments: Any, memory: int = 0) -> None:
        """Start a call of a picklable function that may need ``memory`` bytes."""
        needs = self.cluster.needs(self.threads, memory)
        self.keys[self.function.options(**needs).remote(self.timeout, function, *arguments)] = key

    def wait(self, seconds: float | None) -> list[tuple[Any, Any]]:
        """Wait up to ``seconds`` (None: forever) for calls to end; return (key, result or Lost) of each."""
        ready, pending = self.ray.wait(list(self.keys), num_returns=1, timeout=seconds)
        if ready and pending:
            ready += self.ray.wait(pending, num_returns=len(pending), timeout=0)[0]
        return [(self.keys.pop(ref), self._result(ref)) for ref in ready]

    def _result(self, ref: Any) -> Any:
        try:
            return self.ray.get(ref)
        except self.ray.exceptions.RayError as error:
            late = "" if self.timeout is None else f", or it took longer than {self.timeout:g} s (--timeout)"
            return Lost(f"its process or node was lost ({type(error).__name__}){late}", error)

    def close(self) -> list[Any]:
        """Cancel unfinished calls; return an empty list, since what they left may be on any node."""
        for ref in self.keys:
            with suppress(self.ray.exceptions.RayError, ValueError):
                self.ray.cancel(ref, force=True)
        return []


def _call(seconds: float | None, function: Callable[..., T], *arguments: Any) -> T:
    """Make a call in a process that ends if it takes longer, even while it runs compiled code."""
    if seconds is None:
        return function(*arguments)
    with open(os.devnull, "w") as nowhere:
        faulthandler.dump_traceback_later(seconds, exit=True, file=nowhere)
        try:
            return function(*arguments)
        finally:
            faulthandler.cancel_dump_traceback_later()


def require_ray() -> ModuleType:
    """Import Ray; UsageError if it is not installed."""
    try:
        import ray
    except ImportError as error:
        raise UsageError("engine ray: Ray is not installed; pip install 'ray>=2.9,<3'") from error
    return ray


def _join(ray: ModuleType, address: str | None, store_bytes: int | None) -> None:
    """Connect to the cluster, or start one of this machine alone."""
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    os.environ.setdefault("RAY_task_oom_retries", str(RETRIES))  # of processes that Ray itself ends
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    if ray.is_initialized():
        raise UsageError("engine ray: expected a process without a connection to Ray; call ray.shutdown() before")
    if address is None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        ray.init(address="local", include_dashboard=False, object_store_memory=store_bytes, **quiet)
        return
    try:
        host, _, port = address.removeprefix("ray://").rpartition(":")
        if host and port.isdecimal():  # where nothing listens, Ray itself would wait for minutes
            with closing(socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_TIMEOUT)):
                pass
        ray.init(address=address, **quiet)
    except (OSError, ValueError, RuntimeError) as error:
        problem = f"no Ray cluster answers there ({' '.join(str(error).split())[:200]})"
        raise SceneError(address, problem, "start one with ray start --head") from error


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
