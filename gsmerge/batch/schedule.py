"""Plan a batch: how many scenes at once, which ones are left to do, and how long they take."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from heapq import nlargest
from itertools import accumulate
from pathlib import Path

from gsmerge.batch.jobs import BatchOptions, Job
from gsmerge.batch.records import RecordIndex
from gsmerge.errors import SceneError, UsageError
from gsmerge.facts.scene_size import SceneSize
from gsmerge.plan import plan_whole
from gsmerge.runtime.estimate import IMPORT_SECONDS, work_seconds
from gsmerge.runtime.memory import free_memory
from gsmerge.runtime.threads import available_threads
from gsmerge.scene.content_hash import cameras_of

FREE_MEMORY_SHARE = 0.8  # of the free memory that scenes at once may take, where their number is not given


@dataclass(frozen=True)
class Schedule:
    """How many scenes are compacted at once, each on how many threads."""

    jobs: int  # 0: as many as the cluster has processors for
    threads: int


def make_schedule(jobs: Sequence[Job], options: BatchOptions) -> Schedule:
    """Divide the processors among scenes: one thread each, as far as scenes and free memory allow."""
    threads, processors = options.settings.threads, available_threads()
    if options.engine == "ray":
        return Schedule(options.jobs or 0, threads or 1)
    count, free = options.jobs, free_memory()
    if count is None:
        count = processors // (threads or 1)
        sums = accumulate(nlargest(count, (job.memory for job in jobs)))
        count = count if free is None else sum(total <= FREE_MEMORY_SHARE * free for total in sums)
    count = max(1, min(count, len(jobs)))
    return Schedule(count, threads or max(1, processors // count))


def pending_jobs(jobs: Sequence[Job], folder: Path, options: BatchOptions) -> list[Job]:
    """List the jobs whose result is not done, or all jobs if they are to be done again."""
    results = RecordIndex(folder).read_on().results

    def is_done(job: Job) -> bool:
        known = results.get(job.output)
        try:
            return known is not None and known.holds(folder, job.call.key(job.find_files()))
        except SceneError:
            return False

    return [job for job in jobs if options.overwrite or not is_done(job)]


def estimate_seconds(jobs: Sequence[Job], schedule: Schedule) -> float:
    """Estimate the wall time of all jobs in seconds, within a factor of about two."""
    total = 0.0
    for job in (job for job in jobs if job.num_gaussians):  # the run says what cannot be read
        views = 1  # where cameras cannot be read
        with suppress(SceneError):
            files = job.find_files()
            cameras = None if files.cameras is None else cameras_of(files.cameras, files.ply.stem)
            views = max(1, len(cameras or ()))
        settings = job.call.settings
        size = SceneSize(job.num_gaussians, views, 1, -(-job.num_gaussians // views), aligned=True, photos=True)
        with suppress(UsageError):  # the run says so
            whole = plan_whole(size, settings)
            seconds = work_seconds(
                job.num_gaussians, size.width, whole.settings(settings), photos=True, fit_steps=whole.fit.steps
            )
            total += seconds / min(schedule.threads, views)
    return IMPORT_SECONDS * bool(jobs) + total / max(1, min(schedule.jobs, len(jobs)))


def estimate_memory(jobs: Sequence[Job], schedule: Schedule) -> int:
    """Estimate the bytes that the largest scenes take together, within a factor of about two."""
    return sum(nlargest(schedule.jobs or 1, (job.memory for job in jobs)))
