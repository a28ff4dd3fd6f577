"""A batch on a Ray cluster. Ray is an extra: it is imported only for ``engine="ray"``.

Ray schedules by a scene's threads and memory, and reports which tasks were lost with a process or a node; retries,
records and locks are those of any other run. Scenes and output folder must have the same paths on all nodes.
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
from gsmerge.batch.records import LOST, RecordIndex, record
from gsmerge.batch.task import BatchContext, Task, run_task
from gsmerge.errors import SceneError, UsageError
from gsmerge.options import CHECKPOINTS

SCENES_PER_PROCESS = 200  # then it is replaced by a new one
EXTRA_TASKS = 2  # submitted beyond those that the cluster has processors for
CONNECT_TIMEOUT = 10.0  # seconds to reach a cluster
CLUSTER_SIZE_SECONDS = 5.0  # between two queries of the cluster's size


def require_ray() -> ModuleType:
    """The module of Ray; a UsageError if it is not installed."""
    try:
        import ray
    except ImportError as error:
        raise UsageError("engine ray: Ray is not installed; pip install 'ray>=2.9,<3'") from error
    return ray


class RayPool:
    """Scenes as tasks of a Ray cluster: ``jobs`` at once; 0: as many as it has processors for.

    A UsageError if Ray is not installed, a SceneError if there is no cluster at the address.
    """

    def __init__(self, context: BatchContext, jobs: int) -> None:
        self.ray = require_ray()
        self.context, self.jobs = context, jobs
        _join(self.ray, context.options)
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
            processors = self.ray.cluster_resources().get("CPU", 1.0)
            self.capacity = max(1, int(processors // self._threads())) + EXTRA_TASKS
            self.counted = time.monotonic()
        return len(self.tasks) < self.capacity

    def _threads(self) -> int:
        return self.context.options.settings.threads or 1

    def _largest(self, resource: str) -> float:
        """The most of a resource that a node has: a task that needs more would wait for ever."""
        nodes = [node["Resources"] for node in self.ray.nodes() if node["Alive"]]
        return max((node.get(resource, 0.0) for node in nodes), default=0.0)

    def submit(self, task: Task) -> None:
        """Take a scene."""
        memory = min(task.job.memory, int(self._largest("memory")))
        processors = min(self._threads(), max(1.0, self._largest("CPU")))
        ref = self.function.options(num_cpus=processors, memory=memory).remote(task, self.shared)
        self.tasks[ref] = task

    def wait(self, seconds: float) -> list[tuple[Task, dict[str, Any]]]:
        """Scenes that ended, after at most so many seconds: records, or that the process or its node was lost."""
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
        _check_connection(options.address)
        ray.init(address=options.address, **quiet)
    except (OSError, ValueError, RuntimeError) as error:
        problem = f"no Ray cluster answers there ({' '.join(str(error).split())[:200]})"
        raise SceneError(options.address, problem, "start one with ray start --head") from error


def _check_connection(address: str) -> None:
    """An OSError if nothing listens at the address; Ray itself would wait for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_TIMEOUT).close()


def run_remote(task: Task, context: BatchContext) -> dict[str, Any]:
    """One scene in a process of the cluster, which ends with a scene that takes too long."""
    with _limited(context.options.timeout):
        return run_task(task, context, _new_records(context.folder, context.start))


@lru_cache(maxsize=1)
def _new_records(folder: Path, start: int) -> RecordIndex:
    """Records since the run began, shared by the tasks of a process."""
    return RecordIndex(folder, start)


@contextlib.contextmanager
def _limited(seconds: float | None) -> Iterator[None]:
    """A block that ends the process after ``seconds``, even while it runs compiled code."""
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
