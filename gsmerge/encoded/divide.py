"""The children of every Feature Gaussian for every K, and the choice of those of one K."""

from __future__ import annotations

import numpy as np

from gsmerge.encoded.encoded import Division
from gsmerge.kernels.gaussians.bisect import gather_groups
from gsmerge.moments import Members
from gsmerge.stages.decode import deal_order, halve, pool_children
from gsmerge.types import FeatureGaussians, Gaussians


def divide_all(features: FeatureGaussians, members: Members, max_k: int) -> Division:
    """All children of every group, up to ``max_k`` of each."""
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
            own_starts, own = gather_groups(starts, ids, first[~grown])
            uniform_children = pool_children(features, members, own_starts, own, uniform)
        rows, before = rows[grown], sizes[grown]
        sizes = np.diff(starts)[first[grown, None] + np.arange(number)]
        slot = np.argmax(sizes[:, :-1] != before, axis=1)  # the run that got smaller is the one that was split
        pairs = (first[grown] + slot)[:, None] + np.arange(2)
        own_starts, own = gather_groups(starts, ids, pairs.ravel())
        parts.append(pool_children(features, members, own_starts, own, rows.repeat(2)))
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


def pick_children(division: Division, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which Gaussians stand for each of g groups, at most ``counts [g]`` of it, and the rising group of each.

    Returns:
        ``[n]`` rows of the g groups themselves (K = 1) followed by the division's children, and ``[n]`` groups.
    """
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
