"""Make calls in this process, in other processes of this machine, or on a Ray cluster.

Ray is an optional dependency, which schedules calls by their threads and memory. If a process on this machine dies, the
call that it was making is lost. On a cluster, another process repeats the call, with the same result. Processes of this
machine are in :mod:`gsmerge.runtime.processes`.
"""

from __future__ import annotations

import logging
import os
import socket
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

from gsmerge.errors import SceneError, UsageError
from gsmerge.frozen import dataclass, replace
from gsmerge.runtime.record import Record, record_part, report_progress
from gsmerge.runtime.threads import use_threads

T = TypeVar("T")
RETRIES = 5  # a call whose process or node was lost is repeated at most this often
SMALL_STORE = 100 << 20  # bytes for shared objects, if Ray starts a cluster on this machine


class Call(NamedTuple):
    """A call to make in another process."""

    key: Any  # key by which the caller recognises the result
    arguments: tuple[Any, ...]
    memory: int = 0  # bytes that the call may need


class LostProcess(NamedTuple):
    """The result of a call whose process or node was lost."""

    reason: str


class WorkerPool(ABC):
    """Processes that make up to ``capacity`` calls at the same time."""

    capacity: int

    def run(self, function: Callable[..., Any], calls: Iterable[Call]) -> Iterator[tuple[Any, Any]]:
        """Make calls of a picklable function; take the next call when a process is free.

        Yields the key and the result of each call as soon as the call ends. The result of a call whose process died is
        a :class:`LostProcess`. Raises the exception of a failed call.
        """
        # `call` is the next call, if it still waits for memory
        waiting = iter(calls)
        num_running = 0
        call = None
        while True:
            while num_running < self.capacity and (call := call or next(waiting, None)) and self.has_room(call):
                self.submit(function, call)
                num_running = num_running + 1
                call = None
            if not num_running:
                return
            ended = self.wait()
            num_running -= len(ended)
            yield from ended

    def has_room(self, call: Call) -> bool:
        """Return true if a call may start beside the running calls; always true if no call runs."""
        return True

    @abstractmethod
    def submit(self, function: Callable[..., Any], call: Call) -> None:
        """Start a call."""

    @abstractmethod
    def wait(self) -> list[tuple[Any, Any]]:
        """Wait until a call ends; return the keys and results of all calls that have ended."""

    @abstractmethod
    def close(self) -> None:
        """End all processes and their calls."""


@contextmanager
def start_work(engine: str, address: str | None = None, *, threads: int | None, memory: int) -> Iterator[Work]:
    """Open an engine for calls that each need ``memory`` bytes and ``threads`` threads (None: the engine chooses).

    The ``engine`` "local" makes calls in this process, one after the other. The engine "ray" makes calls on the Ray
    cluster at ``address``.
    """
    with ExitStack() as stack:
        cluster = None if engine == "local" else stack.enter_context(closing(Cluster(address)))
        yield Work(cluster, threads, memory)


class Cluster:
    """A connection to the Ray cluster at ``address``; if this is None, a cluster is started on this machine.

    ``store_bytes`` is the memory for shared objects of a cluster that is started.
    """

    def __init__(self, address: str | None, *, store_bytes: int | None = None) -> None:
        self.ray = ray = require_ray()
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # Ray would hide GPUs from calls
        os.environ.setdefault("RAY_task_oom_retries", str(RETRIES))  # of tasks that Ray ends when memory runs out
        quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
        if ray.is_initialized():
            raise UsageError("engine ray: expected a process without a connection to Ray; call ray.shutdown() first")
        if address is None:
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            ray.init(address="local", include_dashboard=False, object_store_memory=store_bytes, **quiet)
            return
        try:
            host, _, port = address.removeprefix("ray://").rpartition(":")
            if host and port.isdecimal():  # if nothing listens there, Ray itself would wait for minutes
                connect_timeout = 10.0  # seconds to reach a cluster
                socket.create_connection((host.strip("[]"), int(port)), timeout=connect_timeout).close()
            ray.init(address=address, **quiet)
        except (OSError, ValueError, RuntimeError) as error:
            problem = f"no Ray cluster answers there ({' '.join(str(error).split())[:200]})"
            raise SceneError(address, problem, "start one with ray start --head") from error

    @property
    def processors(self) -> int:
        """Number of processors of all nodes."""
        return int(self.ray.cluster_resources().get("CPU", 1.0))

    def needs(self, threads: int, memory: int) -> dict[str, float]:
        """Return the resources that a task with ``threads`` and ``memory`` bytes requests from Ray.

        The requests are limited to the resources of the largest node, because a task that requests more would wait
        forever. Raises UsageError if no node has processors.
        """
        nodes = [node["Resources"] for node in self.ray.nodes() if node["Alive"] and node["Resources"].get("CPU")]
        if not nodes:
            raise UsageError("engine ray: expected nodes with processors, found none in the cluster")
        largest = max(nodes, key=lambda node: (min(memory, node.get("memory", 0.0)), node["CPU"]))
        return {"num_cpus": min(threads, largest["CPU"]), "memory": min(memory, int(largest.get("memory", 0.0)))}

    def close(self) -> None:
        """Disconnect from the cluster."""
        self.ray.shutdown()


