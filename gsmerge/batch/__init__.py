"""Compact many scenes with :func:`gsmerge.compaction.compact.compact_files`, on this machine or on a cluster."""

from gsmerge.batch.jobs import BatchOptions, Job, find_jobs
from gsmerge.batch.run import run_batch

__all__ = ["BatchOptions", "Job", "find_jobs", "run_batch"]
