"""Compact many scenes, each on its own and recorded at once, on this machine or on a cluster."""

from gsmerge.batch.batch_options import BatchOptions
from gsmerge.batch.find import Job, find_jobs
from gsmerge.batch.schedule import run_batch

__all__ = ["BatchOptions", "Job", "find_jobs", "run_batch"]
