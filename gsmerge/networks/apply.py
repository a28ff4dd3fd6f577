"""Application of the networks: padded tables of tokens by size, run in parallel, and the corrections applied."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from gsmerge.geometry import covariances, rotation_entries, rotmat_to_quat
from gsmerge.moments import Members, feature_to_gaussians
from gsmerge.networks.cross_view_stats import nearest_of_other_views
from gsmerge.networks.modules import SLOTS, Networks
from gsmerge.networks.residuals import (
    HALF,
    RESIDUAL,
    bound_residuals,
    move_features,
    move_gaussians,
    tanh_bounded,
)
from gsmerge.networks.tokens import (
    GroupFeatures,
    compute_group_features,
    group_rows,
    member_tokens,
    part_tokens,
    point_seeds,
    sample_members,
    split_tables,
)
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, FeatureGaussians, Gaussians, as_array, as_tensor

RunTable = Callable[[np.ndarray, int], Tensor]  # rows and width of a table -> [rows, columns]


@dataclass(frozen=True, eq=False)
class NetworkContext:
    """The networks, and their inputs besides the Feature Gaussians."""

    networks: Networks  # encoder, merger, refiner and decoder heads
    members: Members  # the scene's Gaussians
    cameras: Cameras  # its views
    seed: int = 0  # chooses the members of groups that are too large to read whole

    @property
    def trains(self) -> bool:
        """Whether gradients of the networks are needed."""
        return torch.is_grad_enabled() and any(p.requires_grad for p in self.networks.parameters())

    def describe(self, features: FeatureGaussians) -> GroupFeatures:
        """Compute the networks' inputs for Feature Gaussians."""
        return compute_group_features(features, self.members, self.cameras)

    def run(self, network: nn.Module, *inputs: Tensor) -> Tensor:
        """Run one of the networks on its own device, and return its outputs side by side on the CPU."""
        device = next(network.parameters()).device
        outputs = network(*(tensor.to(device) for tensor in inputs))
        return (torch.cat(outputs, 1) if isinstance(outputs, tuple) else outputs).cpu()


def run_tables(sizes: np.ndarray, max_width: int, columns: int, run: RunTable, *, trains: bool) -> Tensor:
    """Run all groups, ``[g,columns]``, in parallel, but one table after the other where gradients are needed."""
    tables = list(split_tables(sizes, max_width))
    if trains:
        outputs = [run(rows, width) for rows, width in tables]
    else:

        def run_without_grad(table: tuple[np.ndarray, int]) -> Tensor:
            with torch.no_grad():  # the mode of the caller's thread does not reach the pool's threads
                return run(*table)

        outputs = parallel_map(run_without_grad, tables)
    if not outputs:
        return torch.zeros(0, columns)
    order = torch.from_numpy(np.concatenate([rows for rows, _ in tables]))
    return torch.zeros(len(sizes), columns).index_copy(0, order, torch.cat(outputs))


def encode_features(features: FeatureGaussians, context: NetworkContext) -> FeatureGaussians:
    """Add latents to Feature Gaussians, and move their means by the encoder (paper section 4.2)."""
    if context.networks.encoder is None:
        return replace(features, latents=torch.zeros(len(features), context.networks.options.latent))
    return run_encoder(context.describe(features), context)[0]


def run_encoder(group_features: GroupFeatures, context: NetworkContext) -> tuple[FeatureGaussians, Tensor]:
    """Apply the encoder to Feature Gaussians, and return them with the corrections ``[g,13]``.

    Gradients flow through the latents and the corrections, never through the geometry.
    """
    features, options, encoder = group_features.features, context.networks.options, context.networks.encoder
    if encoder is None:
        latents = torch.zeros(len(features), options.latent)
        return replace(features, latents=latents), torch.zeros(len(features), RESIDUAL)
    starts, ids = features.starts, features.members
    sizes, seeds = np.diff(starts), point_seeds(features.means, context.seed)
    # the longest axis of each Gaussian, [g,3]: its scales are ascending, so the last column of its rotation
    axes = np.stack(rotation_entries(*group_features.base.quats.numpy().T)[2::3], 1)

    def run(rows: np.ndarray, width: int) -> Tensor:
        positions, owners = group_rows(starts[rows], sizes[rows])
        offsets = context.members.means[ids[positions]] - group_features.base.means.numpy()[rows[owners]]
        keys = (offsets * axes[rows[owners]]).sum(1)
        sample, mask = sample_members(keys, sizes[rows], width, seeds[rows])
        own = torch.from_numpy(np.repeat(rows, width))
        tokens = member_tokens(context.members, ids[positions][sample.reshape(-1)], group_features, own)
        group = group_features.group[torch.from_numpy(rows)]
        return context.run(encoder, tokens.unflatten(0, mask.shape), torch.from_numpy(mask), group)

    encoded = run_tables(sizes, options.members, options.latent + 3, run, trains=context.trains)
    shift = options.bounds.mean * HALF * tanh_bounded(encoded[:, -3:])
    residuals = torch.cat([shift, torch.zeros(len(features), RESIDUAL - 3)], 1)
    moved = move_features(features, group_features.base, residuals.detach(), group_features.frames)
    return replace(moved, latents=tanh_bounded(encoded[:, :-3])), residuals


