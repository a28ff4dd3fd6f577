"""State and new views -> state, where groups keep their latents (paper section 4.5, "Online reconstruction").

New views are encoded, matched with the state, merged into it, and refined where they touch it; heads decode on demand.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np

from gsmerge.errors import UsageError
from gsmerge.facts.views import concat_cameras
from gsmerge.kernels.gaussians.cluster import connected_components
from gsmerge.networks.apply import NetworkContext, decode_gaussians, decode_with_group_features, find_neighbors
from gsmerge.networks.checkpoint import IN_PACKAGE, Checkpoint, load_checkpoint
from gsmerge.networks.tokens import GroupFeatures
from gsmerge.networks.weights import NetworkWeights
from gsmerge.plan import Plan
from gsmerge.pooling import Members, feature_to_gaussians
from gsmerge.runtime.record import stage
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.stages import MatchOptions
from gsmerge.stages.assign import assign
from gsmerge.stages.decode import divide
from gsmerge.stages.encode import correct, encode
from gsmerge.stages.match import match
from gsmerge.stages.merge import merge, refine, take
from gsmerge.stages.segment import segment_scene
from gsmerge.states.division import make_division
from gsmerge.states.groups import (
    concat_groups,
    limit_children,
    make_groups,
    merge_saliency,
    select_groups,
    without_members,
)
from gsmerge.states.state import (
    DividedGroups,
    GroupSet,
    Heads,
    Learned,
    State,
    StateNetworks,
    ViewSamples,
)
from gsmerge.states.view_batch import REACH, Batch, BatchFeatures, StateKind, batch_saliency
from gsmerge.types import Cameras, FeatureGaussians, Gaussians, Matches

WIDE = 3 * REACH  # standard deviations about what a view sees, in which the refiner finds the neighbours of its border
SAMPLE_STEP = 8  # pixels between the samples of a view along each axis


@dataclass(frozen=True, eq=False, kw_only=True)
class StateContext(NetworkContext):
    """The networks' inputs for groups of a batch and of a state; ``cameras`` are those of all views.

    Each Feature Gaussian lists, in place of its members, the rows of the parts it was pooled from: Gaussians of the
    batch, or groups. Members of earlier batches are not stored.
    """

    samples: ViewSamples  # Of all views
    part_views: np.ndarray  # [p] int64, the view of each part
    part_members: np.ndarray  # [p] int64, Gaussians that became the part
    part_weights: np.ndarray  # [p] sum of their opacities

    def describe(self, features: FeatureGaussians) -> GroupFeatures:
        """Compute the networks' inputs for Feature Gaussians."""
        return self.samples.describe(self.learn(features), self.cameras)

    def learn(self, features: FeatureGaussians) -> Learned:
        """Find each Feature Gaussian's view, the one with most of its weight, and its number of members."""
        starts, rows = features.starts, features.members
        owners = np.repeat(np.arange(len(features)), np.diff(starts))
        keys, places = np.unique(owners * len(self.cameras) + self.part_views[rows], return_inverse=True)
        of_keys, sums = keys // len(self.cameras), np.bincount(places, self.part_weights[rows])
        order = np.lexsort((keys, -sums, of_keys))
        _, first = np.unique(of_keys[order], return_index=True)
        num_members = np.bincount(owners, self.part_members[rows], len(features))
        views = keys[order[first]] % len(self.cameras)
        return Learned(features, views, num_members.astype(np.int64))


def keeps_latents(plan: Plan) -> bool:
    """Return whether an encoder makes latents, which the state then keeps for later batches."""
    return plan.networks is not None and plan.networks.options.encoder


def own_checkpoint(state: State, options: CompactOptions) -> Checkpoint | None:
    """Return the networks of a state as a checkpoint; None for a state without networks.

    The path that the state names may be a stranger's, and is never opened. Raises UsageError if the options name other
    networks, SceneError if they name a file that cannot be read.
    """
    if state.networks is None:
        return None
    name, stored = options.checkpoint, str(state.about["options"].get("checkpoint"))
    path = IN_PACKAGE.get(name, name)
    expected = f"checkpoint {name}: expected the networks that made the state ({stored}), whose latents it holds"
    remedy = "leave the checkpoint out, or begin a new state"
    if name in ("auto", "none"):
        raise UsageError(f"{expected}; {remedy}")
    if name != stored and not _same(load_checkpoint(path).networks, state.networks.weights):
        raise UsageError(f"{expected}, found others; {remedy}")
    return Checkpoint(state.networks.weights, Path(path), str(state.about.get("gsmerge")), {})


