"""Feature Gaussians through the networks: tables by size, worked off in parallel, corrections applied."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from gsmerge.geometry import rotmat_to_quat
from gsmerge.moments import Members, feature_to_gaussians
from gsmerge.networks.modules import SLOTS, Networks
from gsmerge.networks.residuals import HALF, RESIDUAL, bounded, move_features, move_gaussians, tanh_bounded
from gsmerge.networks.subsets import choose, point_dice, runs, tables
from gsmerge.networks.tokens import GroupFeatures, compute_group_features, member_tokens, part_tokens
from gsmerge.runtime.threads import parallel_map, use_threads
from gsmerge.types import Cameras, FeatureGaussians, Gaussians

Work = Callable[[np.ndarray, int], Tensor]  # rows of a table and its width -> [rows, columns]


@dataclass(frozen=True, eq=False)
class NetworkContext:
    """The networks, and what they look at besides the Feature Gaussians.

    Args:
        networks: Encoder, merger, refiner and decoder heads.
        members: The scene's Gaussians.
        cameras: Its views.
        seed: Chooses the members of groups that are too large to look at all.
        precision: ``"float32"`` or ``"bfloat16"``, of the networks' own arithmetic.
    """

    networks: Networks
    members: Members
    cameras: Cameras
    seed: int = 0
    precision: str = "float32"

    def describe(self, features: FeatureGaussians) -> GroupFeatures:
        """The Feature Gaussians as the networks see them."""
        return compute_group_features(features, self.members, self.cameras)

    def run(self, network: nn.Module, *inputs: Tensor) -> Tensor:
        """What one of the networks says: float32 on the CPU, wherever it runs; several outputs side by side."""
        device = next(network.parameters()).device
        with torch.autocast(device.type, torch.bfloat16, enabled=self.precision == "bfloat16"):
            found = network(*(one.to(device) for one in inputs))
        return (torch.cat(found, 1) if isinstance(found, tuple) else found).float().cpu()


def by_table(sizes: np.ndarray, most: int, columns: int, work: Work) -> Tensor:
    """``[g,columns]`` outputs of all groups; with gradients where they are wanted, then one table after the other."""
    found = list(tables(sizes, most))
    if torch.is_grad_enabled():
        parts = [work(rows, width) for rows, width in found]
    else:

        def quietly(table: tuple[np.ndarray, int]) -> Tensor:
            with torch.no_grad():  # threads of the pool do not know of the caller's
                return work(*table)

        parts = parallel_map(quietly, found)
    if not parts:
        return torch.zeros(0, columns)
    order = torch.from_numpy(np.concatenate([rows for rows, _ in found]))
    return torch.zeros(len(sizes), columns).index_copy(0, order, torch.cat(parts))


def encode_features(features: FeatureGaussians, context: NetworkContext) -> FeatureGaussians:
    """Feature Gaussians with latents, and with means that the encoder has moved (paper section 4.2).

    Args:
        features: g analytic Feature Gaussians.
        context: The networks and the scene.
    """
    group_features = context.describe(features)
    encoded = encoder_outputs(features, group_features, context)
    return with_encoding(features, group_features, encoded, context.networks)[0]


def encoder_outputs(features: FeatureGaussians, group_features: GroupFeatures, context: NetworkContext) -> Tensor:
    """``[g,latent+3]`` raw latents and shifts."""
    starts, ids = features.starts.numpy(), features.members.numpy()
    sizes, options = np.diff(starts), context.networks.options
    dice, axes = point_dice(features.means.numpy(), context.seed), _longest_axes(group_features.base)

    def work(rows: np.ndarray, width: int) -> Tensor:
        found, owners = runs(starts[rows], sizes[rows])
        away = context.members.means[ids[found]] - group_features.base.means.numpy()[rows[owners]]
        picked, mask = choose((away * axes[rows[owners]]).sum(1), sizes[rows], width, dice[rows])
        own = torch.from_numpy(np.repeat(rows, width))
        tokens = member_tokens(context.members, ids[found][picked.reshape(-1)], group_features, own)
        group = group_features.group[torch.from_numpy(rows)]
        return context.run(context.networks.encoder, tokens.unflatten(0, mask.shape), torch.from_numpy(mask), group)

    return by_table(sizes, options.members, options.latent + 3, work)


def _longest_axes(base: Gaussians) -> np.ndarray:
    """``[g,3]`` third axis of each Gaussian, whose scales rise: the last column of its rotation."""
    w, x, y, z = base.quats.numpy().T
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1)


def with_encoding(
    features: FeatureGaussians, group_features: GroupFeatures, encoded: Tensor, networks: Networks
) -> tuple[FeatureGaussians, Tensor]:
    """The Feature Gaussians with what the encoder says of them, and the corrections ``[g,13]``.

    Gradients flow through the latents and the corrections, never through the geometry.
    """
    shift = networks.options.bounds.mean * HALF * tanh_bounded(encoded[:, -3:])
    shift = torch.where(features.backing[:, None], 0, shift)
    residuals = torch.cat([shift, torch.zeros(len(features), RESIDUAL - 3)], 1)
    moved = move_features(features, group_features.base, residuals.detach(), group_features.frames)
    return replace(moved, latents=tanh_bounded(encoded[:, :-3])), residuals


def match_geometry(features: FeatureGaussians, context: NetworkContext) -> FeatureGaussians:
    """Feature Gaussians as the K = 1 head would decode them, for matching (paper section 4.3)."""
    if context.networks.options.outputs == "absolute":
        return features  # a head that begins at nothing says nothing of moments
    group_features = context.describe(features)
    residuals = head_residuals(group_features.base, np.arange(len(features)), features, group_features, context)
    return move_features(features, group_features.base, residuals, group_features.frames)


def merge_features(
    pooled: FeatureGaussians, parts: FeatureGaussians, order: np.ndarray, cuts: np.ndarray, context: NetworkContext
) -> FeatureGaussians:
    """Pooled Feature Gaussians with the merger's corrections (paper section 4.4).

    Args:
        pooled: One for each run of ``order``.
        parts: What was pooled.
        order: ``[n]`` rows of ``parts``, cluster by cluster.
        cuts: ``[c]`` where each cluster begins in ``order``.
        context: The networks and the scene.
    """
    group_features = context.describe(pooled)
    raw = merger_outputs(pooled, group_features, parts, order, cuts, context)
    return with_corrections(pooled, group_features, raw, context.networks)[0]


def merger_outputs(
    pooled: FeatureGaussians,
    group_features: GroupFeatures,
    parts: FeatureGaussians,
    order: np.ndarray,
    cuts: np.ndarray,
    context: NetworkContext,
) -> Tensor:
    """``[c,13+latent]`` raw corrections of clusters, see :func:`merge_features`."""
    base = feature_to_gaussians(parts)
    sizes, options = np.diff(np.append(cuts, len(order))), context.networks.options
    dice = point_dice(pooled.means.numpy(), context.seed)

    def work(rows: np.ndarray, width: int) -> Tensor:
        found, owners = runs(cuts[rows], sizes[rows])
        keys = ((base.means.numpy()[order[found]] - pooled.means.numpy()[rows[owners]]) ** 2).sum(1)
        picked, mask = choose(keys, sizes[rows], width, dice[rows])
        ids = torch.from_numpy(order[found][picked.reshape(-1)])
        beside = part_tokens(base[ids], group_features, torch.from_numpy(np.repeat(rows, width)))
        tokens = torch.cat([beside, parts.latents[ids]], 1).unflatten(0, mask.shape)
        group = group_features.group[torch.from_numpy(rows)]
        return context.run(context.networks.merger, tokens, torch.from_numpy(mask), group)

    return by_table(sizes, options.members, RESIDUAL + options.latent, work)


def refine_features(features: FeatureGaussians, context: NetworkContext) -> FeatureGaussians:
    """Feature Gaussians with what the refiner reads off their neighbours (paper section 4.5)."""
    if len(features) == 0:
        return features
    neighbors = nearest(features, context.networks.options.neighbors)
    group_features = context.describe(features)
    raw = refiner_outputs(features, group_features, neighbors, context)
    return with_corrections(features, group_features, raw, context.networks)[0]


def refiner_outputs(
    features: FeatureGaussians, group_features: GroupFeatures, neighbors: np.ndarray, context: NetworkContext
) -> Tensor:
    """``[g,13+latent]`` raw corrections from ``neighbors [g,k]``, -1 where there are fewer."""
    count, width = len(features), neighbors.shape[1] + 1
    table = np.concatenate([np.arange(count)[:, None], neighbors], 1)
    views = features.views

    def work(rows: np.ndarray, _: int) -> Tensor:
        ids, own = torch.from_numpy(table[rows].reshape(-1)), torch.from_numpy(np.repeat(rows, width))
        mask = ids >= 0
        ids = torch.where(mask, ids, own)
        beside = part_tokens(group_features.base[ids], group_features, own)
        same = (views[ids] == views[own]).float()[:, None]
        tokens = torch.cat([beside, same, features.latents[ids]], 1).unflatten(0, (len(rows), width))
        inside, group = mask.unflatten(0, (len(rows), width)), group_features.group[torch.from_numpy(rows)]
        return context.run(context.networks.refiner, tokens, inside, group)

    columns = RESIDUAL + context.networks.options.latent
    return by_table(np.full(count, width), 1 << (width - 1).bit_length(), columns, work)


def nearest(features: FeatureGaussians, count: int) -> np.ndarray:
    """``[g,k]`` int64 nearest Feature Gaussians of the same layer in 3D, itself left out; -1 where there are fewer."""
    from scipy.spatial import cKDTree  # late: a quarter of a second that the analytic path does not need

    means, found = features.means.double().numpy(), np.full((len(features), count), -1, np.int64)
    with use_threads() as threads:
        somewhere = np.isfinite(means).all(1)
        for layer in (features.backing.numpy(), ~features.backing.numpy()):
            rows = np.flatnonzero(layer & somewhere)
            if len(rows) < 2:
                continue
            near = min(count + 1, len(rows))
            _, ids = cKDTree(means[rows]).query(means[rows], k=near, workers=threads)
            itself = ids == np.arange(len(rows))[:, None]
            itself[~itself.any(1), -1] = True  # among many at one place
            found[rows, : near - 1] = rows[ids[~itself].reshape(len(rows), -1)]
    return found


def with_corrections(
    features: FeatureGaussians, group_features: GroupFeatures, raw: Tensor, networks: Networks
) -> tuple[FeatureGaussians, Tensor]:
    """Feature Gaussians with the raw corrections of merger or refiner, and the bounded ones ``[g,13]``.

    The backing layer stays as it is. Gradients flow through the latents and the corrections alone.
    """
    own = torch.where(features.backing[:, None], 0, raw)
    residuals = bounded(own[:, :RESIDUAL], networks.options.bounds, HALF)
    moved = move_features(features, group_features.base, residuals.detach(), group_features.frames)
    return replace(moved, latents=features.latents + tanh_bounded(own[:, RESIDUAL:])), residuals


def decode_gaussians(
    children: Gaussians, parents: np.ndarray, features: FeatureGaussians, context: NetworkContext
) -> Gaussians:
    """Children of Feature Gaussians with the corrections of the head for their number (paper section 4.3).

    Three children take three slots of the head for four; from five on they stay as they are.

    Args:
        children: Analytic Gaussians, those of one Feature Gaussian next to each other.
        parents: ``[n]`` the Feature Gaussian of each, rising.
        features: The Feature Gaussians.
        context: The networks and the scene.
    """
    return decode_with_group_features(children, parents, features, context.describe(features), context)


def decode_with_group_features(
    children: Gaussians,
    parents: np.ndarray,
    features: FeatureGaussians,
    group_features: GroupFeatures,
    context: NetworkContext,
) -> Gaussians:
    """:func:`decode_gaussians` of Feature Gaussians that are described already: no members are looked at."""
    children = head_starts(children, parents, features, group_features, context.networks)
    residuals = head_residuals(children, parents, features, group_features, context)
    return move_gaussians(children, residuals, group_features.frames[torch.from_numpy(parents)])


def head_starts(
    children: Gaussians,
    parents: np.ndarray,
    features: FeatureGaussians,
    group_features: GroupFeatures,
    networks: Networks,
) -> Gaussians:
    """What the heads correct: the children; for absolute outputs a round grey Gaussian in the place of each.

    It stands at its group's place, as large as the group, half transparent, with the axes of the group's frame. Those
    of the backing layer, and five or more of one parent, stay: no head looks at them.
    """
    if networks.options.outputs == "residual":
        return children
    sizes = np.bincount(parents, minlength=len(features))[parents]
    taken = torch.from_numpy((sizes <= SLOTS[-1]) & ~features.backing.numpy()[parents])
    own = torch.from_numpy(parents)
    place, size = group_features.base.means[own], group_features.sizes[own, None].expand(-1, 3)
    axes = rotmat_to_quat(group_features.frames.double())[own].to(children.quats)
    return replace(
        children,
        means=torch.where(taken[:, None], place, children.means),
        quats=torch.where(taken[:, None], axes, children.quats),
        scales=torch.where(taken[:, None], size, children.scales),
        opacities=torch.where(taken, 0.5, children.opacities),
        sh0=torch.where(taken[:, None, None], 0.0, children.sh0),
    )


def head_residuals(
    children: Gaussians,
    parents: np.ndarray,
    features: FeatureGaussians,
    group_features: GroupFeatures,
    context: NetworkContext,
) -> Tensor:
    """``[n,13]`` bounded corrections of children; zero for the backing layer and for five or more of one parent."""
    networks, count = context.networks, len(children)
    sizes = np.bincount(parents, minlength=len(features))
    first = np.cumsum(sizes) - sizes
    residuals = torch.zeros(count, RESIDUAL)
    for slots, fewest in zip(SLOTS, (1, 2, 3), strict=True):
        rows = np.flatnonzero((sizes >= fewest) & (sizes <= slots) & ~features.backing.numpy())
        if len(rows) == 0:
            continue
        places = np.arange(slots)[None]
        mask = places < sizes[rows, None]
        ids = first[rows, None] + np.where(mask, places, 0)
        raw = _head_outputs(slots, children, (rows, ids, mask), features, group_features, context)
        taken = torch.from_numpy(mask.reshape(-1))
        where = torch.from_numpy(ids.reshape(-1))[taken]
        residuals = residuals.index_copy(0, where, bounded(raw[taken], networks.options.head_bounds))
    return residuals


def _head_outputs(
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

    def work(rows: np.ndarray, _: int) -> Tensor:
        own = torch.from_numpy(parents[rows])
        picked = torch.from_numpy(ids[rows].reshape(-1))
        beside = part_tokens(children[picked], group_features, own.repeat_interleave(slots)).unflatten(
            0, (len(rows), slots)
        )
        known = features.latents[own], group_features.group[own]
        return context.run(head, *known, beside, torch.from_numpy(mask[rows])).flatten(1)

    return by_table(np.full(len(parents), slots), slots, slots * RESIDUAL, work).reshape(-1, RESIDUAL)
