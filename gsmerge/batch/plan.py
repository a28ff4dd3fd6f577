"""How many scenes at once with how many threads each, and how long a batch will take."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from heapq import nlargest
from itertools import accumulate
from pathlib import Path

from gsmerge.batch.find import Job
from gsmerge.batch.options import BatchOptions
from gsmerge.errors import SceneError
from gsmerge.io import find_scene_files
from gsmerge.io.content_hash import cameras_of
from gsmerge.runtime.estimate import IMPORT_SECONDS, work_seconds
from gsmerge.runtime.memory import human_bytes, machine_memory
from gsmerge.runtime.threads import available_threads

FREE_MEMORY_SHARE = 0.8  # of the free memory that is used by default


@dataclass(frozen=True)
class Schedule:
    """How many scenes are compacted at once."""

    jobs: int  # scenes at once; 0: as many as the cluster has processors for
    threads: int  # of each
    memory: int  # bytes that the largest of them may take together
    notes: tuple[str, ...] = ()  # where it differs from the options


def make_schedule(jobs: Sequence[Job], options: BatchOptions, *, processors: int | None = None) -> Schedule:
    """Distribute scenes over processors: one thread each where there are enough scenes and memory allows.

    Memory must do for the largest scenes, which may come together; ``processors`` are all without a number.
    """
    processors = available_threads() if processors is None else processors
    threads = options.settings.threads
    if options.engine == "ray":
        return Schedule(options.jobs or 0, threads or 1, max((job.memory for job in jobs), default=0))
    count = options.jobs or max(1, processors // (threads or 1))
    sums = list(accumulate(nlargest(max(1, min(count, len(jobs))), (job.memory for job in jobs)))) or [0]
    limit = free_memory() if options.max_memory is None else options.max_memory
    count, notes = len(sums), []
    if limit is not None and (options.jobs is None or options.max_memory is not None):
        count = max(1, sum(total <= limit for total in sums))
        if options.jobs is not None and count < len(sums):
            notes.append(f"{count} at once instead of {len(sums)}: more may take {human_bytes(sums[count])}")
        if sums[0] > limit:
            notes.append(f"the largest scene alone may take {human_bytes(sums[0])}, the limit is {human_bytes(limit)}")
    return Schedule(count, threads or max(1, processors // count), sums[count - 1], tuple(notes))


def free_memory() -> int | None:
    """Bytes that a run may take by default: most of the free memory; None where the system does not report it."""
    with suppress(OSError, KeyError, ValueError), open("/proc/meminfo", encoding="ascii") as file:
        values = dict(line.split(":", 1) for line in file)
        return int(FREE_MEMORY_SHARE * int(values["MemAvailable"].split()[0]) * 1024)
    machine = machine_memory()
    return None if machine is None else int(FREE_MEMORY_SHARE * machine)


def estimate_seconds(jobs: Sequence[Job], options: BatchOptions, schedule: Schedule) -> float:
    """Wall time of scenes, within a factor of about two."""
    total = 0.0
    for job in jobs:
        views = max(1, _num_views(job))
        own = options.settings if job.work is None else job.work.settings
        flat = own.resolved(photos=True)
        seconds = work_seconds(job.num_gaussians, job.num_gaussians / views, flat, photos=True, fit_steps=own.fit.steps)
        total += seconds / min(schedule.threads, views)
    return IMPORT_SECONDS * bool(jobs) + total / max(1, min(schedule.jobs, len(jobs)))


def _num_views(job: Job) -> int:
    """Views of a scene's cameras; 1 where they cannot be read."""
    try:
        files = find_scene_files(Path(job.scene))
    except SceneError:
        return 1
    cameras = None if files.cameras is None else cameras_of(files.cameras, files.ply.stem)
    return 1 if cameras is None else len(cameras)
