"""Application of the networks: padded tables of tokens by size, run in parallel, and the corrections applied.

All is arrays, but for latents and what networks return: with the modules of training these are tensors, through which
gradients flow. They never flow through the geometry.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from gsmerge.geometry import covariances, rotation_entries, rotmat_to_quat
from gsmerge.moments import Members, feature_to_gaussians
from gsmerge.networks.corrections import HALF, move_features, move_gaussians, scale_outputs
from gsmerge.networks.cross_view_stats import nearest_of_other_views
from gsmerge.networks.options import MEMBER, PART, RESIDUAL, SLOTS, NetworkOptions
from gsmerge.networks.tokens import (
    GroupFeatures,
    compute_group_features,
    contiguous,
    group_rows,
    part_tokens,
    point_seeds,
    sample_members,
    split_tables,
)
from gsmerge.networks.weights import NetworkWeights
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Array, Cameras, FeatureGaussians, Gaussians, as_array, concat_columns, concat_rows, like

if TYPE_CHECKING:
    from gsmerge.networks.modules import Networks

RunTable = Callable[[np.ndarray, int], Array]  # rows and width of a table -> [rows, columns]


@dataclass(frozen=True, eq=False)
class NetworkContext:
    """The networks, and their inputs besides the Feature Gaussians."""

    networks: NetworkWeights | Networks  # encoder, merger, refiner and decoder heads; the modules of training
    members: Members  # the scene's Gaussians
    cameras: Cameras  # its views
    seed: int = 0  # chooses the members of groups that are too large to read whole

    @property
    def options(self) -> NetworkOptions:
        """Sizes of the networks."""
        return self.networks.options

    def describe(self, features: FeatureGaussians) -> GroupFeatures:
        """Compute the networks' inputs for Feature Gaussians."""
        return compute_group_features(features, self.members, self.cameras)

    def run_tables(self, sizes: np.ndarray, max_width: int, columns: int, run: RunTable) -> Array:
        """Run all groups, ``[g,columns]``, table by table."""
        tables = list(split_tables(sizes, max_width))
        if not tables:
            return np.zeros((0, columns), np.float32)
        if self.networks.in_parallel:
            outputs = parallel_map(lambda table: run(*table), tables)
        else:
            outputs = [run(*table) for table in tables]
        places = np.empty(len(sizes), np.int64)
        places[np.concatenate([rows for rows, _ in tables])] = np.arange(len(sizes))
        return concat_rows(outputs)[places]


def encode_features(features: FeatureGaussians, context: NetworkContext) -> FeatureGaussians:
    """Add latents to Feature Gaussians, and move their means by the encoder (paper section 4.2)."""
    if not context.options.encoder:
        return replace(features, latents=np.zeros((len(features), context.options.latent), np.float32))
    return run_encoder(context.describe(features), context)[0]


def run_encoder(group_features: GroupFeatures, context: NetworkContext) -> tuple[FeatureGaussians, Array]:
    """Apply the encoder to Feature Gaussians, and return them with the corrections ``[g,13]``."""
    features, options = group_features.features, context.options
    if not options.encoder:
        latents = np.zeros((len(features), options.latent), np.float32)
        return replace(features, latents=latents), np.zeros((len(features), RESIDUAL), np.float32)
    starts, ids = features.starts, features.members
    sizes, seeds = np.diff(starts), point_seeds(features.means, context.seed)
    # the longest axis of each Gaussian, [g,3]: its scales are ascending, so the last column of its rotation
    axes = np.stack(rotation_entries(*group_features.base.quats.T)[2::3], 1)

    def run(rows: np.ndarray, width: int) -> Array:
        positions, owners = group_rows(starts[rows], sizes[rows])
        offsets = context.members.means[ids[positions]] - group_features.base.means[rows[owners]]
        keys = (offsets * axes[rows[owners]]).sum(1)
        sample, mask = sample_members(keys, sizes[rows], width, seeds[rows])
        chosen = ids[positions][sample.reshape(-1)]
        tokens = part_tokens(context.members, chosen, np.repeat(rows, width), group_features, MEMBER)
        table = tokens.reshape(*mask.shape, MEMBER)
        return context.networks.run("encoder", table, mask, group_features.group[rows])

    encoded = context.run_tables(sizes, options.members, options.latent + 3, run)
    others = np.zeros((len(features), RESIDUAL - 3), np.float32)
    residuals = scale_outputs(concat_columns([encoded[:, -3:], others]), options.bounds, HALF)
    moved = move_features(features, group_features.base, as_array(residuals), group_features.frames)
    return replace(moved, latents=encoded[:, :-3]), residuals


