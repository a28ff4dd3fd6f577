"""Runs: rows that belong together lie next to one another, so that sums have a fixed order on every device.

Sums by scattering have none on a GPU, and differ in their last bits from run to run. Here rows are sorted by their
group once, and every group is summed from its first row to its last.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows by group, without empty groups.

    Args:
        starts: ``[g+1]`` int64 into ``ids``.
        ids: ``[m]`` int64 rows, group by group, rising within each.
        groups: ``[g]`` int64 the group's number among all, empty ones included, rising.
    """

    starts: Tensor
    ids: Tensor
    groups: Tensor

    def __len__(self) -> int:
        return len(self.groups)

    @property
    def sizes(self) -> Tensor:
        """``[g]`` rows of each group."""
        return self.starts[1:] - self.starts[:-1]

    @property
    def owners(self) -> Tensor:
        """``[m]`` the group of each row, from 0."""
        return owners_of(self.starts, len(self.ids))


def group_rows(labels: Tensor, count: int) -> Rows:
    """Rows of labels ``[n]`` by label: a stable sort, where the kernel ``group_members`` counts.

    Args:
        labels: ``[n]`` int64, 0 to ``count - 1``; rows of those below 0 belong to no group.
        count: Number of labels.
    """
    keys = torch.where(labels < 0, count, labels)
    ids = torch.sort(keys, stable=True).indices
    sizes = torch.bincount(keys, minlength=count + 1)[:count]
    groups = torch.nonzero(sizes)[:, 0]
    starts = start_of(sizes[groups])
    return Rows(starts, ids[: int(starts[-1])], groups)


def start_of(sizes: Tensor) -> Tensor:
    """``[g+1]`` int64 where runs of some sizes ``[g]`` begin, and where the last one ends."""
    return torch.cat([torch.zeros(1, dtype=torch.int64, device=sizes.device), sizes.cumsum(0)])


def owners_of(starts: Tensor, count: int) -> Tensor:
    """``[count]`` the run that each row is in, for runs that begin at ``starts [g+1]``."""
    numbers = torch.arange(len(starts) - 1, device=starts.device)
    return torch.repeat_interleave(numbers, starts[1:] - starts[:-1], output_size=count)


def sum_runs(values: Tensor, starts: Tensor) -> Tensor:
    """``[g,...]`` sums over the runs that begin at ``starts [g+1]`` of ``values [m,...]``, in the order of the rows."""
    return _reduce(values, starts, "sum")


def max_runs(values: Tensor, starts: Tensor) -> Tensor:
    """``[g,...]`` largest of every run of ``values [m,...]``; runs are not empty."""
    return _reduce(values, starts, "max")


def _reduce(values: Tensor, starts: Tensor, how: str) -> Tensor:
    num_groups, shape = len(starts) - 1, values.shape[1:]
    if num_groups == 0 or values.numel() == 0:
        return values.new_zeros(num_groups, *shape)
    flat = values.reshape(len(values), -1).contiguous()
    return torch.segment_reduce(flat, how, offsets=starts, axis=0).reshape(num_groups, *shape)


def middle_of_runs(values: Tensor, starts: Tensor, owners: Tensor) -> Tensor:
    """``[g]`` median of every run of ``values [m]``, of two middle ones the smaller; runs are not empty.

    Args:
        values: Float32, not negative: their bits are in the order of the numbers.
        starts: ``[g+1]``.
        owners: ``[m]`` run of each.
    """
    keys = owners << 32 | values.contiguous().view(torch.int32).long()
    order = torch.sort(keys).indices
    return values[order[(starts[:-1] + starts[1:] - 1) // 2]]


def order_by_part(values: Tensor, parts: Tensor) -> Tensor:
    """Rows in the order of ``parts [n]``, within each by rising ``values [n]``, equal ones as they come."""
    by_value = torch.sort(values, stable=True).indices
    return by_value[torch.sort(parts[by_value], stable=True).indices]


def ranks_by_part(values: Tensor, parts: Tensor, num_parts: int) -> Tensor:
    """``[n]`` place of every row among the rows of its part when they are sorted as by :func:`order_by_part`."""
    order = order_by_part(values, parts)
    first = start_of(torch.bincount(parts, minlength=num_parts))
    ranks = torch.empty_like(order)
    ranks[order] = torch.arange(len(order), device=order.device) - first[parts[order]]
    return ranks


def smallest_by_part(values: Tensor, parts: Tensor, ranks: Tensor) -> Tensor:
    """``[p]`` the number of rank ``ranks [p]`` (0: smallest) among the values of each part; inf where there is none."""
    counts = torch.bincount(parts, minlength=len(ranks))
    ordered = values[order_by_part(values, parts)]
    if len(ordered) == 0:
        return torch.full(ranks.shape, torch.inf, dtype=values.dtype, device=values.device)
    places = start_of(counts)[:-1] + ranks
    return torch.where(ranks < counts, ordered[places.clamp(0, len(ordered) - 1)], torch.inf)
