"""Plan a batch: how many scenes at once, and which ones are left to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from heapq import nlargest
from itertools import accumulate
from pathlib import Path

from gsmerge.batch.jobs import BatchOptions, Job
from gsmerge.batch.records import RecordIndex
from gsmerge.errors import SceneError
from gsmerge.runtime.memory import free_memory
from gsmerge.runtime.threads import available_threads

FREE_MEMORY_SHARE = 0.8  # of the free memory that scenes at once may take, where their number is not given


@dataclass(frozen=True)
class Concurrency:
    """How many scenes are compacted at once, each on how many threads."""

    jobs: int  # 0: as many as the cluster has processors for
    threads: int

    def __str__(self) -> str:
        return f"{self.jobs or 'as many as the cluster has room for'} at once, {self.threads} thread(s) each"


def choose_concurrency(jobs: Sequence[Job], options: BatchOptions) -> Concurrency:
    """Divide the processors among scenes: a thread for each, as far as there are scenes and free memory."""
    threads, processors = options.settings.threads, available_threads()
    if options.engine == "ray":
        return Concurrency(options.jobs or 0, threads or 1)
    count, free = options.jobs, free_memory()
    if count is None:
        count = processors // (threads or 1)
        sums = accumulate(nlargest(count, (job.memory for job in jobs)))
        count = count if free is None else sum(total <= FREE_MEMORY_SHARE * free for total in sums)
    count = max(1, min(count, len(jobs)))
    return Concurrency(count, threads or max(1, processors // count))


def pending_jobs(jobs: Sequence[Job], folder: Path, options: BatchOptions) -> list[Job]:
    """List the jobs whose result is not done; all where they are to be done again."""
    results = RecordIndex(folder).read_on().results

    def is_done(job: Job) -> bool:
        known = results.get(job.output)
        try:
            return known is not None and known.holds(folder, job.call.key(job.find_files()))
        except SceneError:
            return False

    return [job for job in jobs if options.overwrite or not is_done(job)]
