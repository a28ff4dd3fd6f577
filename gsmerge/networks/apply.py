"""Feature Gaussians through the networks: padded tables by size, run in parallel, and the corrections applied."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from gsmerge.geometry import covariances, rotation_entries, rotmat_to_quat
from gsmerge.moments import Members, feature_to_gaussians
from gsmerge.networks.cross_view_stats import nearest_points
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
    """The networks, and what they read besides the Feature Gaussians."""

    networks: Networks  # encoder, merger, refiner and decoder heads
    members: Members  # the scene's Gaussians
    cameras: Cameras  # its views
    seed: int = 0  # chooses the members of groups that are too large to read whole

    @property
    def trains(self) -> bool:
        """Whether gradients of the networks are wanted."""
        return torch.is_grad_enabled() and any(p.requires_grad for p in self.networks.parameters())

    def describe(self, features: FeatureGaussians) -> GroupFeatures:
        """The inputs of the networks for Feature Gaussians."""
        return compute_group_features(features, self.members, self.cameras)

    def run(self, network: nn.Module, *inputs: Tensor) -> Tensor:
        """Output of one of the networks, on the CPU wherever it runs; several outputs side by side."""
        device = next(network.parameters()).device
        outputs = network(*(tensor.to(device) for tensor in inputs))
        return (torch.cat(outputs, 1) if isinstance(outputs, tuple) else outputs).cpu()


def run_tables(sizes: np.ndarray, max_width: int, columns: int, run: RunTable, *, trains: bool) -> Tensor:
    """``[g,columns]`` outputs of all groups; in parallel, but one table after the other where gradients are needed."""
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
    """Feature Gaussians with latents, and with means moved by the encoder (paper section 4.2)."""
    if context.networks.encoder is None:
        return replace(features, latents=torch.zeros(len(features), context.networks.options.latent))
    group_features = context.describe(features)
    encoded = run_encoder(features, group_features, context)
    return apply_encoding(features, group_features, encoded, context.networks)[0]


def run_encoder(features: FeatureGaussians, group_features: GroupFeatures, context: NetworkContext) -> Tensor:
    """``[g,latent+3]`` raw latents and shifts; zero without an encoder."""
    starts, ids = features.starts, features.members
    sizes, options, encoder = np.diff(starts), context.networks.options, context.networks.encoder
    if encoder is None:
        return torch.zeros(len(features), options.latent + 3)
    seeds, axes = point_seeds(features.means, context.seed), _longest_axes(group_features.base)

    def run(rows: np.ndarray, width: int) -> Tensor:
        positions, owners = group_rows(starts[rows], sizes[rows])
        offsets = context.members.means[ids[positions]] - group_features.base.means.numpy()[rows[owners]]
        keys = (offsets * axes[rows[owners]]).sum(1)
        sample, mask = sample_members(keys, sizes[rows], width, seeds[rows])
        own = torch.from_numpy(np.repeat(rows, width))
        tokens = member_tokens(context.members, ids[positions][sample.reshape(-1)], group_features, own)
        group = group_features.group[torch.from_numpy(rows)]
        return context.run(encoder, tokens.unflatten(0, mask.shape), torch.from_numpy(mask), group)

    return run_tables(sizes, options.members, options.latent + 3, run, trains=context.trains)


def _longest_axes(base: Gaussians) -> np.ndarray:
    """``[g,3]`` third axis of each Gaussian, whose scales are ascending: the last column of its rotation."""
    return np.stack(rotation_entries(*base.quats.numpy().T)[2::3], 1)


def apply_encoding(
    features: FeatureGaussians, group_features: GroupFeatures, encoded: Tensor, networks: Networks
) -> tuple[FeatureGaussians, Tensor]:
    """The Feature Gaussians with the encoder's output applied, and the corrections ``[g,13]``.

    Gradients flow through the latents and the corrections, never through the geometry.
    """
    shift = networks.options.bounds.mean * HALF * tanh_bounded(encoded[:, -3:])
    residuals = torch.cat([shift, torch.zeros(len(features), RESIDUAL - 3)], 1)
    moved = move_features(features, group_features.base, residuals.detach(), group_features.frames)
    return replace(moved, latents=tanh_bounded(encoded[:, :-3])), residuals


def match_geometry(features: FeatureGaussians, context: NetworkContext) -> FeatureGaussians:
    """Feature Gaussians with means and covariances as the K = 1 head decodes them, for matching (paper section 4.3)."""
    group_features, own = context.describe(features), np.arange(len(features))
    if context.networks.options.outputs == "residual":  # of the moments themselves, exactly
        residuals = run_heads(group_features.base, own, features, group_features, context)
        return move_features(features, group_features.base, residuals, group_features.frames)
    decoded = decode_with_group_features(group_features.base, own, features, group_features, context)
    decoded = decoded.numpy()
    return replace(features, means=decoded.means, covars=covariances(decoded.quats, decoded.scales))


def merge_features(
    pooled: FeatureGaussians, parts: FeatureGaussians, order: np.ndarray, cuts: np.ndarray, context: NetworkContext
) -> FeatureGaussians:
    """Pooled Feature Gaussians with the merger's corrections (paper section 4.4).

    Args:
        pooled: c Feature Gaussians, one for each run of ``order``.
        parts: The n Feature Gaussians that were pooled.
        order: ``[n]`` rows of ``parts``, cluster by cluster.
        cuts: ``[c]`` where each cluster begins in ``order``.
        context: The networks and the scene.
    """
    if context.networks.merger is None:
        return pooled
    group_features = context.describe(pooled)
    raw = run_merger(pooled, group_features, parts, order, cuts, context)
    return apply_corrections(pooled, group_features, raw, context.networks)[0]


def run_merger(
    pooled: FeatureGaussians,
    group_features: GroupFeatures,
    parts: FeatureGaussians,
    order: np.ndarray,
    cuts: np.ndarray,
    context: NetworkContext,
) -> Tensor:
    """``[c,13+latent]`` raw corrections of clusters, see :func:`merge_features`; zero without a merger."""
    base, columns = feature_to_gaussians(parts).to("cpu"), RESIDUAL + context.networks.options.latent
    sizes, merger = np.diff(np.append(cuts, len(order))), context.networks.merger
    if merger is None:
        return torch.zeros(len(pooled), columns)
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

    return run_tables(sizes, context.networks.options.members, columns, run, trains=context.trains)


def refine_features(features: FeatureGaussians, context: NetworkContext) -> FeatureGaussians:
    """Feature Gaussians with the refiner's corrections, which depend on their neighbours (paper section 4.5)."""
    if len(features) == 0 or context.networks.refiner is None:
        return features
    neighbors = find_neighbors(features, context.networks.options.neighbors)
    group_features = context.describe(features)
    raw = run_refiner(features, group_features, neighbors, context)
    return apply_corrections(features, group_features, raw, context.networks)[0]