def match_geometry(features: FeatureGaussians, context: NetworkContext) -> FeatureGaussians:
    """Replace means and covariances by those that the K = 1 head decodes, for matching (paper section 4.3)."""
    group_features, own = context.describe(features), np.arange(len(features))
    base = group_features.base
    if context.options.outputs == "residual":  # of the moments themselves, exactly
        residuals = as_array(run_heads(base, own, group_features, context))
        return move_features(features, base, residuals, group_features.frames)
    decoded = decode_with_group_features(base, own, group_features, context)
    return replace(features, means=decoded.means, covars=covariances(decoded.quats, decoded.scales))


def merge_features(
    pooled: FeatureGaussians, parts: FeatureGaussians, order: np.ndarray, cuts: np.ndarray, context: NetworkContext
) -> FeatureGaussians:
    """Correct c pooled Feature Gaussians by the merger (paper section 4.4).

    Cluster i was pooled from the rows ``order[cuts[i] : cuts[i + 1]]`` of the n Feature Gaussians ``parts``.
    """
    if not context.options.merger:
        return pooled
    return run_merger(context.describe(pooled), parts, order, cuts, context)[0]


def run_merger(
    group_features: GroupFeatures, parts: FeatureGaussians, order: np.ndarray, cuts: np.ndarray, context: NetworkContext
) -> tuple[FeatureGaussians, Array]:
    """Correct pooled Feature Gaussians, see :func:`merge_features`, and return the corrections ``[c,13]``, too."""
    pooled, options = group_features.features, context.options
    if not options.merger:
        return pooled, np.zeros((len(pooled), RESIDUAL), np.float32)
    base, sizes = contiguous(feature_to_gaussians(parts)), np.diff(np.append(cuts, len(order)))
    seeds = point_seeds(pooled.means, context.seed)

    def run(rows: np.ndarray, width: int) -> Array:
        positions, owners = group_rows(cuts[rows], sizes[rows])
        keys = ((parts.means[order[positions]] - pooled.means[rows[owners]]) ** 2).sum(1)
        sample, mask = sample_members(keys, sizes[rows], width, seeds[rows])
        ids = order[positions][sample.reshape(-1)]
        relative = part_tokens(base, ids, np.repeat(rows, width), group_features)
        tokens = concat_columns([relative, parts.latents[ids]]).reshape(*mask.shape, -1)
        return context.networks.run("merger", tokens, mask, group_features.group[rows])

    outputs = context.run_tables(sizes, options.members, RESIDUAL + options.latent, run)
    return _apply_corrections(group_features, outputs, options)


def refine_features(features: FeatureGaussians, context: NetworkContext) -> FeatureGaussians:
    """Correct Feature Gaussians by the refiner, which reads their neighbours (paper section 4.5)."""
    if len(features) == 0 or not context.options.refiner:
        return features
    return run_refiner(context.describe(features), context)[0]


def run_refiner(group_features: GroupFeatures, context: NetworkContext) -> tuple[FeatureGaussians, Array]:
    """Correct Feature Gaussians by the refiner, and return them with the corrections ``[g,13]``."""
    features, options = group_features.features, context.options
    if not options.refiner:
        return features, np.zeros((len(features), RESIDUAL), np.float32)
    neighbors, views = find_neighbors(features, options.neighbors), features.views
    count, width = len(features), neighbors.shape[1] + 1
    table = np.concatenate([np.arange(count)[:, None], neighbors], 1)

    def run(rows: np.ndarray, _: int) -> Array:
        ids, own = table[rows].reshape(-1), np.repeat(rows, width)
        mask = ids >= 0
        ids = np.where(mask, ids, own)
        relative = part_tokens(group_features.base, ids, own, group_features, PART + 1)
        relative[:, PART] = views[ids] == views[own]
        tokens = concat_columns([relative, features.latents[ids]]).reshape(len(rows), width, -1)
        return context.networks.run("refiner", tokens, mask.reshape(len(rows), width), group_features.group[rows])

    max_width, columns = 1 << (width - 1).bit_length(), RESIDUAL + options.latent
    outputs = context.run_tables(np.full(count, width), max_width, columns, run)
    return _apply_corrections(group_features, outputs, options)


def find_neighbors(features: FeatureGaussians, count: int) -> np.ndarray:
    """Find the nearest other Feature Gaussians in 3D, ``[g,k]`` int64; -1 where there are fewer."""
    means, neighbors = features.means.astype(np.float64), np.full((len(features), count), -1, np.int64)
    rows = np.flatnonzero(np.isfinite(means).all(1))
    near = nearest_of_other_views(means[rows], np.full(len(rows), -1, np.int64), count)  # all of another view
    neighbors[rows] = np.where(near < 0, -1, rows[near])
    return neighbors


def _apply_corrections(
    group_features: GroupFeatures, outputs: Array, options: NetworkOptions
) -> tuple[FeatureGaussians, Array]:
    """Apply outputs of merger or refiner, and return the Feature Gaussians with the corrections ``[g,13]``."""
    features = group_features.features
    residuals = scale_outputs(outputs[:, :RESIDUAL], options.bounds, HALF)
    moved = move_features(features, group_features.base, as_array(residuals), group_features.frames)
    return replace(moved, latents=like(features.latents, outputs) + outputs[:, RESIDUAL:]), residuals