@dataclass(frozen=True)
class Work:
    """An engine that makes calls in this process or on a cluster."""

    cluster: Cluster | None
    threads: int | None
    memory: int

    def share(self, value: Any) -> Any:
        """Return what to pass in place of a large argument, so that calls on a cluster share one copy of it."""
        return value if self.cluster is None else self.cluster.ray.put(value)

    def run(
        self, title: str, function: Callable[..., T], count: int, calls: Iterable[tuple[Any, ...]]
    ) -> Iterator[tuple[T, Record]]:
        """Make ``count`` calls of a picklable function; yield the result and the record of each call, in order.

        Reports of progress show ``title``. A cluster makes as many calls at once as its processors allow. This process
        makes one call after the other.
        """
        if self.cluster is not None:
            yield from self._run_on_cluster(self.cluster, title, function, count, calls)
            return
        number = 0
        for arguments in calls:  # enumerate would keep these arguments in memory until the next arguments are made
            number += 1  # noqa: SIM113
            with record_part(title=f"block {number} of {count}: {title}") as record:
                result = function(*arguments)
            del arguments
            yield result, record

    def _run_on_cluster(
        self, cluster: Cluster, title: str, function: Callable[..., T], count: int, calls: Iterable[tuple[Any, ...]]
    ) -> Iterator[tuple[T, Record]]:
        """Make the calls of :meth:`run` on a cluster. Results are yielded in order, after the last call has ended."""
        even_share = max(1, cluster.processors // count)  # threads of each call, if all calls run at once
        granted = cluster.needs(self.threads or even_share, self.memory)
        pool, results = RayPool(cluster, max(1, int(granted["num_cpus"]))), dict[int, Any]()

        def make_calls() -> Iterator[Call]:
            for number, arguments in enumerate(calls):
                yield Call(number, (pool.threads, function, *arguments), self.memory)

        for number, result in pool.run(_call_in_part, make_calls()):
            if isinstance(result, LostProcess):
                raise UsageError(f"engine ray: {title}: {result.reason}; perhaps out of memory, try more blocks")
            results[number] = result
            report_progress(f"{title}: {len(results)} of {count} blocks", len(results), count)
        for number in range(len(results)):
            yield results.pop(number)


def _call_in_part(threads: int, function: Callable[..., T], *arguments: Any) -> tuple[T, Record]:
    """Make a call on ``threads`` threads; return its result, and a record of this call alone."""
    with use_threads(threads), record_part() as record:
        return function(*arguments), replace(record, progress=None)


class RayPool(WorkerPool):
    """A pool that makes up to ``jobs`` calls at once on a Ray cluster; if ``jobs`` is 0, on all processors."""

    def __init__(self, cluster: Cluster, threads: int, *, jobs: int = 0) -> None:
        self.cluster, self.ray = cluster, cluster.ray
        self.threads = threads
        self.jobs = jobs
        calls_per_process = 200  # then a process is replaced, so that memory leaks of libraries cannot add up
        self.function = self.ray.remote(max_retries=RETRIES, max_calls=calls_per_process)(_call_in_folder)
        self.keys: dict[Any, Any] = {}  # key of each running call, by the reference to its result

    @property
    def capacity(self) -> int:  # type: ignore[override]
        """Largest number of calls at the same time, which changes with the size of the cluster."""
        return self.jobs or max(1, self.cluster.processors // self.threads)

    def submit(self, function: Callable[..., Any], call: Call) -> None:
        """Start a call."""
        needs = self.cluster.needs(self.threads, call.memory)
        self.keys[self.function.options(**needs).remote(os.getcwd(), function, *call.arguments)] = call.key

    def wait(self) -> list[tuple[Any, Any]]:
        """Wait until a call ends; return the keys and results of all calls that have ended."""
        ready, pending = self.ray.wait(list(self.keys), num_returns=1, timeout=None)
        if pending:
            ready += self.ray.wait(pending, num_returns=len(pending), timeout=0)[0]
        return [(self.keys.pop(ref), self._result(ref)) for ref in ready]

    def _result(self, ref: Any) -> Any:
        """Return a call's result, or a LostProcess if its process was lost; raise the exception of a failed call."""
        try:
            return self.ray.get(ref)
        except self.ray.exceptions.RayTaskError as error:
            raise error.cause if isinstance(error.cause, Exception) else error from None
        except self.ray.exceptions.RayError as error:
            text = " ".join(str(error).split())[:200]
            return LostProcess(f"its process or node was lost {RETRIES + 1} times ({type(error).__name__}: {text})")

    def close(self) -> None:
        """Cancel the calls that have not ended."""
        for ref in self.keys:
            with suppress(self.ray.exceptions.RayError, ValueError):
                self.ray.cancel(ref, force=True)


def _call_in_folder(folder: str, function: Callable[..., T], *arguments: Any) -> T:
    """Make a call in the working directory of the caller, because relative paths refer to it."""
    with suppress(OSError):
        os.chdir(folder)
    return function(*arguments)


def require_ray() -> ModuleType:
    """Import Ray; raise UsageError if Ray is not installed."""
    try:
        import ray
    except ImportError as error:
        raise UsageError('engine ray: Ray is not installed; run pip install "ray>=2.9,<3"') from error
    return ray
