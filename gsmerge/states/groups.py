"""Operations on the groups of a state: decoded as they enter, selected, joined, replaced, divided anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.geometry import covariances
from gsmerge.kernels.elementary import log1p
from gsmerge.networks.corrector import Corrector
from gsmerge.pooling import MAX_OPACITY, Members, feature_to_gaussians, gaussian_members
from gsmerge.stages.decode import divide, make_children, repeat
from gsmerge.stages.merge import take
from gsmerge.states.division import divide_all, divide_by_heads, pick_children
from gsmerge.states.state import Colors, DividedGroups, GroupSet, Heads, Learned, State
from gsmerge.types import Cameras, FeatureGaussians, Gaussians, to_float32

CHILD_FOOTPRINT = 1e-3  # of the group's: children need no least size, as it is in their own


def without_members(features: FeatureGaussians) -> FeatureGaussians:
    """Return the Feature Gaussians without their members."""
    return replace(features, starts=np.zeros(len(features) + 1, np.int64), members=np.zeros(0, np.int64))


def bake(
    features: FeatureGaussians,
    members: Members,
    networks: Corrector,
    max_k: int,
    saliency: np.ndarray | None = None,
) -> GroupSet:
    """Decode groups into pooled Gaussians and children, so that neither gains, latents nor heads are needed."""
    ones = feature_to_gaussians(features)
    children, parents = ones, np.arange(len(features))
    if max_k > 1:
        counts = np.full(len(features), max_k)
        children, parents = make_children(features, members, counts, networks)
    ones = networks.decode(ones, np.arange(len(features)), features)
    children = networks.decode(children, parents, features)
    return make_groups(decoding_to(ones, features), children, parents, saliency)


def make_groups(
    features: FeatureGaussians,
    children: Gaussians,
    parents: np.ndarray,
    saliency: np.ndarray | None,
    learned: Learned | None = None,
) -> GroupSet:
    """Make groups without fitted colours; ``parents``: rising group of each child."""
    if learned is not None:
        learned = replace(learned, refined=without_members(learned.refined))
    colors = Colors(features.sh0, np.zeros(len(features), np.float32))
    return GroupSet(with_child_rows(features, parents), children, colors, learned, saliency)


def decoding_to(ones: Gaussians, features: FeatureGaussians) -> FeatureGaussians:
    """Return Feature Gaussians that decode to the Gaussians ``ones``, without gains and latents."""
    neutral, no_latents = np.ones(len(ones), np.float32), np.zeros((len(ones), 0), np.float32)
    return replace(features, gains=neutral, latents=no_latents, **moments_of(ones))


def moments_of(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return the fields of Feature Gaussians with gains of one that decode to the given Gaussians."""
    scales = gaussians.scales.astype(np.float64)
    _, middle, largest = np.sort(scales, -1).T
    opacities = gaussians.opacities.astype(np.float64).clip(0, MAX_OPACITY)
    return {
        "means": gaussians.means,
        "covars": to_float32(covariances(gaussians.quats.astype(np.float64), scales)),
        "extinctions": to_float32(-log1p(-opacities) * middle * largest),
        "sh0": gaussians.sh0,
        "shN": gaussians.shN,
    }


def with_child_rows(features: FeatureGaussians, parents: np.ndarray) -> FeatureGaussians:
    """Return Feature Gaussians whose members are rows 0, 1, ... of their children; ``parents`` rise."""
    starts = np.concatenate([[0], np.bincount(parents, minlength=len(features)).cumsum()])
    return replace(features, starts=starts, members=np.arange(len(parents)))


def child_members(groups: GroupSet) -> Members:
    """Return the children of groups as members."""
    footprints = CHILD_FOOTPRINT * groups.features.footprints.repeat(np.diff(groups.features.starts))
    return gaussian_members(groups.children, footprints)


def select_groups(groups: GroupSet, rows: np.ndarray) -> GroupSet:
    """Select groups by ``rows``, with their children."""
    features = take(groups.features, rows)
    children = groups.children[features.members]
    members = np.arange(len(children))
    learned = None if groups.learned is None else groups.learned[rows]
    saliency = None if groups.saliency is None else groups.saliency[rows]
    return GroupSet(replace(features, members=members), children, groups.colors[rows], learned, saliency)


def concat_groups(sets: list[GroupSet]) -> GroupSet:
    """Concatenate the groups of all sets."""
    features = FeatureGaussians.concat([groups.features for groups in sets])
    children = Gaussians.concat([groups.children for groups in sets])
    learned = [groups.learned for groups in sets if groups.learned is not None]
    saliency = [groups.saliency for groups in sets if groups.saliency is not None]
    return GroupSet(
        replace(features, members=np.arange(len(children))),
        children,
        Colors.concat([groups.colors for groups in sets]),
        Learned.concat(learned) if learned else None,
        np.concatenate(saliency) if len(saliency) == len(sets) else None,
    )


def merge_saliency(
    saliency: np.ndarray | None, weights: np.ndarray, clusters: np.ndarray, count: int
) -> np.ndarray | None:
    """Average the saliency ``[n]`` of parts, by their weights ``[n]``, over ``count`` clusters, one of each part."""
    if saliency is None:
        return None
    weights = np.maximum(weights, 1e-12)
    sums = (np.bincount(clusters, values, count) for values in (weights * saliency, weights))
    return np.divide(*sums)


