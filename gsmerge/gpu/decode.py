"""feature gaussians -> gaussians, on a device: K children of every group; :mod:`gsmerge.stages.decode`."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsmerge.gpu.axes import feature_to_gaussians, to_gaussians
from gsmerge.gpu.halve import Division, halve, member_points
from gsmerge.gpu.match import take
from gsmerge.gpu.pool import pool_members
from gsmerge.gpu.runs import owners_of
from gsmerge.gpu.scene import DeviceMembers, Features
from gsmerge.stages.decode import MAX_CHILDREN, MIXED, DecodeOptions, deal_visible, hull_gains
from gsmerge.types import Gaussians


def covers(options: DecodeOptions) -> bool:
    """Whether :func:`decode` does what the options ask for."""
    return options.k != MIXED


def decode(
    features: Features, members: DeviceMembers, options: DecodeOptions, count: int | None, *, exact: bool = False
) -> Gaussians:
    """``count`` Gaussians, spent where they lower distortion most, or None: K of each Feature Gaussian.

    Those below the least opacity are left out; with ``exact`` others take their place. See
    :func:`gsmerge.stages.decode.decode`; the rule is ``"depth"``.
    """
    if count is None:
        children = torch.full((len(features),), options.max_k, device=features.means.device)
    elif exact:
        order = deal_order(features, members).cpu().numpy()

        def make(counts: np.ndarray) -> Gaussians:
            return divide(features, members, torch.from_numpy(counts).to(features.means.device))

        return deal_visible(order, len(features), count, options.min_opacity, make)
    else:
        children = split_counts(features, members, max(0, count - len(features)), MAX_CHILDREN)
    gaussians = divide(features, members, children)
    return gaussians[gaussians.opacities >= options.min_opacity]


def divide(features: Features, members: DeviceMembers, counts: Tensor) -> Gaussians:
    """At most ``counts [g]`` children of every Feature Gaussian, however faint, those of one next to each other."""
    gaussians = feature_to_gaussians(features)
    groups = torch.nonzero((counts > 1) & ~features.backing)[:, 0]
    if len(groups) == 0:
        return gaussians
    few, division = _halve(features, members, groups, counts[groups])
    moments = pool_members(members, division.starts, few.members[division.order])
    gains, spreads = few.gains.double()[division.groups], few.spreads.double()[division.groups]
    parts = to_gaussians(moments.covars, moments.extinctions * gains, spreads, moments.means, moments.sh)
    whole = torch.ones(len(features), dtype=torch.bool, device=counts.device)
    whole[groups] = False
    rows = torch.nonzero(whole)[:, 0]
    order = torch.sort(torch.cat([rows, groups[division.groups]]), stable=True).indices
    return Gaussians.concat([gaussians[rows], parts])[order]


def split_counts(features: Features, members: DeviceMembers, extra: int, max_children: int = MAX_CHILDREN) -> Tensor:
    """``[g]`` int64 children of every Feature Gaussian when ``extra`` more are spent where they lower distortion most.

    See :func:`gsmerge.stages.decode.split_counts`.
    """
    ones = torch.ones(len(features), dtype=torch.int64, device=features.means.device)
    if extra <= 0:
        return ones
    dealt = deal_order(features, members, max_children)[:extra]
    return ones.index_add_(0, dealt, ones.new_ones(len(dealt)))


def deal_order(features: Features, members: DeviceMembers, max_children: int = MAX_CHILDREN) -> Tensor:
    """``[d]`` the Feature Gaussian that each further Gaussian goes to; see :func:`gsmerge.stages.decode.deal_order`."""
    front = torch.nonzero(~features.backing)[:, 0]
    if len(front) == 0:
        return front
    counts = torch.full((len(front),), max_children, device=front.device)
    errors = _halve(features, members, front, counts)[1].errors
    gains = torch.from_numpy(hull_gains(errors.cpu().numpy())).to(front.device)
    order = torch.sort(-gains.reshape(-1), stable=True).indices
    return front[order[: int(torch.isfinite(gains).sum())] // gains.shape[1]]


def _halve(features: Features, members: DeviceMembers, groups: Tensor, counts: Tensor) -> tuple[Features, Division]:
    """Some Feature Gaussians, and their members halved."""
    few = take(features, groups)
    ids = few.members
    owners = owners_of(few.starts, len(ids))
    centres, footprints = few.means.double(), few.footprints.double()
    g = members.gaussians
    points = member_points(g.means[ids], g.sh0[ids], g.opacities[ids], centres, footprints, owners)
    return few, halve(points, few.starts, counts)