def run_refiner(
    features: FeatureGaussians, group_features: GroupFeatures, neighbors: np.ndarray, context: NetworkContext
) -> Tensor:
    """``[g,13+latent]`` raw corrections from ``neighbors [g,k]``, -1 where there are fewer; zero without a refiner."""
    count, width, refiner = len(features), neighbors.shape[1] + 1, context.networks.refiner
    columns = RESIDUAL + context.networks.options.latent
    if refiner is None:
        return torch.zeros(count, columns)
    table = np.concatenate([np.arange(count)[:, None], neighbors], 1)
    views = as_tensor(features.views)

    def run(rows: np.ndarray, _: int) -> Tensor:
        ids, own = torch.from_numpy(table[rows].reshape(-1)), torch.from_numpy(np.repeat(rows, width))
        mask = ids >= 0
        ids = torch.where(mask, ids, own)
        relative = part_tokens(group_features.base[ids], group_features, own)
        same_view = (views[ids] == views[own]).float()[:, None]
        tokens = torch.cat([relative, same_view, features.latents[ids]], 1).unflatten(0, (len(rows), width))
        group = group_features.group[torch.from_numpy(rows)]
        return context.run(refiner, tokens, mask.unflatten(0, (len(rows), width)), group)

    return run_tables(np.full(count, width), 1 << (width - 1).bit_length(), columns, run, trains=context.trains)


def find_neighbors(features: FeatureGaussians, count: int) -> np.ndarray:
    """``[g,k]`` int64 nearest other Feature Gaussians in 3D; -1 where there are fewer."""
    means, neighbors = features.means.astype(np.float64), np.full((len(features), count), -1, np.int64)
    rows = np.flatnonzero(np.isfinite(means).all(1))
    near = nearest_points(means[rows], count)
    neighbors[rows] = np.where(near < 0, -1, rows[near])
    return neighbors


def apply_corrections(
    features: FeatureGaussians, group_features: GroupFeatures, raw: Tensor, networks: Networks
) -> tuple[FeatureGaussians, Tensor]:
    """Feature Gaussians with the raw corrections of merger or refiner, and the bounded ones ``[g,13]``.

    Gradients flow through the latents and the corrections alone.
    """
    residuals = bound_residuals(raw[:, :RESIDUAL], networks.options.bounds, HALF)
    moved = move_features(features, group_features.base, residuals.detach(), group_features.frames)
    return replace(moved, latents=features.latents + tanh_bounded(raw[:, RESIDUAL:])), residuals


