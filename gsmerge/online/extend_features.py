"""State and new views -> state, where groups keep their latents (paper section 4.5, "Online reconstruction").

New views are encoded, matched with the state, merged into it, and refined where they touch it; heads decode on demand.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gsmerge.encoded.encoded import without_members
from gsmerge.errors import SceneError, UsageError
from gsmerge.facts.prepare import Prepared
from gsmerge.facts.views import concat_cameras
from gsmerge.kernels.gaussians.cluster import connected_components
from gsmerge.moments import Members, feature_to_gaussians
from gsmerge.networks.apply import NetworkContext, decode_gaussians, decode_with_group_features, find_neighbors
from gsmerge.networks.checkpoint import IN_PACKAGE, Checkpoint, load_checkpoint
from gsmerge.networks.tokens import choose_views
from gsmerge.networks.weights import NetworkWeights
from gsmerge.online.batch_photos import (
    REACH,
    BatchPhotos,
    novel_rows,
    photos_of_batch,
    rows_in_view,
    update_replay,
)
from gsmerge.online.options import OnlineOptions
from gsmerge.online.state import (
    GroupSet,
    Learned,
    OnlineState,
    StateNetworks,
    ViewSamples,
    concat_groups,
    first_state,
    grown_state,
    limit_children,
    sample_views,
    select_groups,
    with_child_rows,
)
from gsmerge.online.state_context import StateContext
from gsmerge.plan import Plan
from gsmerge.runtime.record import choose, note, stage
from gsmerge.settings.compact import CompactOptions
from gsmerge.stages.assign import assign
from gsmerge.stages.decode import divide
from gsmerge.stages.encode import correct, encode
from gsmerge.stages.match import MatchOptions, match
from gsmerge.stages.merge import merge, refine, take
from gsmerge.stages.segment import segment_scene
from gsmerge.types import Cameras, FeatureGaussians, Gaussians, Matches

WIDE = 3 * REACH  # standard deviations about what a view sees, in which the refiner finds the neighbours of its border
SAMPLE_STEP = 8  # pixels between the samples of a view along each axis


def keeps_features(plan: Plan) -> bool:
    """Return whether later batches go on with what the networks make of this one: where an encoder makes latents."""
    networks = plan.networks[0]
    return len(plan.networks) == 1 and networks is not None and networks.options.encoder


def own_checkpoint(state: OnlineState, options: CompactOptions) -> Checkpoint | None:
    """Return the networks of a state as a checkpoint; None for a state without.

    Raises UsageError if the options name others, SceneError if they name a file that cannot be read.
    """
    if state.networks is None:
        return None
    name, known = options.checkpoint, str(state.about["options"].get("checkpoint"))
    path = IN_PACKAGE.get(name, name)
    expected = f"checkpoint {name}: expected the networks that made the state ({known}), whose latents it holds"
    remedy = "leave the checkpoint out, or begin a new state"
    if name in ("auto", "none"):
        raise UsageError(f"{expected}; {remedy}")
    try:
        same = _same(load_checkpoint(path).networks, state.networks.weights)
    except SceneError:
        if name != known:
            raise
        same = True  # the state has its own
    if not same and name != known:
        raise UsageError(f"{expected}, found others; {remedy}")
    if not same:
        note(f"checkpoint {name}: not the networks that made the state any more; the state's own go on")
    return Checkpoint(state.networks.weights, Path(path), state.about["gsmerge"], {})


def _same(one: NetworkWeights, other: NetworkWeights) -> bool:
    """Return whether networks are the same to the bit."""
    if one.options != other.options or one.arrays.keys() != other.arrays.keys():
        return False
    return all(np.array_equal(array, other.arrays[name]) for name, array in one.arrays.items())


def add_features(
    state: OnlineState | None, prepared: Prepared, plan: Plan, count: int | None, online: OnlineOptions, max_k: int
) -> tuple[OnlineState, dict[str, int]]:
    """Add a batch to the state; return it, and the numbers of the batch's groups by key of the report."""
    scene, weights = prepared.scene, plan.networks[0]
    assert weights is not None
    superpixels = segment_scene(scene, plan.superpixels, count).groups
    members = assign(scene, superpixels)
    pooled = encode(scene, members, superpixels)
    photos, ids = photos_of_batch(scene, None if state is None else state.cameras)
    counts = {"num_new": len(pooled), "num_covered": 0, "num_joined": 0, "num_hidden": 0}
    if state is None:
        samples = sample_views(members, scene.cameras, _grid(scene.cameras))
        groups = _first_groups(pooled, NetworkContext(weights, members, scene.cameras, plan.seed), plan, max_k)
        state = first_state(groups, prepared, plan, max_k)
    else:
        assert state.networks is not None
        is_new = ids >= len(state.cameras)
        context = _batch_context(state, members, scene.cameras, photos.cameras[is_new], ids, plan)
        samples, known = context.samples, state.cameras
        rows = rows_in_view(state.groups.features, photos.cameras, WIDE)
        there, away = (select_groups(state.groups, r) for r in (rows, np.setdiff1d(np.arange(len(state)), rows)))
        features = correct(pooled, members, known, context, weaken=False)
        if online.tolerance > 0:
            with stage("cover"):
                features = take(features, _novel_rows(there, features, context, photos, scene.cameras, online))
            counts["num_covered"] = len(pooled) - len(features)
        joined, counts["num_joined"] = _join(there, _parts(features, context, ids, max_k), context, plan, max_k)
        state = grown_state(state, concat_groups([away, joined]), prepared, plan, photos.cameras[is_new])
    state = replace(state, networks=StateNetworks(weights, samples))
    choose(groups=len(pooled), clusters=len(state))
    if plan.checkpoint is not None:
        choose(networks=plan.checkpoint.facts())
    if prepared.given.images is None:
        return state, counts
    return replace(state, replay=update_replay(state.replay, photos, ids, len(state.cameras), online.replay)), counts


