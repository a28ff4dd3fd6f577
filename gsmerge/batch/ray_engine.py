"""The same work on a Ray cluster. Ray is an extra: nothing imports it before it is asked for.

Ray schedules, with a scene's threads and memory as what it needs, and says which tasks were lost with a process or a
node; trying them again, records and locks are those of any other run. Scenes and output folder have to be at the same
paths on all nodes.
"""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import os
import socket
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

from gsmerge.batch.options import BatchOptions
from gsmerge.batch.records import LOST, Index, record
from gsmerge.batch.task import Task, Work, run_task
from gsmerge.errors import SceneError, UsageError
from gsmerge.options import CHECKPOINTS

SCENES = 200  # that a process works on before it makes way for a new one
WAITING = 2  # scenes that Ray is given beyond those that it has processors for
KNOCK = 10.0  # seconds to reach a cluster
COUNT_AGAIN = 5.0  # seconds until the cluster is asked for its size again


def require_ray() -> ModuleType:
    """Ray.

    Raises:
        UsageError: If it is not installed.
    """
    try:
        import ray
    except ImportError as error:
        raise UsageError("engine ray: Ray is not installed; pip install 'gsmerge[ray]'") from error
    return ray


class RayPool:
    """Scenes as tasks of a Ray cluster.

    Args:
        work: What all tasks share.
        jobs: Scenes at once; 0: as many as the cluster has processors for.

    Raises:
        UsageError: If Ray is not installed.
        SceneError: If there is no cluster at the address.
    """

    def __init__(self, work: Work, jobs: int) -> None:
        self.ray = require_ray()
        self.work, self.jobs = work, jobs
        _join(self.ray, work.options)
        self.shared = self.ray.put(work)
        self.function = self.ray.remote(max_retries=0, max_calls=SCENES)(run_remote)
        self.tasks: dict[Any, Task] = {}
        self.counted, self.capacity = float("-inf"), 1

    @property
    def has_room(self) -> bool:
        """Whether another scene can be taken."""
        if self.jobs:
            return len(self.tasks) < self.jobs
        if time.monotonic() > self.counted + COUNT_AGAIN:
            processors = self.ray.cluster_resources().get("CPU", 1.0)
            self.capacity = max(1, int(processors // self._threads())) + WAITING
            self.counted = time.monotonic()
        return len(self.tasks) < self.capacity

    def _threads(self) -> int:
        return self.work.options.settings.threads or 1

    def _largest(self, resource: str) -> float:
        """What the largest node has of a resource: a task that asks for more would wait for ever."""
        nodes = [node["Resources"] for node in self.ray.nodes() if node["Alive"]]
        return max((node.get(resource, 0.0) for node in nodes), default=0.0)

    def submit(self, task: Task) -> None:
        """Take a scene."""
        memory = min(task.job.memory, int(self._largest("memory")))
        processors = min(self._threads(), max(1.0, self._largest("CPU")))
        ref = self.function.options(num_cpus=processors, memory=memory).remote(task, self.shared)
        self.tasks[ref] = task

    def wait(self, seconds: float) -> list[tuple[Task, dict[str, Any]]]:
        """What has ended, after at most so many seconds: records, or that the process or its node was lost."""
        ready, rest = self.ray.wait(list(self.tasks), num_returns=1, timeout=seconds)
        if ready and rest:
            ready += self.ray.wait(rest, num_returns=len(rest), timeout=0)[0]
        ended = [(ref, self.tasks.pop(ref)) for ref in ready]
        return [(task, self._result(ref, task)) for ref, task in ended]

    def _result(self, ref: Any, task: Task) -> dict[str, Any]:
        try:
            return self.ray.get(ref)
        except self.ray.exceptions.RayError as error:
            limit = self.work.options.timeout
            why = f"its process or node was lost ({type(error).__name__})"
            why += "" if limit is None else f", or it took longer than {limit:g} s (--timeout)"
            return record(LOST, task.job.scene, task.job.output, error=why)

    def close(self) -> None:
        """End everything that is under way, and leave the cluster."""
        for ref in self.tasks:
            with contextlib.suppress(self.ray.exceptions.RayError, ValueError):
                self.ray.cancel(ref, force=True)
        self.ray.shutdown()


def _join(ray: ModuleType, options: BatchOptions) -> None:
    """Connect to the cluster, or start one of this machine alone."""
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    if options.address is None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        ray.init(address="local", include_dashboard=False, object_store_memory=100 << 20, **quiet)
        return
    try:
        _knock(options.address)
        ray.init(address=options.address, **quiet)
    except (OSError, ValueError, RuntimeError) as error:
        told = " ".join(str(error).split())[:200]
        raise SceneError(
            options.address, f"no Ray cluster answers there ({told})", "start one with ray start --head"
        ) from error


def _knock(address: str) -> None:
    """See that somebody listens there; Ray itself would wait for minutes.

    Raises:
        OSError: If nobody does.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), timeout=KNOCK).close()


def run_remote(task: Task, work: Work) -> dict[str, Any]:
    """One scene in a process of the cluster; one that takes too long takes its process with it."""
    with _limited(work.options.timeout):
        return run_task(task, work, _later(work.folder, work.start))


@lru_cache(maxsize=1)
def _later(folder: Path, start: int) -> Index:
    """What was recorded since the run began, kept from task to task."""
    return Index(folder, start)


@contextlib.contextmanager
def _limited(seconds: float | None) -> Iterator[None]:
    """A block that may take so long; the watch needs nothing of Python, whatever the block is doing."""
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
    """The options with paths that mean the same on every node."""
    settings = options.settings
    if settings.checkpoint not in CHECKPOINTS:
        settings = replace(settings, checkpoint=os.path.abspath(settings.checkpoint))
    cameras, images = (
        path if path is None or path.startswith("{") else os.path.abspath(path)
        for path in (options.cameras, options.images)
    )
    return replace(options, settings=settings, cameras=cameras, images=images)