def decode_gaussians(
    children: Gaussians, parents: np.ndarray, features: FeatureGaussians, context: NetworkContext
) -> Gaussians:
    """Correct the children of Feature Gaussians by the head for their number (paper section 4.3).

    Those of one Feature Gaussian are next to each other; ``parents [n]`` are its rows, ascending. Three children take
    three slots of the head for four. Five to eight are corrected in two halves, each like the children of a group of
    its own; heads with absolute outputs know only one group, and leave them unchanged.
    """
    return decode_with_group_features(children, parents, context.describe(features), context)


def decode_with_group_features(
    children: Gaussians, parents: np.ndarray, group_features: GroupFeatures, context: NetworkContext
) -> Gaussians:
    """Correct children as :func:`decode_gaussians` does, from known group features without members."""
    children = prepare_children(children, parents, group_features, context.options)
    residuals = as_array(run_heads(children, parents, group_features, context))
    return move_gaussians(children, residuals, parents, group_features.frames)


def prepare_children(
    children: Gaussians, parents: np.ndarray, group_features: GroupFeatures, options: NetworkOptions
) -> Gaussians:
    """Replace children by the Gaussians that the heads correct: themselves, or round Gaussians for absolute outputs.

    A round Gaussian lies at its group's mean, with its base colour and the axes of its frame, from which the head's
    outputs are offsets (paper section 4.3). It is as large as the group and half transparent. Five or more children of
    one parent stay unchanged: no head corrects them.
    """
    if options.outputs == "residual":
        return children
    replaced = np.bincount(parents)[parents] <= options.max_children
    base, frames = group_features.base, group_features.frames.astype(np.float64)
    round_ones = replace(
        children,
        means=base.means[parents],
        quats=rotmat_to_quat(frames)[parents].astype(np.float32),
        scales=np.repeat(group_features.sizes[parents, None], 3, 1),
        opacities=np.full(len(children), 0.5, np.float32),
        sh0=base.sh0[parents],
    )
    columns = {name: (getattr(round_ones, name), column) for name, column in vars(children).items()}
    return Gaussians(
        **{name: np.where(replaced.reshape(-1, *[1] * (pair[1].ndim - 1)), *pair) for name, pair in columns.items()}
    )


def run_heads(
    children: Gaussians, parents: np.ndarray, group_features: GroupFeatures, context: NetworkContext
) -> Array:
    """Compute bounded corrections ``[n,13]`` of children; zero where there is no head for their number."""
    options, children = context.options, contiguous(children)
    count, halves = len(group_features.features), options.max_children > SLOTS[-1]
    first, sizes, owners = _families(parents, count, halves=halves)
    outputs, places, total = [np.zeros((1, RESIDUAL), np.float32)], np.zeros(len(children), np.int64), 1
    for slots, fewest in zip(SLOTS, (1, 2, 3), strict=True):
        rows = np.flatnonzero((sizes >= fewest) & (sizes <= slots))
        if len(rows) == 0:
            continue
        offsets = np.arange(slots)[None]
        mask = offsets < sizes[rows, None]
        ids = first[rows, None] + np.where(mask, offsets, 0)
        outputs.append(_run_head(children, (owners[rows], ids, mask), group_features, context))
        places[ids[mask]] = total + np.flatnonzero(mask)
        total += mask.size
    return scale_outputs(concat_rows(outputs)[places], options.head_bounds)


def _families(parents: np.ndarray, count: int, *, halves: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find first, number and parent of the children that a head reads together: many of a parent in two halves."""
    sizes = np.bincount(parents, minlength=count)
    first = np.cumsum(sizes) - sizes
    large = (sizes > SLOTS[-1]) & halves
    half = np.where(large, (sizes + 1) // 2, sizes)
    begin = np.concatenate([first, (first + half)[large]])
    num = np.concatenate([half, (sizes - half)[large]])
    return begin, num, np.concatenate([np.arange(count), np.flatnonzero(large)])


def _run_head(
    children: Gaussians,
    table: tuple[np.ndarray, np.ndarray, np.ndarray],
    group_features: GroupFeatures,
    context: NetworkContext,
) -> Array:
    """Compute outputs ``[r·slots,13]`` of a table of parents' rows, children's rows and mask."""
    parents, ids, mask = table
    slots, latents = mask.shape[1], group_features.features.latents

    def run(rows: np.ndarray, _: int) -> Array:
        own = parents[rows]
        tokens = part_tokens(children, ids[rows].reshape(-1), np.repeat(own, slots), group_features)
        children_of = tokens.reshape(len(rows), slots, PART)
        return context.networks.run(f"heads.{slots}", latents[own], group_features.group[own], children_of, mask[rows])

    outputs = context.run_tables(np.full(len(parents), slots), slots, slots * RESIDUAL, run)
    return outputs.reshape(-1, RESIDUAL)
