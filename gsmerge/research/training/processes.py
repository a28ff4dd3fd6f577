"""Training in several processes, started by ``torchrun``, that share the work and gather all results."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

T = TypeVar("T")
TIMEOUT = timedelta(days=2)  # of waiting for a process that still prepares examples


@dataclass(frozen=True)
class Processes:
    """The processes of a training run, each taking every ``count``-th item; one process without ``torchrun``."""

    rank: int = 0  # of this process
    count: int = 1

    def require_even(self, crops: int) -> None:
        """Raise ValueError if the processes cannot share ``crops`` per step evenly."""
        if crops % self.count:
            raise ValueError(f"crops: expected a multiple of the {self.count} processes, got {crops}")

    def share(self, items: Sequence[T]) -> Sequence[T]:
        """Return this process's share of the items."""
        return items[self.rank :: self.count]

    def gather(self, results: list[T]) -> list[T]:
        """Collect the results of all processes, in the order of the items."""
        if self.count == 1:
            return results
        parts: list[Any] = [None] * self.count
        dist.all_gather_object(parts, results)
        merged = [None] * sum(map(len, parts))
        for rank, part in enumerate(parts):
            merged[rank :: self.count] = part
        return merged  # type: ignore[return-value]

    def gather_rows(self, rows: Tensor) -> Tensor:
        """Collect rows ``[n/count,d]`` of all processes to ``[n,d]``, in the order of the items."""
        if self.count == 1:
            return rows
        parts = [torch.empty_like(rows) for _ in range(self.count)]
        dist.all_gather(parts, rows.contiguous())
        return torch.stack(parts, 1).flatten(0, 1)


ALONE = Processes()


@contextmanager
def join_processes(device: str) -> Iterator[Processes]:
    """Connect to the other processes that ``torchrun`` started, if any, over gloo or, on ``"cuda"``, NCCL."""
    if not {"RANK", "WORLD_SIZE", "MASTER_ADDR"} <= os.environ.keys() or os.environ["WORLD_SIZE"] == "1":
        yield ALONE
        return
    if device == "cuda":
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
    dist.init_process_group("nccl" if device == "cuda" else "gloo", timeout=TIMEOUT)
    try:
        yield Processes(dist.get_rank(), dist.get_world_size())
    finally:
        dist.destroy_process_group()


def local_count() -> int:
    """Return the number of this run's processes on this machine; 1 without ``torchrun``."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
