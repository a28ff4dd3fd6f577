"""Children of groups for every number of them, as a sequence of splits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmerge.kernels.gaussians.bisect import gather_groups
from gsmerge.networks.corrector import Corrector
from gsmerge.pooling import Members, feature_to_gaussians
from gsmerge.stages.decode import deal_order, halve, pool_children
from gsmerge.types import FeatureGaussians, Gaussians


@dataclass(frozen=True, eq=False)
class Division:
    """The children of every Feature Gaussian for all K up to a limit, stored as a sequence of splits.

    Each split halves one child (:mod:`gsmerge.stages.decode`), so the children for K are those for K - 1 with one
    replaced by its two halves. This takes a third of the members' bytes, and decoding has nothing to pool.
    """

    # [g] uint8, times that each group is split. Where heads make the children of nothing, that is all there is, and
    # the three arrays after it are empty.
    splits: np.ndarray
    slots: np.ndarray  # [s] uint8, which child, counted in order from 0, each split replaces; group by group
    # [w] int64, rising: the groups whose members are all alike. Asked for more, they give one child.
    uniform: np.ndarray
    children: Gaussians  # 2s + w Gaussians, canonical: two for each split, then one for each of `uniform`
    growth_order: np.ndarray  # [d] int64, the group that each further Gaussian goes to, where it helps most first

    @property
    def by_heads(self) -> bool:
        """Whether decoder heads make all children, so that none are stored."""
        return len(self.slots) < self.num_splits

    @property
    def num_splits(self) -> int:
        """Number of splits in all groups; each adds one Gaussian."""
        return int(self.splits.sum(dtype=np.int64))


def divide_all(features: FeatureGaussians, members: Members, max_k: int) -> Division:
    """Divide every group into up to ``max_k`` children."""
    count = len(features)
    rows = np.arange(count)
    sizes = np.diff(features.starts)[rows][:, None]
    none = np.zeros(0, np.int64)
    parts = [pool_children(features, members, np.zeros(1, np.int64), none, none)]
    owners, slots, uniform, uniform_children = [none], [none], none, parts[0]
    for number in range(2, max_k + 1):
        if len(rows) == 0:
            break
        starts, ids, parents = halve(features, members, rows, np.full(count, number))
        run_counts = np.bincount(parents, minlength=count)[rows]
        grown, first = run_counts == number, np.cumsum(run_counts) - run_counts
        if number == 2:
            uniform = rows[~grown]
            run_starts, run_ids = gather_groups(starts, ids, first[~grown])
            uniform_children = pool_children(features, members, run_starts, run_ids, uniform)
        rows, before = rows[grown], sizes[grown]
        sizes = np.diff(starts)[first[grown, None] + np.arange(number)]
        slot = np.argmax(sizes[:, :-1] != before, axis=1)  # the run that got smaller is the one that was split
        pairs = (first[grown] + slot)[:, None] + np.arange(2)
        run_starts, run_ids = gather_groups(starts, ids, pairs.ravel())
        parts.append(pool_children(features, members, run_starts, run_ids, rows.repeat(2)))
        owners.append(rows)
        slots.append(slot)
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")  # of one group, in the order of the splits
    halves = Gaussians.concat(parts)[(2 * order[:, None] + np.arange(2)).ravel()]
    return Division(
        splits=np.bincount(owner, minlength=count).astype(np.uint8),
        slots=np.concatenate(slots)[order].astype(np.uint8),
        uniform=uniform,
        children=Gaussians.concat([halves, uniform_children]),
        growth_order=deal_order(features, members, max_k),
    )


def make_division(features: FeatureGaussians, members: Members, networks: Corrector, max_k: int) -> Division:
    """Divide every group into up to ``max_k`` children, as :func:`gsmerge.stages.decode.decode` does."""
    if networks.makes_children:
        return divide_by_heads(features, max_k, deal_order(features, members, max_k))
    return divide_all(features, members, max_k)


def divide_by_heads(features: FeatureGaussians, max_k: int, growth_order: np.ndarray | None = None) -> Division:
    """Divide every group into up to ``max_k`` children, for heads that make them of nothing.

    ``growth_order``: by default further children are added where a child represents the most pixels, weighted by the
    opacity of the group's members.
    """
    count = len(features)
    if growth_order is None:
        shares = features.weights[:, None] / np.arange(1, max_k)
        growth_order = np.argsort(-shares.reshape(-1), kind="stable") // max(1, max_k - 1)
    return Division(
        splits=np.full(count, max_k - 1, np.uint8),
        slots=np.zeros(0, np.uint8),
        uniform=np.zeros(0, np.int64),
        children=feature_to_gaussians(features)[:0],
        growth_order=growth_order,
    )


def pick_children(division: Division, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Choose at most ``counts [g]`` children per group; return their rows and groups."""
    splits, slots = division.splits.astype(np.int64), division.slots.astype(np.int64)
    count, uniform = len(splits), division.uniform
    sizes, first = np.minimum(counts, splits + 1), np.cumsum(splits) - splits
    max_size = int(sizes.max(initial=1))
    table = np.zeros((count, max_size), np.int64)
    table[:, 0] = np.arange(count)
    divided = counts[uniform] > 1
    table[uniform[divided], 0] = count + 2 * len(slots) + np.flatnonzero(divided)
    for step in range(1, max_size):
        rows = np.flatnonzero(sizes > step)
        split = first[rows] + step - 1
        slot, places = slots[split][:, None], np.arange(step + 1)
        moved = np.take_along_axis(table[rows, : step + 1], places - (places > slot), 1)
        halves = count + 2 * split[:, None] + (places - slot)
        table[rows, : step + 1] = np.where((places == slot) | (places == slot + 1), halves, moved)
    return table[np.arange(max_size) < sizes[:, None]], np.repeat(np.arange(count), sizes)