def decode_gaussians(
    children: Gaussians, parents: np.ndarray, features: FeatureGaussians, context: NetworkContext
) -> Gaussians:
    """Children of Feature Gaussians with the corrections of the head for their number (paper section 4.3).

    Three children take three slots of the head for four. Five to eight are corrected in two halves, each like the
    children of a group of its own; heads with absolute outputs know only one group, and leave them as they are.

    Args:
        children: Analytic Gaussians, those of one Feature Gaussian next to each other.
        parents: ``[n]`` the Feature Gaussian of each, ascending.
        features: The Feature Gaussians.
        context: The networks and the scene.
    """
    group_features = context.describe(features)
    return decode_with_group_features(children.to("cpu"), parents, features, group_features, context).numpy()


def decode_with_group_features(
    children: Gaussians,
    parents: np.ndarray,
    features: FeatureGaussians,
    group_features: GroupFeatures,
    context: NetworkContext,
) -> Gaussians:
    """:func:`decode_gaussians` of tensors, with group features that are known, without the scene's members."""
    children = prepare_children(children, parents, features, group_features, context.networks)
    residuals = run_heads(children, parents, features, group_features, context)
    return move_gaussians(children, residuals, group_features.frames[torch.from_numpy(parents)])


def prepare_children(
    children: Gaussians,
    parents: np.ndarray,
    features: FeatureGaussians,
    group_features: GroupFeatures,
    networks: Networks,
) -> Gaussians:
    """The Gaussians that the heads correct: the children; for absolute outputs a round Gaussian for each.

    It lies at its group's mean and has its base colour, from which the head's outputs are offsets (paper section 4.3).
    It is as large as the group, half transparent, with the axes of the group's frame. Five or more
    children of one parent stay as they are: no head corrects them.
    """
    if networks.options.outputs == "residual":
        return children
    sizes = np.bincount(parents, minlength=len(features))[parents]
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
    children: Gaussians,
    parents: np.ndarray,
    features: FeatureGaussians,
    group_features: GroupFeatures,
    context: NetworkContext,
) -> Tensor:
    """``[n,13]`` bounded corrections of children; zero where no head looks."""
    networks = context.networks
    first, sizes, owners = _families(parents, len(features), halves=networks.max_children > SLOTS[-1])
    residuals = torch.zeros(len(children), RESIDUAL)
    for slots, fewest in zip(SLOTS, (1, 2, 3), strict=True):
        rows = np.flatnonzero((sizes >= fewest) & (sizes <= slots))
        if len(rows) == 0:
            continue
        places = np.arange(slots)[None]
        mask = places < sizes[rows, None]
        ids = first[rows, None] + np.where(mask, places, 0)
        raw = _run_head(slots, children, (owners[rows], ids, mask), features, group_features, context)
        valid = torch.from_numpy(mask.reshape(-1))
        ids_valid = torch.from_numpy(ids.reshape(-1))[valid]
        residuals = residuals.index_copy(0, ids_valid, bound_residuals(raw[valid], networks.options.head_bounds))
    return residuals


def _families(parents: np.ndarray, count: int, *, halves: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Children that one head looks at together, first, number and parent: those of a parent, many in two halves."""
    sizes = np.bincount(parents, minlength=count)
    first = np.cumsum(sizes) - sizes
    large = (sizes > SLOTS[-1]) & halves
    half = np.where(large, (sizes + 1) // 2, sizes)
    begin = np.concatenate([first, (first + half)[large]])
    num = np.concatenate([half, (sizes - half)[large]])
    return begin, num, np.concatenate([np.arange(count), np.flatnonzero(large)])


def _run_head(
    slots: int,
    children: Gaussians,
    table: tuple[np.ndarray, np.ndarray, np.ndarray],
    features: FeatureGaussians,
    group_features: GroupFeatures,
    context: NetworkContext,
) -> Tensor:
    """``[r·slots,13]`` raw corrections of a table of parents' rows, children's rows and mask."""
    parents, ids, mask = table
    head = context.networks.heads[str(slots)]

    def run(rows: np.ndarray, _: int) -> Tensor:
        own = torch.from_numpy(parents[rows])
        parts = children[torch.from_numpy(ids[rows].reshape(-1))]
        tokens = part_tokens(parts, group_features, own.repeat_interleave(slots)).unflatten(0, (len(rows), slots))
        inputs = features.latents[own], group_features.group[own], tokens, torch.from_numpy(mask[rows])
        return context.run(head, *inputs).flatten(1)

    raw = run_tables(np.full(len(parents), slots), slots, slots * RESIDUAL, run, trains=context.trains)
    return raw.reshape(-1, RESIDUAL)
