"""New groups and the state: those that show the same piece of surface become one."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsmerge.online.state import Parts, joined, pick, swapped, thinned
from gsmerge.stages.match import MatchOptions, match
from gsmerge.stages.merge import merge
from gsmerge.types import FeatureGaussians, Matches


def partners(features: FeatureGaussians, new: FeatureGaussians, options: MatchOptions) -> Tensor:
    """``[n]`` int64: the state's group that each new one belongs to, -1 for none; no group gets two.

    As across the views of one batch, with the state for one view and the batch for another.

    Args:
        features: What the state has where the new views look.
        new: n new groups, merged among themselves.
        options: As of the matching of views.
    """
    both = FeatureGaussians.concat([features, new])
    sides = (torch.arange(len(both)) >= len(features)).long()
    matches = match(replace(both, views=sides), replace(options, cluster_size=2))
    owner = torch.full((matches.count,), -1)
    owner[matches.clusters[: len(features)]] = torch.arange(len(features))
    return owner[matches.clusters[len(features) :]]


def absorb(parts: Parts, new: Parts, rows: Tensor, most: int) -> Parts:
    """The state's groups, some of them pooled with new ones: moments add up, in place.

    Args:
        parts: The state's groups.
        new: n new groups.
        rows: ``[n]`` int64 the group that each becomes part of, all different.
        most: Most children of a group.
    """
    if len(rows) == 0:
        return parts
    old = pick(parts, rows)
    both = joined([old, new])
    pairs = torch.arange(len(rows)).repeat(2)
    features = merge(both.features, Matches(pairs, len(rows)))
    children = both.children[features.members]
    solved = torch.where((old.held > 0)[:, None, None], old.solved, features.sh0)
    pooled = Parts(replace(features, members=torch.arange(len(children))), children, solved, old.held)
    return swapped(parts, rows, thinned(pooled, most))