def limit_children(groups: GroupSet, max_k: int) -> GroupSet:
    """Pool children in groups that have more than ``max_k``."""
    rows = np.flatnonzero(np.diff(groups.features.starts) > max_k)
    if len(rows) == 0:
        return groups
    large = select_groups(groups, rows)
    children, parents = divide(large.features, child_members(large), np.full(len(large), max_k))
    pooled = replace(large, features=with_child_rows(large.features, parents), children=children)
    return replace_groups(groups, rows, pooled)


def replace_groups(groups: GroupSet, rows: np.ndarray, new_groups: GroupSet) -> GroupSet:
    """Replace the groups at ``rows`` by as many others."""
    index = np.arange(len(groups))
    index[rows] = len(groups) + np.arange(len(rows))
    return select_groups(concat_groups([groups, new_groups]), index)


def with_fitted_colors(groups: GroupSet) -> GroupSet:
    """Return groups and children in the colours fitted to the photos."""
    offsets = groups.colors.sh0 - groups.features.sh0
    sizes = np.diff(groups.features.starts)
    features = replace(groups.features, sh0=groups.colors.sh0)
    children = replace(groups.children, sh0=groups.children.sh0 + offsets.repeat(sizes, 0))
    return replace(groups, features=features, children=children)


def children_of(groups: DividedGroups, counts: np.ndarray, cameras: Cameras) -> tuple[Gaussians, np.ndarray]:
    """Return at most ``counts [g]`` canonical Gaussians per group, faint ones included, and the group of each."""
    gaussians, parents = _undecoded_children(groups, counts)
    heads = groups.heads
    if heads is not None:
        from gsmerge.networks.apply import NetworkContext, decode_with_group_features
        from gsmerge.networks.tokens import make_group_features

        group_features = make_group_features(groups.refined, heads.views, heads.group, cameras)
        nothing = gaussian_members(gaussians[:0], np.zeros(0, np.float32))
        networks = NetworkContext(heads.networks, nothing, cameras)
        gaussians = decode_with_group_features(gaussians, parents, group_features, networks)
    return gaussians, parents


def _undecoded_children(groups: DividedGroups, counts: np.ndarray) -> tuple[Gaussians, np.ndarray]:
    """Return the children of groups before heads correct them, and the group of each."""
    division = groups.division
    if division.by_heads:
        return repeat(groups.refined, np.minimum(counts, division.splits.astype(np.int64) + 1))
    rows, parents = pick_children(division, counts)
    return Gaussians.concat([feature_to_gaussians(groups.refined), division.children])[rows], parents


def share_groups(groups: DividedGroups, cameras: Cameras, max_k: int) -> GroupSet:
    """Return groups that other batches can join: decoded, with up to ``max_k`` children, or with their latents."""
    most = np.full(len(groups), max_k)
    if groups.learned is not None and groups.heads is not None:
        children, parents = _undecoded_children(groups, most)
        if groups.heads.networks.options.makes_children:
            children, parents = children[:0], parents[:0]
        shared = make_groups(groups.features, children, parents, groups.saliency, groups.learned)
    else:
        ones, _ = children_of(groups, np.ones(len(groups), np.int64), cameras)
        children, parents = children_of(groups, most, cameras)
        shared = make_groups(decoding_to(ones, groups.features), children, parents, groups.saliency)
    return shared if groups.colors is None else replace(shared, colors=groups.colors)


def share(state: State) -> State:
    """Return a state whose groups other batches can join."""
    groups, settings = state.groups, state.settings
    if isinstance(groups, GroupSet):
        return state
    settings = replace(settings, target_count=None, num_slots=None, knee_count=0)  # of that batch alone
    return replace(state, groups=share_groups(groups, state.cameras, settings.max_k), settings=settings)


def divide_groups(state: State, *, fitted_colors: bool = True) -> DividedGroups:
    """Return groups with children for every K: groups of one batch unchanged, others with their children divided.

    ``fitted_colors``: use the colours fitted to the photos instead of those of the input files. With networks, decoder
    heads set the colours.
    """
    groups, max_k, networks = state.groups, state.settings.max_k, state.networks
    if isinstance(groups, DividedGroups):
        return groups
    if fitted_colors and not state.keeps_latents:
        groups = with_fitted_colors(groups)
    features, members = groups.features, child_members(groups)
    if networks is None or groups.learned is None:
        division = divide_all(features, members, max_k)
        return DividedGroups(without_members(features), division, None, saliency=groups.saliency)
    learned = groups.learned
    described = networks.samples.describe(learned, state.cameras)
    if networks.weights.options.makes_children:
        division = divide_by_heads(learned.refined, max_k)
    else:
        rows = replace(learned.refined, starts=features.starts, members=features.members)
        division = divide_all(rows, members, max_k)
    heads = Heads(networks.weights, learned.views, described.group)
    return DividedGroups(without_members(learned.refined), division, heads, saliency=groups.saliency)
