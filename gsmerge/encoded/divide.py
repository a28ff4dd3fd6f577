"""Children of every Feature Gaussian for every K, once; and those of one K picked from them."""

from __future__ import annotations

import numpy as np
import torch

from gsmerge.encoded.encoded import Division
from gsmerge.kernels.gaussians.bisect import gather_groups
from gsmerge.moments import Members, Rule
from gsmerge.stages.decode import deal_order, halve, pool_children
from gsmerge.types import FeatureGaussians, Gaussians


def divide_all(features: FeatureGaussians, members: Members, most: int, rule: Rule) -> Division:
    """All children of every group, up to ``most`` of each; the backing layer is never divided.

    Args:
        features: g Feature Gaussians with their members.
        members: The scene's Gaussians.
        most: Most children of a group, 1 to 8.
        rule: How children are pooled.
    """
    count = len(features)
    rows = np.flatnonzero(~features.backing.numpy())
    sizes = np.diff(features.starts.numpy())[rows][:, None]
    none = np.zeros(0, np.int64)
    parts = [pool_children(features, members, np.zeros(1, np.int64), none, none, rule)]
    owners, slots, alone, whole = [none], [none], none, parts[0]
    for number in range(2, most + 1):
        if len(rows) == 0:
            break
        starts, ids, parents = halve(features, members, rows, np.full(count, number))
        found = np.bincount(parents, minlength=count)[rows]
        grown, first = found == number, np.cumsum(found) - found
        if number == 2:
            alone = rows[~grown]
            own_starts, own = gather_groups(starts, ids, first[~grown])
            whole = pool_children(features, members, own_starts, own, alone, rule)
        rows, before = rows[grown], sizes[grown]
        sizes = np.diff(starts)[first[grown, None] + np.arange(number)]
        slot = np.argmax(sizes[:, :-1] != before, axis=1)  # the run that got smaller is the one that was split
        pairs = (first[grown] + slot)[:, None] + np.arange(2)
        own_starts, own = gather_groups(starts, ids, pairs.ravel())
        parts.append(pool_children(features, members, own_starts, own, rows.repeat(2), rule))
        owners.append(rows)
        slots.append(slot)
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")  # of one group, in the order of the splits
    halves = Gaussians.concat(parts)[torch.from_numpy((2 * order[:, None] + np.arange(2)).ravel())]
    return Division(
        splits=torch.from_numpy(np.bincount(owner, minlength=count).astype(np.uint8)),
        slots=torch.from_numpy(np.concatenate(slots)[order].astype(np.uint8)),
        whole=torch.from_numpy(alone),
        children=Gaussians.concat([halves, whole]),
        deals=torch.from_numpy(deal_order(features, members, most)),
    )


def pick_children(division: Division, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which Gaussians stand for each group, and the group ``[n]`` of each, rising.

    Args:
        division: The children of g groups.
        counts: ``[g]`` most Gaussians of each, at least 1.

    Returns:
        ``[n]`` rows of the g groups themselves (K = 1) followed by the division's children.
    """
    splits, slots = division.splits.numpy().astype(np.int64), division.slots.numpy().astype(np.int64)
    count, whole = len(splits), division.whole.numpy()
    taken, first = np.minimum(counts, splits + 1), np.cumsum(splits) - splits
    widest = int(taken.max(initial=1))
    table = np.zeros((count, widest), np.int64)
    table[:, 0] = np.arange(count)
    asked = counts[whole] > 1
    table[whole[asked], 0] = count + 2 * len(slots) + np.flatnonzero(asked)
    for step in range(1, widest):
        rows = np.flatnonzero(taken > step)
        split = first[rows] + step - 1
        slot, places = slots[split][:, None], np.arange(step + 1)
        moved = np.take_along_axis(table[rows, : step + 1], places - (places > slot), 1)
        halves = count + 2 * split[:, None] + (places - slot)
        table[rows, : step + 1] = np.where((places == slot) | (places == slot + 1), halves, moved)
    return table[np.arange(widest) < taken[:, None]], np.repeat(np.arange(count), taken)
