"""Add batches of views to Feature Gaussians with ``recipe=paper`` (paper section 4.5, "Online reconstruction").

New views are encoded, matched with the earlier Feature Gaussians, merged into them and refined. The decoder heads of
the networks make K Gaussians of each Feature Gaussian, for any K. The result of a single batch has the same bytes as
the result of ``compact``.
"""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np

from gsmerge.errors import UsageError
from gsmerge.frozen import dataclass, fields, replace
from gsmerge.io.formats.gsm import NUM_HIGHER
from gsmerge.jobs.states.extend import (
    NOT_COMPARED,
    UNKNOWN_WORLD,
    BatchReport,
    append_names,
    compare_worlds,
    refuse_other_world,
)
from gsmerge.method.geometry.frame import Frame
from gsmerge.method.geometry.pooling import Members, feature_to_gaussians, gaussian_members
from gsmerge.method.geometry.views import concat_cameras, resize_cameras
from gsmerge.method.kernels.gaussians.cluster import connected_components
from gsmerge.method.networks.apply import NetworkContext, decode_gaussians
from gsmerge.method.networks.checkpoint import Checkpoint
from gsmerge.method.networks.cross_view_stats import cross_view_stats
from gsmerge.method.networks.tokens import GroupFeatures, describe_features, make_group_features
from gsmerge.method.networks.weights import NetworkWeights
from gsmerge.method.pipelines.pixel_rows import encode_groups
from gsmerge.method.stages.decode import counts_by_saliency, group_saliency, repeat_groups
from gsmerge.method.stages.match import match
from gsmerge.method.stages.merge import merge
from gsmerge.method.stages.segment import segment_scene
from gsmerge.method.stages.superpixels import scene_saliency
from gsmerge.plan.make_plan import make_plan
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.prepare.steps import without
from gsmerge.runtime.record import Progress, record_run, stage
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.compact import ONE_PIECE, CompactOptions
from gsmerge.settings.extend import ExtendOptions
from gsmerge.settings.stages import MIXED, DecodeOptions, MatchOptions
from gsmerge.types import Cameras, FeatureGaussians, Gaussians, Matches, Pixels, Scene
from gsmerge.version import __version__


@dataclass(frozen=True, eq=False)
class ViewSamples:
    """Gaussians of every view at a coarse grid of pixels, for comparison with groups of other views."""

    means: np.ndarray  # [v,h,w,3] float32, canonical
    opacities: np.ndarray  # [v,h,w] float32, 0 if the pixel has no Gaussian
    sh0: np.ndarray  # [v,h,w,3] float32

    @staticmethod
    def concat(parts: list[ViewSamples]) -> ViewSamples:
        """Return the samples of the views of all ``parts``."""
        names = [f.name for f in fields(ViewSamples)]
        return ViewSamples(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True, eq=False)
class FeatureState:
    """Feature Gaussians of all views so far, in the canonical frame of the first batch."""

    merged: FeatureGaussians  # g groups after merging, in the canonical frame; later batches are matched with these
    refined: FeatureGaussians  # the same g groups after the refiner; the heads decode these
    views: np.ndarray  # [g] int64, the view in whose frame the networks see the group
    num_members: np.ndarray  # [g] int64, number of Gaussians that were pooled into the group
    saliency: np.ndarray  # [g] float64, mean corner response of the group's pixels, which decides a mixed K
    group: np.ndarray  # [g,n] float32, the networks' inputs about each group
    samples: ViewSamples  # of all views
    cameras: Cameras  # of all views, canonical, at the size of the first batch's views
    frame: Frame  # the canonical frame, in the world
    networks: NetworkWeights
    checkpoint: str = ""  # name of the networks, as the user gave it
    names: tuple[str, ...] = ()  # of the views

    def __len__(self) -> int:
        return len(self.refined)

    def __repr__(self) -> str:
        return f"FeatureState({len(self):,} Feature Gaussians of {len(self.cameras):,} views)"


