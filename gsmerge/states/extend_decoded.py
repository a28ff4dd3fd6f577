"""Batches for a state whose groups are decoded as they enter: as pooled Gaussians, which add up, and children."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np

from gsmerge.fit import visible_mask
from gsmerge.networks.apply import NetworkContext
from gsmerge.pipeline import merge_views
from gsmerge.pooling import feature_to_gaussians
from gsmerge.runtime.record import stage
from gsmerge.settings.stages import MatchOptions
from gsmerge.stages.match import match
from gsmerge.stages.merge import merge, take
from gsmerge.states.division import make_division
from gsmerge.states.groups import (
    bake,
    concat_groups,
    limit_children,
    merge_saliency,
    replace_groups,
    select_groups,
    with_fitted_colors,
    without_members,
)
from gsmerge.states.state import Colors, DividedGroups, GroupSet, Heads, State
from gsmerge.states.view_batch import REACH, Batch, BatchFeatures, StateKind, batch_saliency
from gsmerge.types import FeatureGaussians, Gaussians, Matches

if TYPE_CHECKING:
    from gsmerge.networks.weights import NetworkWeights


def _encode(state: State | None, batch: Batch, count: int | None) -> BatchFeatures:
    """Merge a batch's superpixels across its own views."""
    merged = merge_views(batch.prepared, batch.plan, count)
    return BatchFeatures(merged.features, merged.members, merged.segmentation, merged.networks)


@stage("decode")
def _divide(new: BatchFeatures, batch: Batch, max_k: int) -> DividedGroups:
    """Divide Feature Gaussians into groups of a state, with the networks that correct them."""
    heads, context = None, new.context
    if isinstance(context, NetworkContext):
        described = context.describe(new.features)
        heads = Heads(cast("NetworkWeights", context.networks), described.views, described.group)
    division = make_division(new.features, new.members, context, max_k)
    saliency = batch_saliency(new.features, new.members, batch)
    return DividedGroups(without_members(new.features), division, heads, saliency=saliency)


def _decode(groups: GroupSet, new: BatchFeatures) -> tuple[Gaussians, Gaussians]:
    """Return the Gaussians of the state and of the batch, one for each group."""
    return feature_to_gaussians(with_fitted_colors(groups).features), feature_to_gaussians(new.features)


def _join(
    groups: GroupSet, rows: np.ndarray, new: BatchFeatures, batch: Batch, max_k: int
) -> tuple[GroupSet, dict[str, int]]:
    """Merge a batch into the state's ``rows`` in view, and add groups that the state does not show yet."""
    with stage("decode"):
        saliency = batch_saliency(new.features, new.members, batch)
        fresh = bake(new.features, new.members, new.context, max_k, saliency)
    with stage("join"):
        partners = find_partners(take(groups.features, rows), fresh.features, batch.plan.match)
        has_partner = partners >= 0
        joining = select_groups(fresh, np.flatnonzero(has_partner))
        groups = merge_into(groups, joining, rows[partners[has_partner]], max_k)
        alone = select_groups(fresh, np.flatnonzero(~has_partner))
        counts, least = {"num_joined": int(has_partner.sum())}, batch.min_contribution
        if least > 0:
            in_view = feature_to_gaussians(take(groups.features, rows))
            both = Gaussians.concat([in_view, feature_to_gaussians(alone.features)])
            visible = visible_mask(both, batch.photos.photos(2), least)[len(in_view) :]
            counts["num_hidden"] = int((~visible).sum())
            alone = select_groups(alone, np.flatnonzero(visible))
        return concat_groups([groups, alone]), counts


DECODED = StateKind(REACH, _encode, _decode, _divide, _join)


def find_partners(features: FeatureGaussians, new: FeatureGaussians, options: MatchOptions) -> np.ndarray:
    """Return, for each of n new groups, the state's group with the same surface, ``[n]`` int64; -1 for none.

    Groups are matched as across the views of one batch, with the state as one view and the batch as another. A group
    gets at most one partner: the first in its cluster.
    """
    both = FeatureGaussians.concat([features, new])
    sides = (np.arange(len(both)) >= len(features)).astype(np.int64)
    matches = match(replace(both, views=sides), replace(options, cluster_size=2))
    owner = np.full(matches.count, -1)
    owner[matches.clusters[: len(features)]] = np.arange(len(features))
    partners = owner[matches.clusters[len(features) :]]
    again = np.ones(len(partners), bool)
    again[np.unique(partners, return_index=True)[1]] = False
    partners[again] = -1
    return partners


def merge_into(groups: GroupSet, new: GroupSet, rows: np.ndarray, max_k: int) -> GroupSet:
    """Merge n new groups into the state's groups at ``rows [n]`` int64, all different: moments add up."""
    if len(rows) == 0:
        return groups
    old = select_groups(groups, rows)
    both = concat_groups([old, new])
    pairs = np.tile(np.arange(len(rows)), 2)
    features = merge(both.features, Matches(pairs, len(rows)))
    children = both.children[features.members]
    precision = old.colors.precision
    colors = Colors(np.where((precision > 0)[:, None, None], old.colors.sh0, features.sh0), precision)
    saliency = merge_saliency(both.saliency, both.features.weights, pairs, len(rows))
    merged = GroupSet(replace(features, members=np.arange(len(children))), children, colors, saliency=saliency)
    return replace_groups(groups, rows, limit_children(merged, max_k))
