"""Crops of examples through all networks, with gradients: the sum of the corrections of all stages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsmerge.networks import NetworkContext, Networks
from gsmerge.networks.apply import (
    apply_corrections,
    apply_encoding,
    find_neighbors,
    prepare_children,
    run_encoder,
    run_heads,
    run_merger,
    run_refiner,
)
from gsmerge.networks.residuals import MEAN, move_gaussians, rotate_vectors
from gsmerge.networks.tokens import GroupFeatures
from gsmerge.research.training.examples import Example, corrections_between
from gsmerge.stages.merge import cluster_runs, pool_runs, take
from gsmerge.types import FeatureGaussians, Gaussians, Matches


@dataclass(frozen=True, eq=False)
class Crop:
    """Neighbouring Feature Gaussians of an example, with K children each."""

    example: Example
    k: int  # which of its levels
    rows: Tensor  # [r] ascending rows of its merged Feature Gaussians
    children: Tensor  # [n] ascending rows of the level's children
    scored: Tensor  # [n] bool, whether their targets count


def sample_crop(example: Example, count: int, inner: float, rng: np.random.Generator) -> Crop:
    """The ``count`` Feature Gaussians nearest to a random one, of which the share ``inner`` nearest to it is scored."""
    k = list(example.levels)[int(rng.integers(len(example.levels)))]
    level, centre = example.levels[k], example.centres[int(rng.integers(len(example.centres)))]
    distances = (example.centres - centre).square().sum(1)
    order = torch.argsort(distances, stable=True)[:count]
    inside, close = torch.zeros(2, len(distances), dtype=torch.bool)
    inside[order], close[order[: max(1, int(inner * len(order)))]] = True, True
    children = torch.nonzero(inside[level.parents])[:, 0]
    scored = close[level.parents[children]] & level.mask[children]
    return Crop(example, k, torch.nonzero(inside)[:, 0], children, scored)


def merged_rows(matches: Matches) -> Tensor:
    """``[g]`` row after merging of every Feature Gaussian before merging."""
    alone, order, cuts = cluster_runs(matches)
    rows = torch.empty(len(matches.clusters), dtype=torch.int64)
    rows[alone] = torch.arange(len(alone))
    first = torch.zeros(len(order), dtype=torch.int64)
    first[torch.from_numpy(cuts)] = 1
    rows[order] = len(alone) + first.cumsum(0) - 1
    return rows


@dataclass(frozen=True, eq=False)
class Prediction:
    """A crop's children, corrected by the networks."""

    corrections: Tensor  # [n,13] of all stages together, from the analytic children as the targets
    gaussians: Gaussians  # the corrected children, with gradients


def predict(crop: Crop, networks: Networks, seed: int) -> Prediction:
    """A crop through all networks.

    Each stage reads the results of those before it; gradients go through the latents and the corrections. At K = 1 the
    corrections of all stages add up; the children of a larger K are pooled again from the members, so the stages before
    their head reach them through the latent alone.

    The Gaussians of K = 1 are the results of the stages, one after the other; their gradient is that of the sum.
    """
    example = crop.example
    context = NetworkContext(networks, example.members, example.cameras, seed)
    owner = merged_rows(example.matches)
    parts = take(example.features, torch.nonzero(torch.isin(owner, crop.rows))[:, 0])
    local = torch.searchsorted(crop.rows, owner[torch.isin(owner, crop.rows)])
    group_features = context.describe(parts)
    parts, shifts = apply_encoding(parts, group_features, run_encoder(parts, group_features, context), networks)
    merged, corrections = _merged(parts, group_features, shifts, Matches(local, len(crop.rows)), context)
    group_features = context.describe(merged)
    raw = run_refiner(merged, group_features, find_neighbors(merged, networks.options.neighbors), context)
    refined, residuals = apply_corrections(merged, group_features, raw, networks)
    group_features = context.describe(refined)
    analytic = example.levels[crop.k].children[crop.children]
    parents = torch.searchsorted(crop.rows, example.levels[crop.k].parents[crop.children])
    frames, single = group_features.frames[parents], crop.k == 1
    children = group_features.base if single else analytic
    children = prepare_children(children, parents.numpy(), refined, group_features, networks)
    heads = run_heads(children, parents.numpy(), refined, group_features, context)
    before = corrections + residuals if single else torch.zeros_like(heads)
    last = heads + (before - before.detach())  # adds the gradient of earlier corrections, which the base has already
    gaussians = move_gaussians(children, last, frames)
    if networks.options.outputs == "absolute":
        return Prediction(corrections_between(analytic, gaussians, frames), gaussians)
    return Prediction(before + heads, gaussians)


def predict_corrections(crop: Crop, networks: Networks, seed: int) -> Tensor:
    """``[n,13]`` corrections of a crop's children by the networks, see :func:`predict`."""
    return predict(crop, networks, seed).corrections


def _merged(
    parts: FeatureGaussians, group_features: GroupFeatures, shifts: Tensor, matches: Matches, context: NetworkContext
) -> tuple[FeatureGaussians, Tensor]:
    """Merged Feature Gaussians, and the corrections of each by encoder and merger."""
    alone, order, cuts = cluster_runs(matches)
    if len(order) == 0:
        return parts, shifts
    pooled = pool_runs(parts, order, cuts)
    of_pooled = context.describe(pooled)
    moved = rotate_vectors(group_features.frames, shifts[:, MEAN] * group_features.sizes[:, None])[order]
    run = torch.from_numpy(np.repeat(np.arange(len(cuts)), np.diff(np.append(cuts, len(order)))))
    share = parts.weights[order] / torch.zeros(len(cuts)).index_add(0, run, parts.weights[order])[run].clamp_min(1e-12)
    world = torch.zeros(len(cuts), 3).index_add(0, run, share[:, None] * moved)
    local = rotate_vectors(of_pooled.frames.transpose(1, 2), world) / of_pooled.sizes[:, None]
    raw = run_merger(pooled, of_pooled, parts, order.numpy(), cuts, context)
    pooled, residuals = apply_corrections(pooled, of_pooled, raw, context.networks)
    from_encoder = torch.cat([local, torch.zeros(len(cuts), residuals.shape[1] - 3)], 1)
    merged = FeatureGaussians.concat([take(parts, alone), pooled])
    return merged, torch.cat([shifts[alone], residuals + from_encoder])