@dataclass(frozen=True, eq=False, kw_only=True)
class _JoinContext(NetworkContext):
    """Networks and their inputs, for the groups of a state and of a batch together; ``cameras`` has all views.

    Feature Gaussians are pooled from parts in place of members, and list the rows of their parts, because a state does
    not store the members of its groups. A part is a group of the state or of the batch.
    """

    samples: ViewSamples  # of all views
    part_views: np.ndarray  # [p] int64, the view of each part
    part_members: np.ndarray  # [p] int64, number of Gaussians that were pooled into the part
    part_weights: np.ndarray  # [p] sum of the opacities of these Gaussians

    def describe(self, features: FeatureGaussians) -> GroupFeatures:
        """Compute the networks' inputs for Feature Gaussians, from the samples of all views."""
        views, num_members = self.summarise_parts(features)
        height, width = self.samples.opacities.shape[1:]
        unused = np.zeros((0, 0), np.float32)  # the statistics do not read these columns
        samples = Members(
            means=self.samples.means.reshape(-1, 3), quats=unused, scales=unused,
            opacities=self.samples.opacities.reshape(-1), sh0=self.samples.sh0.reshape(-1, 1, 3), shN=unused,
            footprints=unused, pixels=unused, fronts=Pixels.of_grid(np.ones(self.samples.opacities.shape)).fronts,
        )  # fmt: skip
        grid_cameras = resize_cameras(self.cameras, width, height)
        stats = cross_view_stats(features.means, features.sh0, views, samples, grid_cameras)
        return describe_features(features, views, num_members, stats, self.cameras)

    def summarise_parts(self, features: FeatureGaussians) -> tuple[np.ndarray, np.ndarray]:
        """Return the view ``[g]`` with most of each Feature Gaussian's weight, and its number of members ``[g]``."""
        num_views = len(self.cameras)
        rows = features.members
        owners = np.repeat(np.arange(len(features)), np.diff(features.starts))  # the Feature Gaussian of each part
        pairs, pair_ids = np.unique(owners * num_views + self.part_views[rows], return_inverse=True)
        pair_owners = pairs // num_views
        pair_weights = np.bincount(pair_ids, self.part_weights[rows])
        order = np.lexsort((pairs, -pair_weights, pair_owners))  # by owner, the heaviest view first
        _, heaviest = np.unique(pair_owners[order], return_index=True)
        num_members = np.bincount(owners, self.part_members[rows], len(features))
        return pairs[order[heaviest]] % num_views, num_members.astype(np.int64)


def extend_features(
    state: FeatureState | None, scene: Scene, options: CompactOptions, extend_options: ExtendOptions,
    *, progress: Progress | None = None,
) -> tuple[FeatureState, BatchReport]:  # fmt: skip
    """Add a batch of views to a state, or to a new one if ``state`` is None; see :mod:`gsmerge.jobs.states.extend`.

    Returns the new state and the report. Raises UsageError if the settings ask for a budget, for a fit, or for other
    networks than the state has, or if the degrees of the harmonics of the scene and of the state differ.
    """
    _check_options(options)
    options = options.with_settings(ONE_PIECE)
    with use_threads(options.threads), record_run(progress) as record:
        frame = None if state is None else state.frame
        prepared = prepare(scene.numpy(), options.prepare, frame, steps=without("outside"))  # other batches see more
        prepared_scene = prepared.scene
        world = UNKNOWN_WORLD
        checkpoint = None
        if state is not None:
            world = compare_worlds(feature_to_gaussians(state.refined), prepared_scene, prepared_scene.gaussians.means)
            refuse_other_world(world, extend_options)
            if options.checkpoint != state.checkpoint:
                raise UsageError(
                    f"checkpoint {options.checkpoint}: expected the networks that made the state ({state.checkpoint});"
                    " omit the checkpoint, or begin a new state"
                )
            checkpoint = Checkpoint(state.networks, Path(state.checkpoint), __version__, {})
        plan = make_plan(prepared, options, checkpoint)
        weights = plan.merge.networks
        if weights is None or not weights.options.encoder or not weights.options.makes_children:
            raise UsageError(
                f"recipe paper: expected networks with an encoder and absolute outputs, {options.checkpoint} lacks them"
            )
        groups = segment_scene(prepared_scene, plan.merge.superpixels, plan.count.limits, None).groups
        features, members, context = encode_groups(prepared_scene, groups, plan.merge, plan.seed)
        assert isinstance(context, NetworkContext)
        samples = sample_fronts(members, prepared_scene.cameras, state)
        pixel_saliency = scene_saliency(prepared_scene.images)
        if state is None:
            merged = merge(features, match(features, plan.merge.match), context)
            saliency = group_saliency(merged, members, pixel_saliency)
            extended = _refine_groups(merged, context, saliency, samples, prepared.frame)
        else:
            degree = scene.gaussians.sh_degree
            expected = NUM_HIGHER.index(state.merged.shN.shape[1])
            if degree != expected:
                raise UsageError(f"expected harmonics of degree {expected}, as in the state, got {degree}")
            saliency = group_saliency(features, members, pixel_saliency)
            extended = _join_batch(
                state, features, saliency=saliency, context=context, samples=samples, options=plan.merge.match
            )
    numbers = {"num_views": len(prepared_scene), "num_input": scene.num_gaussians, "num_new": len(features)}
    notes = [*record.notes, *([NOT_COMPARED] if state is not None and world == UNKNOWN_WORLD else [])]
    report = BatchReport(
        **numbers, num_gaussians=len(extended), num_kept=0, pictures=prepared.reference.name, views={},
        sh_degree=scene.gaussians.sh_degree, seconds=record.seconds,
        choices=record.choices | plan.merge.network_facts | {"world": world}, notes=tuple(notes),
        options=options.to_dict(),
    )  # fmt: skip
    input_names = prepared.input_scene.names
    names = tuple(input_names[prepared.repeated.index(view)] for view in range(len(prepared_scene)))
    if state is not None:
        names = append_names(state.names, names)
    return replace(extended, checkpoint=options.checkpoint, names=names), report


