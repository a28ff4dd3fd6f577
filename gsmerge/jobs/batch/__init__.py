"""Compact many scenes with :func:`gsmerge.run.compact_files`, on this machine or on a cluster."""

from gsmerge.jobs.batch.jobs import BatchOptions, Job, find_jobs
from gsmerge.jobs.batch.run import run_batch

__all__ = ["BatchOptions", "Job", "find_jobs", "run_batch"]
