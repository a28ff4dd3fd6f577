"""feature gaussians -> clusters -> merged feature gaussians, on a device; :mod:`gsmerge.stages.match` and ``merge``."""

from __future__ import annotations

from dataclasses import fields

import torch
from torch import Tensor

from gsmerge.gpu.runs import max_runs, owners_of, start_of, sum_runs
from gsmerge.gpu.scene import Features
from gsmerge.stages.match import MatchOptions
from gsmerge.types import SH_C0

PAIRS_AT_ONCE = 1 << 27  # distances in memory together: 1.5 GB
MAX_FEATURES = 160_000  # more take longer by all distances here (they go with the square) than by a tree on the CPU


def covers(options: MatchOptions, count: int) -> bool:
    """Whether :func:`match` does what the options ask for, with so many Feature Gaussians."""
    return options.method == "none" or (options.method == "overlap" and count <= MAX_FEATURES)


def match(features: Features, options: MatchOptions) -> tuple[Tensor, int]:
    """Clusters ``[g]`` of Feature Gaussians of different views, and their number; methods ``overlap`` and ``none``.

    The clusters and their numbers are those of :func:`gsmerge.stages.match.match`.
    """
    count, device = len(features), features.means.device
    clusters = torch.full((count,), -1, dtype=torch.int64, device=device)
    num_clusters = 0
    views = torch.unique(features.views)
    if options.method != "none" and len(views) > 1:
        rows = torch.nonzero(features.extinctions > 0)[:, 0]
        if len(rows) > 1:
            of_rows, num_clusters = _cluster_rows(features, rows, options, len(torch.unique(features.views[rows])))
            clusters[rows] = of_rows
    alone = clusters < 0
    clusters = torch.where(alone, num_clusters + alone.cumsum(0) - 1, clusters)
    return clusters, num_clusters + int(alone.sum())


def _cluster_rows(features: Features, rows: Tensor, options: MatchOptions, num_views: int) -> tuple[Tensor, int]:
    """Clusters of some Feature Gaussians by overlap, and their number."""
    means, views = features.means[rows].double(), features.views[rows]
    neighbors = nearest_of_other_views(means, views, options.neighbors)
    scores = overlaps(features, rows, neighbors, options.max_color)
    order = torch.arange(len(rows), device=rows.device)
    for key in (*means.unbind(1), -features.weights[rows]):  # the last decides first
        order = order[torch.sort(key[order], stable=True).indices]
    return leader_clusters(order, neighbors, scores, views, options.overlap, options.cluster_size or num_views)