def _check_options(options: CompactOptions) -> None:
    """Raise UsageError for settings that Feature Gaussians in batches do not support, such as a budget or a fit."""
    for name in options.compact_only:
        raise UsageError(f"{name}: not possible for Feature Gaussians in batches; use compact on the whole scene")
    if options.budget.budget is not None:
        raise UsageError(
            f"budget {options.budget.budget}: not possible with recipe paper; set superpixels=NUMBER here, and --k when"
            " decoding"
        )
    if options.fit.fit != "none":
        raise UsageError(f"fit {options.fit.fit}: expected none with recipe paper")


def sample_fronts(members: Members, cameras: Cameras, state: FeatureState | None) -> ViewSamples:
    """Sample the foremost Gaussian at the centre of each cell of a grid, in every view.

    The grid has as many cells as the grid of the ``state``. Without a state the cells are squares of a fixed size.
    """
    sample_step = 8  # pixels between samples of a view along each axis
    new_shape = -(-cameras.height // sample_step), -(-cameras.width // sample_step)
    height, width = new_shape if state is None else state.samples.opacities.shape[1:]
    rows = ((2 * np.arange(height) + 1) * cameras.height) // (2 * height)
    columns = ((2 * np.arange(width) + 1) * cameras.width) // (2 * width)
    pixels = (rows[:, None] * cameras.width + columns).reshape(-1)
    pixel_ids = (np.arange(len(cameras))[:, None] * (cameras.width * cameras.height) + pixels).reshape(-1)
    ids = members.fronts.reshape(-1)[pixel_ids]  # rows of the foremost Gaussians, -1 for none
    means = members.means[ids]
    sh0 = members.sh0[ids, 0]
    usable = (ids >= 0) & np.isfinite(means).all(1) & np.isfinite(sh0).all(1) & np.isfinite(members.opacities[ids])
    grid = len(cameras), height, width
    return ViewSamples(
        np.where(usable[:, None], means, 0).astype(np.float32).reshape(*grid, 3),
        np.where(usable, members.opacities[ids], 0).astype(np.float32).reshape(grid),
        np.where(usable[:, None], sh0, 0).astype(np.float32).reshape(*grid, 3),
    )


def _refine_groups(
    merged: FeatureGaussians, context: NetworkContext, saliency: np.ndarray, samples: ViewSamples, frame: Frame
) -> FeatureState:  # fmt: skip
    """Refine merged Feature Gaussians, and return a state with the merged and the refined ones."""
    refined = context.refine(merged)
    with stage("decode"):
        described = context.describe(refined)
    num_members = context.summarise_parts(refined)[1] if isinstance(context, _JoinContext) else np.diff(refined.starts)
    return FeatureState(
        merged=_without_members(merged),
        refined=_without_members(refined),
        views=described.views,
        num_members=num_members,
        saliency=saliency,
        group=np.asarray(described.group),
        samples=samples,
        cameras=context.cameras,
        frame=frame,
        networks=cast("NetworkWeights", context.networks),
    )


def _join_batch(
    state: FeatureState, features: FeatureGaussians, saliency: np.ndarray, context: NetworkContext,
    samples: ViewSamples, options: MatchOptions,
) -> FeatureState:  # fmt: skip
    """Match, merge and refine the Feature Gaussians of a state and of a batch; return the new state.

    ``features``, ``saliency``, ``context`` and ``samples`` belong to the batch. Views of the state come first.
    """
    size = state.cameras.width, state.cameras.height
    cameras = concat_cameras(state.cameras, resize_cameras(context.cameras, *size))
    views = features.views + len(state.cameras)
    parts = FeatureGaussians.concat([state.merged, _without_members(replace(features, views=views))])
    # The only member of each part is the row of the part, so that merged Feature Gaussians list the rows of their parts
    parts = replace(parts, starts=np.arange(len(parts) + 1), members=np.arange(len(parts)).astype(np.int32))
    part_members = np.concatenate([state.num_members, np.diff(features.starts)])
    all_samples = ViewSamples.concat([state.samples, samples])
    join_context = _JoinContext(
        networks=context.networks, members=context.members, cameras=cameras, seed=context.seed, samples=all_samples,
        part_views=np.concatenate([state.views, views]), part_members=part_members,
        part_weights=np.asarray(parts.weights),
    )  # fmt: skip
    # The Feature Gaussians of the batch are matched with each other, as in a scene, and with the state. For the
    # matching with the state, all parts of the state count as one view, and all parts of the batch as another. In this
    # way each part of the state is compared with its nearest neighbours in the batch, and vice versa
    is_new = np.arange(len(parts)) >= len(state)
    across = match(replace(parts, views=is_new.astype(np.int64)), options)
    batch_views = np.where(is_new, parts.views, -1)
    batch_extinctions = np.where(is_new, parts.extinctions, 0)
    within = match(replace(parts, views=batch_views, extinctions=batch_extinctions), options)
    # Clusters of both matchings are joined if they share a part. All scores are set to 1, which is above the threshold,
    # so that all neighbours are connected
    neighbors = np.stack([_first_members(across.clusters), _first_members(within.clusters)], 1)
    matches = Matches(*connected_components(neighbors, np.ones(neighbors.shape), threshold=0.5))
    merged = merge(parts, matches, join_context)
    # The saliency of a merged Feature Gaussian is the mean over its parts, weighted by their numbers of members
    owners = np.repeat(np.arange(len(merged)), np.diff(merged.starts))
    weights = part_members.astype(np.float64)[merged.members]
    part_saliency = np.concatenate([state.saliency, saliency])[merged.members]
    total = np.bincount(owners, weights * part_saliency, len(merged))
    merged_saliency = total / np.bincount(owners, weights, len(merged))
    return _refine_groups(merged, join_context, merged_saliency, all_samples, state.frame)


def _first_members(clusters: np.ndarray) -> np.ndarray:
    """Return for each part the row ``[p]`` of the first part of its cluster; ``clusters [p]`` has cluster numbers."""
    _, first_rows, cluster_ids = np.unique(clusters, return_index=True, return_inverse=True)
    return first_rows[cluster_ids]


def _without_members(features: FeatureGaussians) -> FeatureGaussians:
    """Return the Feature Gaussians with empty lists of members."""
    return replace(features, starts=np.zeros(len(features) + 1, np.int64), members=np.zeros(0, np.int32))


def decode_features(state: FeatureState, options: DecodeOptions) -> Gaussians:
    """Decode a state into ``k`` Gaussians per group in the world frame.

    With a mixed K, saliency decides how many Gaussians each group gets.

    Raises UsageError if the networks' heads make fewer Gaussians per group than ``k``, or if ``k_rule`` needs the
    members of the groups.
    """
    max_children = state.networks.options.max_children
    if options.k == MIXED and options.k_rule == "distortion":
        raise UsageError("k_rule distortion: expected saliency, since Feature Gaussians do not keep their members")
    if options.max_k > max_children:
        raise UsageError(f"k: expected mixed or 1 to {max_children}, got {options.k}")
    counts = np.full(len(state), options.max_k)
    if options.k == MIXED:
        counts = counts_by_saliency(state.saliency, options)
    children, parents = repeat_groups(state.refined, counts)
    described = make_group_features(state.refined, state.views, state.group, state.cameras)
    no_members = gaussian_members(children[:0], np.zeros(0, np.float32))  # the heads read none
    context = NetworkContext(state.networks, no_members, state.cameras)
    gaussians = decode_gaussians(children, parents, described, context)
    gaussians = gaussians[gaussians.opacities >= options.min_opacity]
    return state.frame.leave(gaussians)
