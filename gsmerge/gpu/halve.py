"""Division of groups into children by halving, on a device: the kernel ``bisect`` for all groups at once."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsmerge.gpu.axes import determinants
from gsmerge.gpu.runs import max_runs, owners_of, start_of, sum_runs
from gsmerge.kernels.gaussians.bisect import COLOR, NUM_FEATURES, PIXEL
from gsmerge.stages.decode import PLANE_WEIGHT

POWER_STEPS = 7  # of the power iteration; a rough axis is enough to cut across
NARROW = 1e-12  # a run whose spread is not above it is not cut


@dataclass(frozen=True, eq=False)
class Points:
    """Members of some groups in the space that they are divided in.

    Args:
        places: ``[m,6]`` float64: colour, and position about the group's centre, in units of its footprint.
        weights: ``[m]`` float64.
    """

    places: Tensor
    weights: Tensor


@dataclass(frozen=True, eq=False)
class Division:
    """Runs of members, group by group.

    Args:
        order: ``[m]`` int64 members, run by run.
        starts: ``[r+1]`` where each run begins in ``order``.
        groups: ``[r]`` the group of each run, rising.
        errors: ``[g,k]`` squared error of every group with 1 to k runs, NaN beyond what its members give.
    """

    order: Tensor
    starts: Tensor
    groups: Tensor
    errors: Tensor


@dataclass(frozen=True, eq=False)
class _Spreads:
    """Of r runs: scatter along the axis ``[r]``, mean ``[r,6]``, axis ``[r,6]``, squared error ``[r]``."""

    spread: Tensor
    mean: Tensor
    axis: Tensor
    error: Tensor


def member_points(
    means: Tensor, sh0: Tensor, opacities: Tensor, centres: Tensor, footprints: Tensor, owners: Tensor
) -> Points:
    """Members ``[m]`` of groups ``owners [m]`` about their ``centres [g,3]``, in units of ``footprints [g]``."""
    offsets = (PIXEL / footprints)[owners][:, None] * (means.double() - centres[owners])
    return Points(torch.cat([COLOR * sh0[:, 0].double(), offsets], 1), opacities.double().clamp_min(1e-3))


def halve(points: Points, starts: Tensor, counts: Tensor) -> Division:
    """Halve the run with the largest spread of every group until there are ``counts [g]``, as far as its members give.

    Args:
        points: Members, group by group.
        starts: ``[g+1]`` where each group begins; none is empty.
        counts: ``[g]`` most runs of each, at least 1.
    """
    num_groups, most = len(starts) - 1, int(counts.max()) if len(counts) else 1
    groups = torch.arange(num_groups, device=starts.device)
    order = torch.arange(len(points.places), device=starts.device)
    spreads = _measure(points, order, starts)
    errors = torch.full((num_groups, most), torch.nan, dtype=torch.float64, device=starts.device)
    errors[:, 0] = spreads.error
    while True:
        first = start_of(torch.bincount(groups, minlength=num_groups))
        widest = max_runs(spreads.spread, first)
        chosen = (spreads.spread == widest[groups]) & (widest > NARROW)[groups] & (first.diff() < counts)[groups]
        chosen &= chosen.cumsum(0) == 1 + _chosen_before(chosen, first)[groups]  # of equal ones the first
        if not bool(chosen.any()):
            return Division(order, starts, groups, errors)
        order, starts, groups, spreads = _cut(points, order, starts, groups, spreads, chosen)
        first = start_of(torch.bincount(groups, minlength=num_groups))
        errors.scatter_(1, first.diff()[:, None] - 1, sum_runs(spreads.error, first)[:, None])


def _chosen_before(chosen: Tensor, first: Tensor) -> Tensor:
    """``[g]`` how many rows are chosen before each group begins."""
    return torch.cat([chosen.new_zeros(1, dtype=torch.int64), chosen.cumsum(0)])[first[:-1]]


def _cut(
    points: Points, order: Tensor, starts: Tensor, groups: Tensor, spreads: _Spreads, chosen: Tensor
) -> tuple[Tensor, Tensor, Tensor, _Spreads]:
    """Cut the chosen runs across their axes at their means; those with all members on one side are chosen no more."""
    owners = owners_of(starts, len(order))
    offsets = points.places[order] - spreads.mean[owners]
    second = chosen[owners] & ((offsets * spreads.axis[owners]).sum(1) > 0)
    order = order[torch.sort(owners * 2 + second, stable=True).indices]
    sizes, upper = starts.diff(), sum_runs(second.double(), starts).long()
    parts = chosen & (upper > 0) & (upper < sizes)
    source = torch.repeat_interleave(torch.arange(len(groups), device=starts.device), 1 + parts.long())
    is_second = torch.cat([source.new_zeros(1, dtype=torch.bool), source[1:] == source[:-1]])
    is_first = parts[source] & ~is_second
    lengths = torch.where(is_second, upper[source], sizes[source] - torch.where(is_first, upper[source], 0))
    cut_starts = start_of(lengths)
    dull = chosen & ~parts
    kept = _Spreads(torch.where(dull, 0.0, spreads.spread)[source], *(
        getattr(spreads, name)[source] for name in ("mean", "axis", "error")
    ))  # fmt: skip
    fresh = torch.nonzero(parts[source])[:, 0]
    inside = parts[source][owners_of(cut_starts, len(order))]
    measured = _measure(points, order[inside], start_of(lengths[fresh]))
    for name in ("spread", "mean", "axis", "error"):
        getattr(kept, name)[fresh] = getattr(measured, name)
    return order, cut_starts, groups[source], kept


def _measure(points: Points, order: Tensor, starts: Tensor) -> _Spreads:
    """Weighted mean, principal axis and the scatter along it, and squared error, of every run."""
    owners = owners_of(starts, len(order))
    weights, places = points.weights[order], points.places[order]
    total = sum_runs(weights, starts)
    mean = sum_runs(weights[:, None] * places, starts) / total[:, None]
    delta = places - mean[owners]
    scatter = sum_runs(weights[:, None, None] * delta[:, :, None] * delta[:, None], starts)
    diagonal = scatter.diagonal(dim1=1, dim2=2)
    widest = diagonal.argmax(1)
    axis = scatter.gather(1, widest[:, None, None].expand(-1, 1, NUM_FEATURES))[:, 0]
    flat = torch.zeros_like(total, dtype=torch.bool)
    for _ in range(POWER_STEPS):
        length = axis.norm(dim=1, keepdim=True)
        flat |= length[:, 0] <= 1e-30
        axis = (scatter * (axis / length.clamp_min(1e-30))[:, None]).sum(2)
    spread = torch.where(flat, 0.0, axis.norm(dim=1))
    # as if every member weighed one
    error = starts.diff() / total * (diagonal[:, :3].sum(1) + PLANE_WEIGHT * thickness(scatter[:, 3:, 3:]))
    return _Spreads(spread, mean, axis, error)


def thickness(scatter: Tensor) -> Tensor:
    """``[r]`` smallest eigenvalue of symmetric ``[r,3,3]``, by the trigonometric solution of the cubic (Smith 1961)."""
    middle = scatter.diagonal(dim1=1, dim2=2).mean(1)
    shifted = scatter - middle[:, None, None] * torch.eye(3, dtype=scatter.dtype, device=scatter.device)
    p = (shifted.square().sum((1, 2)) / 6).sqrt()
    half = determinants(shifted) / (2 * p**3).clamp_min(1e-300)
    angle = half.clamp(-1, 1).acos() / 3
    least = middle + 2 * p * (angle + 2 * torch.pi / 3).cos()
    return torch.where(p <= 1e-30, middle, least).clamp_min(0)