def nearest_of_other_views(means: Tensor, views: Tensor, count: int) -> Tensor:
    """``[g,count]`` int64 nearest points of other views than the own, nearest first; -1 where there are fewer.

    By all distances, in float64: as differences of squares they would lose the near ones in float32.

    Args:
        means: ``[g,3]`` float64, finite.
        views: ``[g]`` int64, at least 0.
        count: Neighbours of each.
    """
    num = len(means)
    neighbors = torch.full((num, count), -1, dtype=torch.int64, device=means.device)
    squares, rows_at_once = means.square().sum(1), max(1, PAIRS_AT_ONCE // max(num, 1))
    for first in range(0, num, rows_at_once):
        part = slice(first, first + rows_at_once)
        distances = torch.addmm(squares, means[part], means.T, alpha=-2).add_(squares[part, None]).float()
        distances.masked_fill_(views[part, None] == views, torch.inf)
        near = torch.topk(distances, min(count, num), dim=1, largest=False)
        neighbors[part, : near.indices.shape[1]] = torch.where(near.values.isinf(), -1, near.indices)
    return neighbors


def overlaps(features: Features, rows: Tensor, neighbors: Tensor, max_color: float) -> Tensor:
    """``[r,k]`` float64 Bhattacharyya coefficient of rows and their neighbours; -1 for none and for other colours."""
    near, known = rows[neighbors.clamp_min(0)], neighbors >= 0
    colors = SH_C0 * features.sh0[:, 0].double()
    alike = (colors[rows][:, None] - colors[near]).square().sum(-1) <= max_color * max_color
    covars = features.covars.double()
    own, other = covars[rows][:, None].expand(*near.shape, 3, 3), covars[near]
    delta = features.means.double()[near] - features.means.double()[rows][:, None]
    half = 0.5 * (own + other)
    adjugate, det = _adjugate(half)
    distance = (delta[..., None] * adjugate * delta[..., None, :]).sum((-2, -1)) / det
    volume = _adjugate(own)[1].clamp_min(0).sqrt() * _adjugate(other)[1].clamp_min(0).sqrt()
    score = torch.where(det > 0, (-0.125 * distance).exp() * (volume / det).sqrt(), 0.0)
    return torch.where(known & alike, score, -1.0)


def _adjugate(a: Tensor) -> tuple[Tensor, Tensor]:
    """Adjugates and determinants of symmetric matrices ``[...,3,3]``."""
    xx, xy, xz, yy, yz, zz = a[..., 0, 0], a[..., 0, 1], a[..., 0, 2], a[..., 1, 1], a[..., 1, 2], a[..., 2, 2]
    rows = (
        (yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy),
        (xz * yz - xy * zz, xx * zz - xz * xz, xy * xz - xx * yz),
        (xy * yz - xz * yy, xy * xz - xx * yz, xx * yy - xy * xy),
    )
    det = xx * rows[0][0] + xy * rows[0][1] + xz * rows[0][2]
    return torch.stack([torch.stack(row, -1) for row in rows], -2), det


def leader_clusters(
    order: Tensor, neighbors: Tensor, scores: Tensor, views: Tensor, threshold: float, max_size: int
) -> tuple[Tensor, int]:
    """The kernel ``leader_clusters`` in rounds, with the same clusters and numbers.

    There each Gaussian in ``order`` that is still free leads its free neighbours that overlap it enough, at most
    ``max_size`` to a cluster and one of each view, the best overlaps first. A Gaussian can be decided on once no
    earlier one that is undecided may take it or one of its neighbours; all such are decided on at once. Since they
    share nothing, their order does not matter.

    Args:
        order: ``[g]`` leaders in turn.
        neighbors: ``[g,k]``, below 0: none.
        scores: ``[g,k]``.
        views: ``[g]``, at least 0.
        threshold: Least score.
        max_size: Most members.
    """
    num, device = len(order), order.device
    rank = torch.empty_like(order)
    rank[order] = torch.arange(num, device=device)
    scores, place = torch.sort(scores, dim=1, descending=True, stable=True)
    reach = torch.where(scores >= threshold, neighbors.gather(1, place), -1)
    leaders = torch.full((num,), -1, dtype=torch.int64, device=device)
    undecided = torch.arange(num, device=device)
    while len(undecided):
        own = reach[undecided]
        own = torch.where((own >= 0) & (leaders[own.clamp_min(0)] < 0), own, -1)  # who is taken can be left out
        ranks = rank[undecided][:, None].expand_as(own)
        first = rank.clone()
        taken = torch.where(own >= 0, own, undecided[:, None])  # in place of none itself, which changes nothing
        first.scatter_reduce_(0, taken.reshape(-1), ranks.reshape(-1), "amin")
        ready = (first[undecided] == ranks[:, 0]) & ((own < 0) | (first[own.clamp_min(0)] == ranks)).all(1)
        heads = undecided[ready]
        _take(heads, own[ready], leaders, views, max_size)
        undecided = undecided[~ready]
        undecided = undecided[leaders[undecided] < 0]
    leads = torch.zeros(num, dtype=torch.int64, device=device)
    leads[rank[leaders]] = 1
    return (leads.cumsum(0) - 1)[rank[leaders]], int(leads.sum())


def _take(heads: Tensor, own: Tensor, leaders: Tensor, views: Tensor, max_size: int) -> None:
    """Give leaders ``[h]`` and what they take of the free ``own [h,k]``, best first, their leader, in place."""
    leaders[heads] = heads
    free, own_views = own >= 0, views[own.clamp_min(0)]
    # the first free one of a view is taken, or the cluster is full; either way no later one of the view is
    before = torch.ones(own.shape[1], own.shape[1], dtype=torch.bool, device=own.device).tril(-1)
    repeats = ((own_views[:, :, None] == own_views[:, None]) & free[:, None] & before).any(2)
    takes = free & ~repeats
    takes &= takes.cumsum(1) < max_size
    leaders[own[takes]] = heads[:, None].expand_as(own)[takes]


def merge(features: Features, clusters: Tensor, count: int) -> Features:
    """One Feature Gaussian per cluster: first those that are alone in their old order, then the merged ones.

    See :func:`gsmerge.stages.merge.merge`.
    """
    alone = torch.bincount(clusters, minlength=count)[clusters] == 1
    order = torch.nonzero(~alone)[:, 0]
    if len(order) == 0:
        return features
    order = order[torch.sort(clusters[order], stable=True).indices]
    sizes = torch.bincount(clusters[order], minlength=count)
    cuts = start_of(sizes[sizes > 0])
    return _concat(take(features, torch.nonzero(alone)[:, 0]), pool_runs(features, order, cuts))


def take(features: Features, index: Tensor) -> Features:
    """The Feature Gaussians that an integer ``index`` selects, with their members."""
    starts, members = _gather(features, index)
    names = [f.name for f in fields(Features) if f.name not in ("starts", "members")]
    return Features(starts=starts, members=members, **{name: getattr(features, name)[index] for name in names})


def _gather(features: Features, index: Tensor) -> tuple[Tensor, Tensor]:
    """Members of the indexed Feature Gaussians, one after the other: starts and rows."""
    starts = start_of((features.starts[1:] - features.starts[:-1])[index])
    count = int(starts[-1])
    owners = owners_of(starts, count)
    offsets = torch.arange(count, device=index.device) - starts[owners]
    return starts, features.members[features.starts[index][owners] + offsets]


def _concat(first: Features, second: Features) -> Features:
    """The Feature Gaussians of both, one after the other."""
    names = [f.name for f in fields(Features) if f.name != "starts"]
    columns = {name: torch.cat([getattr(part, name) for part in (first, second)]) for name in names}
    return Features(starts=torch.cat([first.starts, first.starts[-1] + second.starts[1:]]), **columns)


def pool_runs(features: Features, order: Tensor, cuts: Tensor) -> Features:
    """One Feature Gaussian for each run of rows in ``order``, which begin at ``cuts [c+1]``; sums are float64."""
    runs = owners_of(cuts, len(order))

    def rows(tensor: Tensor) -> Tensor:
        return tensor[order].double()

    def total(values: Tensor) -> Tensor:
        return sum_runs(values, cuts)

    gains, extinctions = rows(features.gains), rows(features.extinctions)
    share = (rows(features.weights) * gains).clamp_min(1e-12)
    share = share / total(share)[runs]
    means = total(share[:, None] * rows(features.means))
    delta = rows(features.means) - means[runs]
    covars = total(share[:, None, None] * (rows(features.covars) + delta[:, :, None] * delta[:, None]))
    summed = total(extinctions)
    starts, members = _gather(features, order)
    return Features(
        means=means.float(),
        covars=covars.float(),
        weights=total(rows(features.weights)).float(),
        masses=total(rows(features.masses)).float(),
        extinctions=summed.float(),
        gains=(total(gains * extinctions) / summed.clamp_min(1e-30)).float(),
        spreads=max_runs(rows(features.spreads), cuts).float(),
        sh0=total(share[:, None, None] * rows(features.sh0)).float(),
        shN=total(share[:, None, None] * rows(features.shN)).float(),
        footprints=total(share * rows(features.footprints)).float(),
        views=torch.full((len(cuts) - 1,), -1, dtype=torch.int64, device=order.device),
        backing=features.backing[order][cuts[:-1]],
        starts=starts[cuts],
        members=members,
    )