def _grid(cameras: Cameras) -> tuple[int, int]:
    """Return rows and columns of the samples of each view."""
    return -(-cameras.height // SAMPLE_STEP), -(-cameras.width // SAMPLE_STEP)


def _first_groups(pooled: FeatureGaussians, context: NetworkContext, plan: Plan, max_k: int) -> GroupSet:
    """Encode, match, merge and refine the Feature Gaussians of a first batch, as for a scene of its views."""
    features = correct(pooled, context.members, context.cameras, context, weaken=False)
    merged = merge(features, match(features, plan.match, context), context)
    refined = refine(merged, context)
    views = choose_views(refined, context.members, context.cameras)
    learned = Learned(without_members(refined), views, np.diff(refined.starts))
    return _group_set(merged, learned, *_children(refined, context, max_k))


def _batch_context(
    state: OnlineState, members: Members, cameras: Cameras, new_cameras: Cameras, ids: np.ndarray, plan: Plan
) -> StateContext:
    """Return the state's networks for a batch, whose Gaussians are the parts; ``new_cameras``: the unknown views'."""
    assert state.networks is not None
    is_new = np.flatnonzero(ids >= len(state.cameras))
    known = state.networks.samples
    samples = sample_views(members, cameras, known.opacities.shape[1:])
    fresh = ViewSamples(samples.means[is_new], samples.opacities[is_new], samples.sh0[is_new])
    pixels = np.arange(len(members.means)) if members.pixels is None else members.pixels
    return StateContext(
        networks=state.networks.weights,
        members=members,
        cameras=concat_cameras(state.cameras, new_cameras),
        seed=plan.seed,
        samples=ViewSamples.concat([known, fresh]),
        part_views=ids[pixels // (cameras.width * cameras.height)],
        part_members=np.ones(len(pixels), np.int64),
        part_weights=members.opacities,
    )


def _children(features: FeatureGaussians, context: NetworkContext, max_k: int) -> tuple[Gaussians, np.ndarray]:
    """Return the analytic children of every group, and the rising group of each; none where heads need none."""
    if context.options.outputs == "absolute":
        return feature_to_gaussians(features)[:0], np.zeros(0, np.int64)
    return divide(features, context.members, np.full(len(features), max_k))


def _group_set(merged: FeatureGaussians, learned: Learned, children: Gaussians, parents: np.ndarray) -> GroupSet:
    """Make groups of merged Feature Gaussians and their children; ``parents``: the rising group of each child."""
    nothing = np.zeros(len(merged), np.float32)
    return GroupSet(with_child_rows(merged, parents), children, merged.sh0, nothing, learned)


def _parts(features: FeatureGaussians, context: StateContext, ids: np.ndarray, max_k: int) -> GroupSet:
    """Make groups of a batch's Feature Gaussians, each of one view."""
    views = ids[features.views]
    own = replace(features, views=views)
    learned = Learned(without_members(own), views, np.diff(features.starts))
    return _group_set(own, learned, *_children(features, context, max_k))


def _novel_rows(
    there: GroupSet,
    features: FeatureGaussians,
    context: StateContext,
    photos: BatchPhotos,
    cameras: Cameras,
    online: OnlineOptions,
) -> np.ndarray:
    """Return the rows of a batch's Feature Gaussians that show its photos better than the state, all at K = 1."""
    assert there.learned is not None
    known = context.samples.describe(
        there.learned.refined, there.learned.views, there.learned.num_members, context.cameras
    )
    shown = decode_with_group_features(known.base, np.arange(len(there)), known, context)
    own = decode_gaussians(feature_to_gaussians(features), np.arange(len(features)), features, context)
    return novel_rows(shown, own, features, context.members, photos.photos(2), cameras, online)


def _join(there: GroupSet, new: GroupSet, batch: StateContext, plan: Plan, max_k: int) -> tuple[GroupSet, int]:
    """Match, merge and refine groups of the state and of a batch; return them, and how many joined the state's.

    The state comes first, so that the merger's cluster begins with one of its groups.
    """
    both, num_old = concat_groups([there, new]), len(there)
    assert both.learned is not None
    assert there.learned is not None
    context = replace(
        batch,
        part_views=both.learned.views,
        part_members=both.learned.num_members,
        part_weights=both.features.weights,
    )
    rows = np.arange(len(both))
    parts = replace(both.features, starts=np.arange(len(both) + 1), members=rows.astype(np.int32))
    merged = merge(parts, _match_parts(parts, num_old, plan.match, context), context)
    refined = _refine_near(merged, there.learned.refined, context)
    sizes = np.diff(both.features.starts)[merged.members]
    owners = np.repeat(np.arange(len(merged)), np.diff(merged.starts))
    children = both.children[take(both.features, merged.members).members]
    learned = Learned(without_members(refined), *context.facts(refined))
    groups = limit_children(_group_set(merged, learned, children, owners.repeat(sizes)), max_k)
    has_old = np.bincount(owners, merged.members < num_old, len(merged)) > 0
    return groups, int((has_old[owners] & (merged.members >= num_old)).sum())


def _match_parts(parts: FeatureGaussians, num_old: int, options: MatchOptions, context: StateContext) -> Matches:
    """Match groups of a batch with each other, as of a scene, and with the state's; clusters are the union of both.

    The state counts as one view and the batch as another, so that each group is compared with its nearest there.
    """
    rows = np.arange(len(parts))
    across = match(replace(parts, views=(rows >= num_old).astype(np.int64)), options, context).clusters
    within = match(take(parts, rows[num_old:]), options, context).clusters
    within = np.concatenate([rows[:num_old] + len(rows), within])
    leaders = [np.unique(clusters, return_index=True, return_inverse=True)[1:] for clusters in (across, within)]
    neighbors = np.stack([first[places] for first, places in leaders], 1)
    return Matches(*connected_components(neighbors, np.ones(neighbors.shape), 0.5))


def _refine_near(merged: FeatureGaussians, before: FeatureGaussians, context: StateContext) -> FeatureGaussians:
    """Refine what is new or changed, and what has such a neighbour; the others stay as ``before``, by their part.

    Each is refined from what the merger left, never twice.
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
