"""Encoded scene -> Gaussians: a choice among the stored children, without images."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmerge.budget import exact_count
from gsmerge.errors import UsageError
from gsmerge.fit import visible_mask
from gsmerge.kernels.gaussians.bisect import gather_groups
from gsmerge.moments import Members, feature_to_gaussians, gaussian_members
from gsmerge.raster.photos import blank_photos
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.budget import AUTO, BudgetOptions
from gsmerge.settings.stages import MAX_CHILDREN
from gsmerge.stages.decode import deal_order, deal_visible, halve, pool_children
from gsmerge.states.encoded import Division, Encoded
from gsmerge.types import FeatureGaussians, Gaussians


@dataclass(frozen=True, eq=False)
class DecodePlan:
    """Number of Gaussians to decode, per group and in all."""

    counts: np.ndarray  # [g] most Gaussians of each group
    min_contribution: float  # See StoredSettings; 0: contributions are not measured
    total: int | None = None  # Gaussians to be met; None: as many as can be seen
    notes: tuple[str, ...] = ()  # What differs from what was asked for, one sentence each


def plan_decode(encoded: Encoded, *, k: int | None = None, budget: int | str | None = None) -> DecodePlan:
    """Plan how many Gaussians each group becomes; see :func:`decode_scene`."""
    s = encoded.settings
    if budget is not None and k is not None:
        raise UsageError("expected one of k and budget, got both")
    auto = AUTO in (budget, s.k) and k is None and budget in (None, AUTO)
    if s.target_count is not None and k is None and (budget is None or (auto and s.k == AUTO)):
        return _distribute(encoded, s.target_count)
    if auto:
        plan = _distribute(encoded, max(len(encoded), s.knee_count))
        if s.knee_count >= len(encoded):
            return plan
        note = f"budget auto would take {s.knee_count} Gaussians, fewer than there are groups; encode with budget auto"
        return replace(plan, notes=(note,))
    if budget is not None:
        return _distribute(encoded, _group_budget(encoded, budget))
    number = s.k if k is None else k
    if not isinstance(number, int) or not 1 <= number <= s.max_k:
        more = "" if s.max_k == MAX_CHILDREN else ", as encoded (more with a larger max k)"
        raise UsageError(f"k: expected 1 to {s.max_k}{more}, got {number!r}")
    if s.num_slots is not None:
        plan = _distribute(encoded, s.num_slots * number)
        return replace(plan, min_contribution=s.min_contribution, total=None)
    return DecodePlan(np.full(len(encoded), number), s.min_contribution)


def _group_budget(encoded: Encoded, budget: int | str) -> int:
    """Return the number of Gaussians that a budget leaves for the groups."""
    try:
        count = exact_count(BudgetOptions(budget), encoded.settings.num_input, encoded.sh_degree)
    except ValueError as error:
        raise UsageError(str(error)) from error
    if count is None:
        raise UsageError(f"budget: expected a number, a share or a size, got {budget}; encode with that budget")
    min_count = len(encoded) + encoded.num_kept
    if count < min_count:
        raise UsageError(
            f"budget: expected at least {min_count}, one for each group, got {count}; encode with that budget"
        )
    return count - encoded.num_kept


def _distribute(encoded: Encoded, total: int) -> DecodePlan:
    """Distribute a number of Gaussians to the groups where they help most."""
    order, extra = encoded.division.growth_order, max(0, total - len(encoded))
    counts = 1 + np.bincount(order[:extra], minlength=len(encoded))
    if extra <= len(order):
        return DecodePlan(counts, 0.0, total)
    limit, count = len(encoded) + len(order) + encoded.num_kept, total + encoded.num_kept
    note = f"{count} Gaussians were asked for, and the groups divide into {limit} at most"
    return DecodePlan(counts, 0.0, total, (note,))


def decode_scene(
    encoded: Encoded, *, k: int | None = None, budget: int | str | None = None, threads: int | None = None
) -> Gaussians:
    """Decode an encoded scene into Gaussians in the scene's own world frame, without a fit.

    Args:
        encoded: From :func:`encode_scene` or :func:`load_encoded`.
        k: Gaussians of each group, 1 to the largest number encoded. None: the encoding's own.
        budget: Gaussians in all instead: a number from one for each group on, a share of the input as "2%", a size as
            "5MB", or ``"auto"``: up to the knee of the superpixels' distortion, where they help most.
        threads: Threads to use; None: all processors. The result does not depend on it.

    Raises:
        UsageError: If K is more than was encoded, the budget below the number of groups, or both are given.

    Example:
        >>> encoded = gsmerge.encode_scene(gsmerge.read_scene("demo"), superpixels="2%")
        >>> len(gsmerge.decode_scene(encoded, budget=100))
        100
    """
    plan, s = plan_decode(encoded, k=k, budget=budget), encoded.settings
    with use_threads(threads):
        if plan.total is None:
            gaussians, _ = children_of(encoded, plan.counts)
            gaussians = gaussians[gaussians.opacities >= s.min_opacity]
        else:
            order, g = encoded.division.growth_order, len(encoded)
            gaussians = deal_visible(order, g, plan.total, s.min_opacity, lambda n: children_of(encoded, n)[0])
        if plan.min_contribution > 0:
            gaussians = gaussians[visible_mask(gaussians, blank_photos(encoded.cameras, 2), plan.min_contribution)]
        if encoded.kept is not None:
            gaussians = Gaussians.concat([gaussians, encoded.kept])
        return encoded.frame.leave(gaussians)


def children_of(encoded: Encoded, counts: np.ndarray) -> tuple[Gaussians, np.ndarray]:
    """Return at most ``counts [g]`` canonical Gaussians per group, faint ones included, and the group of each."""
    features, heads, division = encoded.features, encoded.heads, encoded.division
    if division.by_heads:
        sizes = np.minimum(counts, division.splits.astype(np.int64) + 1)
        parents = np.repeat(np.arange(len(features)), sizes)
        gaussians = feature_to_gaussians(features)[parents]
    else:
        rows, parents = pick_children(division, counts)
        gaussians = Gaussians.concat([feature_to_gaussians(features), division.children])[rows]
    if heads is not None:
        from gsmerge.networks.apply import NetworkContext, decode_with_group_features
        from gsmerge.networks.tokens import make_group_features

        group_features = make_group_features(features, heads.views, heads.group, encoded.cameras)
        nothing = gaussian_members(gaussians[:0], np.zeros(0, np.float32))
        networks = NetworkContext(heads.networks, nothing, encoded.cameras)
        gaussians = decode_with_group_features(gaussians, parents, group_features, networks)
    return gaussians, parents


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


def divide_by_heads(features: FeatureGaussians, num_members: np.ndarray, max_k: int) -> Division:
    """Divide every group into up to ``max_k`` children, at most one per member, for heads with absolute outputs.

    Further children go where a child stands for most pixels, weighted by the opacity of the group's members.
    """
    splits = np.minimum(num_members, max_k) - 1
    steps = np.arange(1, max_k)
    shares = np.where(steps <= splits[:, None], features.weights[:, None] / steps, -np.inf)
    order = np.argsort(-shares.reshape(-1), kind="stable")[: int(splits.sum())]
    return Division(
        splits=splits.astype(np.uint8),
        slots=np.zeros(0, np.uint8),
        uniform=np.zeros(0, np.int64),
        children=feature_to_gaussians(features)[:0],
        growth_order=order // max(1, max_k - 1),
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
