"""Run the networks on tables of tokens, several tables at once, and apply their corrections.

A token describes one Gaussian relative to its group. A table has a row of tokens for each of several groups. Rows are
padded to the same number of tokens. Everything here works on arrays. In training,
:class:`gsmerge.research.training.predict.TrainingContext` replaces methods of :class:`NetworkContext` by the same
formulas on tensors, so that gradients pass from stage to stage.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from gsmerge.arrays import Array, as_array, concat_columns, concat_rows, like
from gsmerge.frozen import dataclass, replace
from gsmerge.method.geometry.pooling import Members, feature_to_gaussians
from gsmerge.method.geometry.transforms import covariances, rotation_entries, rotmat_to_quat
from gsmerge.method.networks.corrections import HALF, move_features, move_gaussians, scale_outputs
from gsmerge.method.networks.corrector import Corrector
from gsmerge.method.networks.cross_view_stats import nearest_of_other_views
from gsmerge.method.networks.options import (
    ABSOLUTE_BOUNDS,
    CORRECTED,
    FEATURE,
    MEMBER_COLUMNS,
    PART_COLUMNS,
    RESIDUAL,
    SLOTS,
    NetworkOptions,
)
from gsmerge.method.networks.tokens import (
    GroupFeatures,
    compute_group_features,
    contiguous,
    group_rows,
    part_tokens,
    point_seeds,
    sample_members,
    split_tables,
)
from gsmerge.method.networks.weights import RunnableNetworks
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, FeatureGaussians, Gaussians

# Fields that a merged Feature Gaussian can take from one of its parts. All other fields describe all parts together
OWN_COLUMNS = (*CORRECTED, "gains", "shN", "footprints")
RunTable = Callable[[np.ndarray, int], Array]  # takes the groups and the width of a table, and returns [groups,columns]


@dataclass(frozen=True, eq=False)
class NetworkContext(Corrector):
    """Networks, together with the scene from which they get their inputs."""

    networks: RunnableNetworks  # encoder, merger, refiner and decoder heads, in training as torch modules
    members: Members  # the scene's Gaussians
    cameras: Cameras  # the scene's views
    seed: int = 0  # seed by which members of large groups are sampled

    @property
    def options(self) -> NetworkOptions:
        """Options of the networks."""
        return self.networks.options

    @property
    def max_children(self) -> int:
        """Largest number of Gaussians that the heads make of a Feature Gaussian."""
        return self.options.max_children

    def encode(self, features: FeatureGaussians) -> FeatureGaussians:
        """Correct Feature Gaussians with the encoder.

        If the option ``geometry`` is "carried", their covariances are decoded by the head for K = 1, as in the paper.
        """
        encoded = encode_features(features, self)
        if self.options.geometry != "carried":
            return encoded
        # The head for K = 1 gives only scales and rotations, and the encoder gives the mean (paper section 4.2)
        return replace(encoded, covars=self.decode_covars(encoded))

    def decode_covars(self, features: FeatureGaussians) -> Array:
        """Decode each Feature Gaussian by the head for K = 1, and return the covariances ``[g,3,3]`` of the results."""
        described = self.describe(features)
        decoded = decode_gaussians(described.base, np.arange(len(features)), described, self)
        return covariances(decoded.quats, decoded.scales)

    def merge(
        self, pooled: FeatureGaussians, parts: FeatureGaussians, order: np.ndarray, cuts: np.ndarray
    ) -> FeatureGaussians:
        """Correct merged Feature Gaussians with the merger (paper section 4.4).

        Row i of ``pooled`` is a cluster of the rows ``order[cuts[i] : cuts[i + 1]]`` of the Feature Gaussians
        ``parts``. In the paper the merger corrects the first row of a cluster instead of the pooled Feature Gaussian.
        """
        options = self.options
        if not options.merger:
            return pooled
        if options.merger_start == "first":
            first_columns = {name: getattr(parts, name)[order[cuts]] for name in OWN_COLUMNS}
            pooled = replace(pooled, **first_columns)
        group_features, base = self.describe(pooled), self.make_base(parts)
        sizes, seeds = np.diff(np.append(cuts, len(order))), point_seeds(as_array(pooled.means), self.seed)
        part_means, means = as_array(parts.means), as_array(pooled.means)

        def run_table(rows: np.ndarray, width: int) -> Any:
            """Run the merger on the clusters ``rows``, from each of which at most ``width`` parts are sampled."""
            positions, owners = group_rows(cuts[rows], sizes[rows])
            keys = ((part_means[order[positions]] - means[rows[owners]]) ** 2).sum(1)
            sample, mask = sample_members(keys, sizes[rows], width, seeds[rows])
            ids = order[positions][sample.reshape(-1)]
            relative = self.make_tokens(base, ids, np.repeat(rows, width), group_features)
            tokens = concat_columns([relative, parts.latents[ids]]).reshape(*mask.shape, -1)
            return self.networks.run("merger", tokens, mask, group_features.group[rows])

        outputs = self.run_tables(sizes, options.members, FEATURE + options.latent, run_table)
        return _apply_outputs(group_features, outputs, self)

    @stage("refine")
    def refine(self, features: FeatureGaussians) -> FeatureGaussians:
        """Correct Feature Gaussians with the refiner, which also reads their neighbours (paper section 4.5)."""
        options = self.options
        if len(features) == 0 or not options.refiner:
            return features
        group_features = self.describe(features)
        views = features.views
        neighbors = find_neighbors(as_array(features.means), options.neighbors)
        count = len(features)
        width = neighbors.shape[1] + 1
        table = np.concatenate([np.arange(count)[:, None], neighbors], 1)

        def run_table(rows: np.ndarray, _: int) -> Any:
            """Run the refiner on the groups ``rows``, each with its neighbours."""
            ids = table[rows].reshape(-1)
            owners = np.repeat(rows, width)
            mask = ids >= 0
            ids = np.where(mask, ids, owners)
            relative = self.make_tokens(group_features.base, ids, owners, group_features)
            is_same_view = (views[ids] == views[owners]).astype(np.float32)[:, None]
            tokens = concat_columns([relative, is_same_view, features.latents[ids]]).reshape(len(rows), width, -1)
            return self.networks.run("refiner", tokens, mask.reshape(len(rows), width), group_features.group[rows])

        # width up to a power of two
        max_width = 1 << (width - 1).bit_length()
        columns = FEATURE + options.latent
        outputs = self.run_tables(np.full(count, width), max_width, columns, run_table)
        return _apply_outputs(group_features, outputs, self)

    @property
    def makes_children(self) -> bool:
        """True if the heads make all children, instead of correcting children made by closed formulas."""
        return self.options.makes_children

    def decode(self, children: Gaussians, parents: np.ndarray, features: FeatureGaussians) -> Gaussians:
        """Correct ``children`` with the decoder heads, see :func:`decode_gaussians`."""
        return decode_gaussians(children, parents, self.describe(features), self)

    def make_base(self, features: FeatureGaussians) -> Gaussians:
        """Return Gaussians with the moments of Feature Gaussians, as contiguous arrays for the kernels."""
        return contiguous(feature_to_gaussians(features))

    def describe(self, features: FeatureGaussians) -> GroupFeatures:
        """Return the inputs of the networks for Feature Gaussians."""
        return compute_group_features(features, self.members, self.cameras)

    def make_tokens(
        self, parts: Gaussians | Members, ids: np.ndarray, owners: np.ndarray, group_features: GroupFeatures
    ) -> Array:
        """Return tokens ``[m,c]`` that describe the Gaussians ``ids [m]`` of ``parts`` relative to their groups.

        ``owners [m]`` are the groups. Tokens of members have more columns than tokens of other Gaussians.
        """
        return part_tokens(
            parts, ids, owners, group_features, MEMBER_COLUMNS if isinstance(parts, Members) else PART_COLUMNS
        )

    def correct_features(self, group_features: GroupFeatures, residuals: Array) -> FeatureGaussians:
        """Return the Feature Gaussians of ``group_features`` with corrections ``residuals [g,14]``."""
        g = group_features
        return move_features(g.features, g.base, as_array(residuals), g.frames)

    def run_tables(self, sizes: np.ndarray, max_width: int, columns: int, run: RunTable) -> Array:
        """Split groups of ``sizes [g]`` into tables, call ``run`` on each, and join the outputs to ``[g,columns]``."""
        tables = list(split_tables(sizes, max_width))
        if not tables:
            return np.zeros((0, columns), np.float32)
        if self.networks.in_parallel:
            outputs = parallel_map(lambda table: run(*table), tables)
        else:
            outputs = [run(*table) for table in tables]
        output_rows = np.empty(len(sizes), np.int64)  # row of each group in the joined outputs of all tables
        output_rows[np.concatenate([rows for rows, _ in tables])] = np.arange(len(sizes))
        return concat_rows(outputs)[output_rows]


def encode_features(features: FeatureGaussians, context: NetworkContext) -> FeatureGaussians:
    """Add latents to Feature Gaussians and correct their means with the encoder (paper section 4.2)."""
    options = context.options
    if not options.encoder:
        return replace(features, latents=np.zeros((len(features), options.latent), np.float32))
    group_features = context.describe(features)
    starts = features.starts
    ids = features.members
    sizes, seeds = np.diff(starts), point_seeds(as_array(features.means), context.seed)
    base = group_features.base
    # [g,3] the longest axis of each Gaussian: column 2 of its 3 x 3 rotation, because scales are ascending
    axes, means = np.stack(rotation_entries(*as_array(base.quats).T)[2::3], 1), as_array(base.means)

    def run_table(rows: np.ndarray, width: int) -> Any:
        """Run the encoder on the groups ``rows``, from each of which at most ``width`` members are sampled."""
        positions, owners = group_rows(starts[rows], sizes[rows])
        offsets = context.members.means[ids[positions]] - means[rows[owners]]
        keys = (offsets * axes[rows[owners]]).sum(1)
        sample, mask = sample_members(keys, sizes[rows], width, seeds[rows])
        member_ids = ids[positions][sample.reshape(-1)]
        tokens = context.make_tokens(context.members, member_ids, np.repeat(rows, width), group_features)
        table = tokens.reshape(*mask.shape, MEMBER_COLUMNS)
        return context.networks.run("encoder", table, mask, group_features.group[rows])

    encoded = context.run_tables(sizes, options.members, options.latent + 3, run_table)
    zeros = np.zeros((len(features), FEATURE - 3), np.float32)
    residuals = scale_outputs(concat_columns([encoded[:, -3:], zeros]), options.bounds, HALF)
    return replace(context.correct_features(group_features, residuals), latents=encoded[:, :-3])


def find_neighbors(means: np.ndarray, count: int) -> np.ndarray:
    """Return the nearest neighbours ``[g,count]`` int64 of points ``means [g,3]``, and -1 where there are fewer."""
    means, neighbors = means.astype(np.float64), np.full((len(means), count), -1, np.int64)
    rows = np.flatnonzero(np.isfinite(means).all(1))
    no_views = np.full(len(rows), -1, np.int64)  # these points count as points of different views
    nearest = nearest_of_other_views(means[rows], no_views, count)
    neighbors[rows] = np.where(nearest < 0, -1, rows[nearest])
    return neighbors


def _apply_outputs(group_features: GroupFeatures, outputs: Array, context: NetworkContext) -> FeatureGaussians:
    """Apply outputs ``[g,14+latent]`` of the merger or the refiner, which are corrections and changes of latents."""
    features = group_features.features
    moved = context.correct_features(group_features, scale_outputs(outputs[:, :FEATURE], context.options.bounds, HALF))
    return replace(moved, latents=like(features.latents, outputs) + outputs[:, FEATURE:])


def decode_gaussians(
    children: Gaussians, parents: np.ndarray, group_features: GroupFeatures, context: NetworkContext
) -> Gaussians:
    """Correct the children of each Feature Gaussian with the head for that number of children (paper section 4.3).

    The children of a Feature Gaussian are adjacent. ``parents [n]`` are the rows of the Feature Gaussians in
    ``group_features``, ascending. Groups of three children use the head for four children. Five to eight children are
    corrected in two halves, as if each half were a group. Heads with absolute outputs cannot correct halves.
    """
    children = prepare_children(children, parents, group_features, context.options)
    residuals = as_array(run_heads(contiguous(children), parents, group_features, context))
    return move_gaussians(children, residuals, parents, group_features.frames)


def prepare_children(
    children: Gaussians, parents: np.ndarray, group_features: GroupFeatures, options: NetworkOptions
) -> Gaussians:
    """Return the Gaussians that the heads correct: the children or, for absolute outputs, as many round Gaussians.

    A round Gaussian has the mean, the base colour and the size of its group, the axes of the group's frame, and an
    opacity of 0.5. The head puts out offsets from the parameters of round Gaussians (paper section 4.3).
    """
    if not options.makes_children:
        return children
    base = group_features.base
    frames = group_features.frames.astype(np.float64)
    return replace(
        children,
        means=base.means[parents],
        quats=rotmat_to_quat(frames)[parents].astype(np.float32),
        scales=np.repeat(group_features.sizes[parents, None], 3, 1),
        opacities=np.full(len(children), 0.5, np.float32),
        sh0=base.sh0[parents],
    )


def run_heads(
    children: Gaussians, parents: np.ndarray, group_features: GroupFeatures, context: NetworkContext
) -> Array:
    """Return bounded corrections ``[n,13]`` of children by the heads, or zeros if no head corrects their number."""
    options = context.options
    count = len(group_features.features)
    all_sizes = np.bincount(parents, minlength=count)
    all_starts = np.cumsum(all_sizes) - all_sizes
    # A head corrects a run of children together. More than four children of a parent are split into two runs
    is_split = (all_sizes > SLOTS[-1]) & (options.max_children > SLOTS[-1])
    first_sizes = np.where(is_split, (all_sizes + 1) // 2, all_sizes)
    starts = np.concatenate([all_starts, (all_starts + first_sizes)[is_split]])
    sizes = np.concatenate([first_sizes, (all_sizes - first_sizes)[is_split]])
    owners = np.concatenate([np.arange(count), np.flatnonzero(is_split)])  # parent of each run
    # The outputs begin with a row of zeros, for children without a head
    outputs = [np.zeros((1, RESIDUAL), np.float32)]
    output_rows = np.zeros(len(children), np.int64)
    num_outputs = 1
    for slots, min_size in zip(SLOTS, (1, 2, 3), strict=True):  # the heads and their least numbers of children
        rows = np.flatnonzero((sizes >= min_size) & (sizes <= slots))
        if len(rows) == 0:
            continue
        offsets = np.arange(slots)[None]
        mask = offsets < sizes[rows, None]
        ids = starts[rows, None] + np.where(mask, offsets, 0)
        outputs.append(
            _run_head(children, owners[rows], ids=ids, mask=mask, group_features=group_features, context=context)
        )
        output_rows[ids[mask]] = num_outputs + np.flatnonzero(mask)
        num_outputs += mask.size
    return scale_outputs(
        concat_rows(outputs)[output_rows], ABSOLUTE_BOUNDS if options.makes_children else options.bounds
    )


def _run_head(
    children: Gaussians,
    parents: np.ndarray,
    ids: np.ndarray,
    mask: np.ndarray,
    group_features: GroupFeatures,
    context: NetworkContext,
) -> Array:
    """Return the outputs ``[r·slots,13]`` of the head for ``slots`` children, run on r runs of children.

    ``parents [r]`` are the groups of the runs, and ``ids [r,slots]`` the rows of the children. ``mask [r,slots]`` is
    false for slots without a child.
    """
    slots = mask.shape[1]
    latents = group_features.features.latents

    def run_table(rows: np.ndarray, _: int) -> Any:
        """Run the head on the runs of children with the numbers ``rows``."""
        owners = parents[rows]
        tokens = context.make_tokens(children, ids[rows].reshape(-1), np.repeat(owners, slots), group_features)
        table = tokens.reshape(len(rows), slots, PART_COLUMNS)
        return context.networks.run(f"heads.{slots}", latents[owners], group_features.group[owners], table, mask[rows])

    outputs = context.run_tables(np.full(len(parents), slots), slots, slots * RESIDUAL, run_table)
    return outputs.reshape(-1, RESIDUAL)