def match_geometry(features: FeatureGaussians, context: NetworkContext) -> FeatureGaussians:
    """Replace means and covariances by those that the K = 1 head decodes, for matching (paper section 4.3)."""
    group_features, own = context.describe(features), np.arange(len(features))
    base = group_features.base
    if context.networks.options.outputs == "residual":  # of the moments themselves, exactly
        residuals = run_heads(base, own, group_features, context)
        return move_features(features, base, residuals, group_features.frames)
    decoded = decode_with_group_features(base, own, group_features, context).numpy()
    return replace(features, means=decoded.means, covars=covariances(decoded.quats, decoded.scales))


def merge_features(
    pooled: FeatureGaussians, parts: FeatureGaussians, order: np.ndarray, cuts: np.ndarray, context: NetworkContext
) -> FeatureGaussians:
    """Correct c pooled Feature Gaussians by the merger (paper section 4.4).

    Cluster i was pooled from the rows ``order[cuts[i] : cuts[i + 1]]`` of the n Feature Gaussians ``parts``.
    """
    if context.networks.merger is None:
        return pooled
    return run_merger(context.describe(pooled), parts, order, cuts, context)[0]


def run_merger(
    group_features: GroupFeatures, parts: FeatureGaussians, order: np.ndarray, cuts: np.ndarray, context: NetworkContext
) -> tuple[FeatureGaussians, Tensor]:
    """Correct pooled Feature Gaussians, see :func:`merge_features`, and return the corrections ``[c,13]``, too."""
    pooled, options, merger = group_features.features, context.networks.options, context.networks.merger
    if merger is None:
        return pooled, torch.zeros(len(pooled), RESIDUAL)
    base, sizes = feature_to_gaussians(parts).to("cpu"), np.diff(np.append(cuts, len(order)))
    seeds = point_seeds(pooled.means, context.seed)

    def run(rows: np.ndarray, width: int) -> Tensor:
        positions, owners = group_rows(cuts[rows], sizes[rows])
        keys = ((parts.means[order[positions]] - pooled.means[rows[owners]]) ** 2).sum(1)
        sample, mask = sample_members(keys, sizes[rows], width, seeds[rows])
        ids = torch.from_numpy(order[positions][sample.reshape(-1)])
        relative = part_tokens(base[ids], group_features, torch.from_numpy(np.repeat(rows, width)))
        tokens = torch.cat([relative, parts.latents[ids]], 1).unflatten(0, mask.shape)
        group = group_features.group[torch.from_numpy(rows)]
        return context.run(merger, tokens, torch.from_numpy(mask), group)

    raw = run_tables(sizes, options.members, RESIDUAL + options.latent, run, trains=context.trains)
    return _apply_corrections(group_features, raw, context.networks)


def refine_features(features: FeatureGaussians, context: NetworkContext) -> FeatureGaussians:
    """Correct Feature Gaussians by the refiner, which reads their neighbours (paper section 4.5)."""
    if len(features) == 0 or context.networks.refiner is None:
        return features
    return run_refiner(context.describe(features), context)[0]


def run_refiner(group_features: GroupFeatures, context: NetworkContext) -> tuple[FeatureGaussians, Tensor]:
    """Correct Feature Gaussians by the refiner, and return them with the corrections ``[g,13]``."""
    features, options, refiner = group_features.features, context.networks.options, context.networks.refiner
    if refiner is None:
        return features, torch.zeros(len(features), RESIDUAL)
    neighbors, views = find_neighbors(features, options.neighbors), as_tensor(features.views)
    count, width = len(features), neighbors.shape[1] + 1
    table = np.concatenate([np.arange(count)[:, None], neighbors], 1)

    def run(rows: np.ndarray, _: int) -> Tensor:
        ids, own = torch.from_numpy(table[rows].reshape(-1)), torch.from_numpy(np.repeat(rows, width))
        mask = ids >= 0
        ids = torch.where(mask, ids, own)
        relative = part_tokens(group_features.base[ids], group_features, own)
        same_view = (views[ids] == views[own]).float()[:, None]
        tokens = torch.cat([relative, same_view, features.latents[ids]], 1).unflatten(0, (len(rows), width))
        group = group_features.group[torch.from_numpy(rows)]
        return context.run(refiner, tokens, mask.unflatten(0, (len(rows), width)), group)

    max_width, columns = 1 << (width - 1).bit_length(), RESIDUAL + options.latent
    raw = run_tables(np.full(count, width), max_width, columns, run, trains=context.trains)
    return _apply_corrections(group_features, raw, context.networks)


def find_neighbors(features: FeatureGaussians, count: int) -> np.ndarray:
    """Find the nearest other Feature Gaussians in 3D, ``[g,k]`` int64; -1 where there are fewer."""
    means, neighbors = features.means.astype(np.float64), np.full((len(features), count), -1, np.int64)
    rows = np.flatnonzero(np.isfinite(means).all(1))
    near = nearest_of_other_views(means[rows], np.full(len(rows), -1, np.int64), count)  # all of another view
    neighbors[rows] = np.where(near < 0, -1, rows[near])
    return neighbors