def _same(networks: NetworkWeights, other: NetworkWeights) -> bool:
    """Return whether networks are the same to the bit."""
    if networks.options != other.options or networks.arrays.keys() != other.arrays.keys():
        return False
    return all(np.array_equal(array, other.arrays[name]) for name, array in networks.arrays.items())


def sample_views(members: Members, cameras: Cameras, shape: tuple[int, int]) -> ViewSamples:
    """Sample the Gaussians shown at the centres of the cells of a grid of ``shape``."""
    (height, width), num_views = shape, len(cameras)
    rows = ((2 * np.arange(height) + 1) * cameras.height) // (2 * height)
    columns = ((2 * np.arange(width) + 1) * cameras.width) // (2 * width)
    pixels = (rows[:, None] * cameras.width + columns).reshape(-1)
    ids = (np.arange(num_views)[:, None] * (cameras.width * cameras.height) + pixels).reshape(-1)
    if members.pixels is not None:
        ids = np.full_like(ids, -1) if members.fronts is None else members.fronts.reshape(-1)[ids]
    means, sh0 = members.means[ids], members.sh0[ids, 0]
    usable = (ids >= 0) & np.isfinite(means).all(1) & np.isfinite(sh0).all(1) & np.isfinite(members.opacities[ids])
    grid = num_views, height, width
    return ViewSamples(
        np.where(usable[:, None], means, 0).astype(np.float32).reshape(*grid, 3),
        np.where(usable, members.opacities[ids], 0).astype(np.float32).reshape(grid),
        np.where(usable[:, None], sh0, 0).astype(np.float32).reshape(*grid, 3),
    )


