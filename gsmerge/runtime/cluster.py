"""Where work in parts is done: in this process, or on a Ray cluster.

Ray is an extra. A call whose process or node is lost is made again, elsewhere, and gives the same.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import ModuleType
from typing import Any, Protocol, TypeVar

from gsmerge.errors import SceneError, UsageError
from gsmerge.runtime.record import Record, record_part, report_progress
from gsmerge.runtime.threads import use_threads

T = TypeVar("T")
CONNECT_TIMEOUT = 10.0  # seconds to reach a cluster
RETRIES = 5  # of a call whose process or node was lost
SMALL_STORE = 100 << 20  # bytes of objects that the tasks of a cluster of this machine may share


class Work(Protocol):
    """Work that is under way: calls are made in it, and objects shared."""

    def run(
        self, title: str, function: Callable[..., T], count: int, calls: Iterable[tuple[Any, ...]]
    ) -> Iterator[tuple[T, Record]]:
        """Make ``count`` calls of a function that can be pickled; yield results and records in their order."""

    def share(self, value: Any) -> Any:
        """Return what to pass in place of a large argument of several calls."""


@contextmanager
def start_work(engine: str, address: str | None = None, *, threads: int | None, memory: int) -> Iterator[Work]:
    """Begin work whose calls take so many threads (None: as fit beside each other) and bytes of memory.

    ``engine``: ``"local"``: in this process, one call after the other; ``"ray"``: on the Ray cluster at ``address``.
    """
    if engine == "local":
        yield LocalWork()
        return
    cluster = Cluster(address)
    try:
        yield ClusterWork(cluster, threads, memory)
    finally:
        cluster.close()


class LocalWork:
    """Calls in this process, one after the other."""

    def run(
        self, title: str, function: Callable[..., T], count: int, calls: Iterable[tuple[Any, ...]]
    ) -> Iterator[tuple[T, Record]]:
        """Make the calls, see :class:`Work`."""
        for place, arguments in enumerate(calls, 1):
            with record_part(title=f"block {place} of {count}: {title}") as record:
                value = function(*arguments)
            yield value, record

    def share(self, value: Any) -> Any:
        """Return the value."""
        return value


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
        """Return what a task asks for, at most what some node has; UsageError if none has a processor.

        A task that needs more waits forever.
        """
        nodes = [node["Resources"] for node in self.ray.nodes() if node["Alive"] and node["Resources"].get("CPU")]
        if not nodes:
            raise UsageError("engine ray: expected nodes with processors, found none in the cluster")
        largest = max(nodes, key=lambda node: (min(memory, node.get("memory", 0.0)), node["CPU"]))
        return {"num_cpus": min(threads, largest["CPU"]), "memory": min(memory, int(largest.get("memory", 0.0)))}

    def close(self) -> None:
        """Disconnect."""
        self.ray.shutdown()


class ClusterWork:
    """Calls on a cluster, side by side."""

    def __init__(self, cluster: Cluster, threads: int | None, memory: int) -> None:
        self.cluster, self.ray, self.threads, self.memory = cluster, cluster.ray, threads, memory

    def run(
        self, title: str, function: Callable[..., T], count: int, calls: Iterable[tuple[Any, ...]]
    ) -> Iterator[tuple[T, Record]]:
        """Make the calls, see :class:`Work`: as many at once as there are processors."""
        processors = self.cluster.processors
        needs = self.cluster.needs(self.threads or max(1, processors // count), self.memory)
        threads = max(1, int(needs["num_cpus"]))
        remote, folder = self.ray.remote(max_retries=RETRIES, **needs)(_call), os.getcwd()
        places, results = dict[Any, int](), dict[int, Any]()

        def wait() -> None:
            (ready, *_), _ = self.ray.wait(list(places), num_returns=1)
            results[places.pop(ready)] = self._result(ready, title)  # an error ends the run at once
            report_progress(f"{title}: {len(results)} of {count} blocks", len(results), count)

        for place, arguments in enumerate(calls):
            while len(places) >= max(1, processors // threads):
                wait()
            places[remote.remote(threads, folder, function, *arguments)] = place
        while places:
            wait()
        for place in range(len(results)):
            yield results.pop(place)

    def share(self, value: Any) -> Any:
        """Put a value where all nodes reach it."""
        return self.ray.put(value)

    def _result(self, ref: Any, title: str) -> Any:
        try:
            return self.ray.get(ref)
        except self.ray.exceptions.RayTaskError as error:
            raise error.cause if isinstance(error.cause, Exception) else error from None
        except self.ray.exceptions.RayError as error:
            text = " ".join(str(error).split())[:200]
            problem = f"its process or node was lost {RETRIES + 1} times ({type(error).__name__}: {text})"
            raise UsageError(f"engine ray: {title}: {problem}; perhaps out of memory, more blocks help") from error


def _call(threads: int, folder: str, function: Callable[..., T], *arguments: Any) -> tuple[T, Record]:
    """Make a call in a process of the cluster, in the folder that relative paths of the caller's files refer to."""
    with contextlib.suppress(OSError):
        os.chdir(folder)
    with use_threads(threads), record_part() as record:
        value = function(*arguments)
    return value, replace(record, progress=None)


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
            with contextlib.closing(socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_TIMEOUT)):
                pass
        ray.init(address=address, **quiet)
    except (OSError, ValueError, RuntimeError) as error:
        problem = f"no Ray cluster answers there ({' '.join(str(error).split())[:200]})"
        raise SceneError(address, problem, "start one with ray start --head") from error