def _apply_corrections(
    group_features: GroupFeatures, raw: Tensor, networks: Networks
) -> tuple[FeatureGaussians, Tensor]:
    """Apply raw corrections of merger or refiner, and return the Feature Gaussians with the bounded ``[g,13]``.

    Gradients flow through the latents and the corrections alone.
    """
    features = group_features.features
    residuals = bound_residuals(raw[:, :RESIDUAL], networks.options.bounds, HALF)
    moved = move_features(features, group_features.base, residuals.detach(), group_features.frames)
    return replace(moved, latents=features.latents + tanh_bounded(raw[:, RESIDUAL:])), residuals


def decode_gaussians(
    children: Gaussians, parents: np.ndarray, features: FeatureGaussians, context: NetworkContext
) -> Gaussians:
    """Correct the children of Feature Gaussians by the head for their number (paper section 4.3).

    Those of one Feature Gaussian are next to each other; ``parents [n]`` are its rows, ascending. Three children take
    three slots of the head for four. Five to eight are corrected in two halves, each like the children of a group of
    its own; heads with absolute outputs know only one group, and leave them unchanged.
    """
    return decode_with_group_features(children.to("cpu"), parents, context.describe(features), context).numpy()


def decode_with_group_features(
    children: Gaussians, parents: np.ndarray, group_features: GroupFeatures, context: NetworkContext
) -> Gaussians:
    """Correct children, tensors, as :func:`decode_gaussians` does, from known group features without members."""
    children = prepare_children(children, parents, group_features, context.networks)
    residuals = run_heads(children, parents, group_features, context)
    return move_gaussians(children, residuals, group_features.frames[torch.from_numpy(parents)])


def prepare_children(
    children: Gaussians, parents: np.ndarray, group_features: GroupFeatures, networks: Networks
) -> Gaussians:
    """Replace children by the Gaussians that the heads correct: themselves, or round Gaussians for absolute outputs.

    A round Gaussian lies at its group's mean, with its base colour and the axes of its frame, from which the head's
    outputs are offsets (paper section 4.3). It is as large as the group and half transparent. Five or more children of
    one parent stay unchanged: no head corrects them.
    """
    if networks.options.outputs == "residual":
        return children
    sizes = np.bincount(parents)[parents]
    replaced = torch.from_numpy(sizes <= networks.max_children)
    own = torch.from_numpy(parents)
    means, scales = group_features.base.means[own], group_features.sizes[own, None].expand(-1, 3)
    quats = as_tensor(rotmat_to_quat(as_array(group_features.frames.double())))[own].to(children.quats)
    return replace(
        children,
        means=torch.where(replaced[:, None], means, children.means),
        quats=torch.where(replaced[:, None], quats, children.quats),
        scales=torch.where(replaced[:, None], scales, children.scales),
        opacities=torch.where(replaced, 0.5, children.opacities),
        sh0=torch.where(replaced[:, None, None], group_features.base.sh0[own], children.sh0),
    )


def run_heads(
    children: Gaussians, parents: np.ndarray, group_features: GroupFeatures, context: NetworkContext
) -> Tensor:
    """Compute bounded corrections ``[n,13]`` of children; zero where there is no head for their number."""
    networks = context.networks
    count, halves = len(group_features.features), networks.max_children > SLOTS[-1]
    first, sizes, owners = _families(parents, count, halves=halves)
    residuals = torch.zeros(len(children), RESIDUAL)
    for slots, fewest in zip(SLOTS, (1, 2, 3), strict=True):
        rows = np.flatnonzero((sizes >= fewest) & (sizes <= slots))
        if len(rows) == 0:
            continue
        places = np.arange(slots)[None]
        mask = places < sizes[rows, None]
        ids = first[rows, None] + np.where(mask, places, 0)
        raw = _run_head(children, (owners[rows], ids, mask), group_features, context)
        valid = torch.from_numpy(mask.reshape(-1))
        ids_valid = torch.from_numpy(ids.reshape(-1))[valid]
        residuals = residuals.index_copy(0, ids_valid, bound_residuals(raw[valid], networks.options.head_bounds))
    return residuals


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
) -> Tensor:
    """Compute raw corrections ``[r·slots,13]`` of a table of parents' rows, children's rows and mask."""
    parents, ids, mask = table
    slots, latents = mask.shape[1], group_features.features.latents
    head = context.networks.heads[str(slots)]

    def run(rows: np.ndarray, _: int) -> Tensor:
        own = torch.from_numpy(parents[rows])
        parts = children[torch.from_numpy(ids[rows].reshape(-1))]
        tokens = part_tokens(parts, group_features, own.repeat_interleave(slots)).unflatten(0, (len(rows), slots))
        return context.run(head, latents[own], group_features.group[own], tokens, torch.from_numpy(mask[rows])).flatten(
            1
        )

    raw = run_tables(np.full(len(parents), slots), slots, slots * RESIDUAL, run, trains=context.trains)
    return raw.reshape(-1, RESIDUAL)