def _encode(state: State | None, batch: Batch, count: int | None) -> BatchFeatures:
    """Encode a batch's superpixels; each group stays in one view."""
    plan, cameras = batch.plan, batch.scene.cameras
    weights = plan.networks
    assert weights is not None
    segmentation = segment_scene(batch.scene, plan.superpixels, count)
    members = assign(batch.scene, segmentation.groups, draws=plan.draws)
    pooled = encode(batch.scene, members, segmentation.groups)
    context = NetworkContext(weights, members, cameras, plan.seed)
    if state is None:
        samples = sample_views(members, cameras, (-(-cameras.height // SAMPLE_STEP), -(-cameras.width // SAMPLE_STEP)))
    else:
        assert state.networks is not None
        before, is_new = state.networks.samples, batch.is_new
        after = sample_views(members, cameras, before.opacities.shape[1:])
        added = ViewSamples(after.means[is_new], after.opacities[is_new], after.sh0[is_new])
        samples = ViewSamples.concat([before, added])
        pixels = np.arange(len(members.means)) if members.pixels is None else members.pixels
        context = StateContext(
            networks=weights,
            members=members,
            cameras=concat_cameras(state.cameras, batch.photos.cameras[is_new]),
            seed=plan.seed,
            samples=samples,
            part_views=batch.view_ids[pixels // (cameras.width * cameras.height)],
            part_members=np.ones(len(pixels), np.int64),
            part_weights=members.opacities,
        )
    features = correct(pooled, members, cameras, context, weaken=False)
    return BatchFeatures(features, members, segmentation, context, StateNetworks(weights, samples))


def _divide(new: BatchFeatures, batch: Batch, max_k: int) -> DividedGroups:
    """Match, merge and refine the Feature Gaussians of a first batch, as for a scene of its views."""
    context = new.context
    assert isinstance(context, NetworkContext)
    merged = merge(new.features, match(new.features, batch.plan.match), context)
    refined = refine(merged, context)
    with stage("decode"):
        described = context.describe(refined)
        return DividedGroups(
            without_members(merged),
            make_division(refined, new.members, context, max_k),
            Heads(cast("NetworkWeights", context.networks), described.views, described.group),
            learned=Learned(without_members(refined), described.views, np.diff(refined.starts)),
            saliency=batch_saliency(refined, new.members, batch),
        )


def _children(features: FeatureGaussians, context: NetworkContext, max_k: int) -> tuple[Gaussians, np.ndarray]:
    """Return the analytic children of every group, and the rising group of each; empty if heads need none."""
    if context.makes_children:
        return feature_to_gaussians(features)[:0], np.zeros(0, np.int64)
    return divide(features, context.members, np.full(len(features), max_k))


def _decode(groups: GroupSet, new: BatchFeatures) -> tuple[Gaussians, Gaussians]:
    """Return the Gaussians of the state and of the batch, one for each group, as the heads make them."""
    context, features = new.context, new.features
    assert isinstance(context, StateContext)
    assert groups.learned is not None
    described = context.samples.describe(groups.learned, context.cameras)
    state_gaussians = decode_with_group_features(described.base, np.arange(len(groups)), described, context)
    batch_gaussians = decode_gaussians(feature_to_gaussians(features), np.arange(len(features)), features, context)
    return state_gaussians, batch_gaussians


def _join(
    groups: GroupSet, rows: np.ndarray, new: BatchFeatures, batch: Batch, max_k: int
) -> tuple[GroupSet, dict[str, int]]:
    """Match, merge and refine a batch with the state's ``rows`` in reach; the other groups come first.

    The state's groups precede the batch's, so that the cluster of the merger begins with a group of the state.
    """
    far, near = (select_groups(groups, r) for r in (np.setdiff1d(np.arange(len(groups)), rows), rows))
    assert isinstance(new.context, StateContext)
    assert near.learned is not None
    both, num_old = concat_groups([near, _parts(new.features, new.context, batch, max_k)]), len(near)
    assert both.learned is not None
    context = replace(
        new.context,
        part_views=both.learned.views,
        part_members=both.learned.num_members,
        part_weights=both.features.weights,
    )
    ids = np.arange(len(both))
    parts = replace(both.features, starts=np.arange(len(both) + 1), members=ids.astype(np.int32))
    merged = merge(parts, _match_parts(parts, num_old, batch.plan.match), context)
    refined = _refine_near(merged, near.learned.refined, context)
    sizes = np.diff(both.features.starts)[merged.members]
    owners = np.repeat(np.arange(len(merged)), np.diff(merged.starts))
    children = both.children[take(both.features, merged.members).members]
    weights = both.learned.num_members[merged.members]
    saliency = None if both.saliency is None else both.saliency[merged.members]
    saliency = merge_saliency(saliency, weights, owners, len(merged))
    joined = make_groups(merged, children, owners.repeat(sizes), saliency, context.learn(refined))
    has_old = np.bincount(owners, merged.members < num_old, len(merged)) > 0
    num_joined = int((has_old[owners] & (merged.members >= num_old)).sum())
    return concat_groups([far, limit_children(joined, max_k)]), {"num_joined": num_joined}


def _parts(features: FeatureGaussians, context: NetworkContext, batch: Batch, max_k: int) -> GroupSet:
    """Make groups of a batch's Feature Gaussians, each of one view."""
    views = batch.view_ids[features.views]
    parts = replace(features, views=views)
    learned = Learned(parts, views, np.diff(features.starts))
    children, parents = _children(features, context, max_k)
    return make_groups(parts, children, parents, batch_saliency(features, context.members, batch), learned)


def _match_parts(parts: FeatureGaussians, num_old: int, options: MatchOptions) -> Matches:
    """Match groups of a batch with each other, as in a scene, and with groups of the state.

    Clusters are the union of both matchings. For the second the state counts as one view and the batch as another, so
    that each group is compared with its nearest groups there.
    """
    rows = np.arange(len(parts))
    across = match(replace(parts, views=(rows >= num_old).astype(np.int64)), options).clusters
    within = match(take(parts, rows[num_old:]), options).clusters
    within = np.concatenate([rows[:num_old] + len(rows), within])
    leaders = [np.unique(clusters, return_index=True, return_inverse=True)[1:] for clusters in (across, within)]
    neighbors = np.stack([first[places] for first, places in leaders], 1)
    return Matches(*connected_components(neighbors, np.ones(neighbors.shape), 0.5))


def _refine_near(merged: FeatureGaussians, before: FeatureGaussians, context: StateContext) -> FeatureGaussians:
    """Refine new and changed groups, and groups with such a neighbour; the others stay as in ``before``.

    Each group is refined from the output of the merger, so never twice.
    """
    if not context.options.refiner or len(merged) == 0:
        return merged
    first, sizes = merged.members[merged.starts[:-1]], np.diff(merged.starts)
    touched = (sizes > 1) | (first >= len(before))
    neighbors = find_neighbors(merged.means, context.options.neighbors)
    affected = touched | ((neighbors >= 0) & touched[neighbors]).any(1)
    near = neighbors[affected]
    rows = np.union1d(np.flatnonzero(affected), near[near >= 0])
    refined = refine(take(merged, rows), context)
    index = first.astype(np.int64)
    index[affected] = len(before) + np.searchsorted(rows, np.flatnonzero(affected))
    every = FeatureGaussians.concat([before, without_members(refined)])
    return replace(take(every, index), starts=merged.starts, members=merged.members)


LATENTS = StateKind(WIDE, _encode, _decode, _divide, _join)
