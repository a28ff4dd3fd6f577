"""Predictions of all networks for crops of examples, with gradients: the sum of the corrections of all stages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsmerge.networks.apply import NetworkContext, prepare_children, run_encoder, run_heads, run_merger, run_refiner
from gsmerge.networks.corrections import MEAN
from gsmerge.networks.modules import Networks
from gsmerge.networks.tensors import move_tensors, rotate_vectors
from gsmerge.networks.tokens import GroupFeatures
from gsmerge.research.training.targets import corrections_between
from gsmerge.research.training.train_options import TrainOptions
from gsmerge.research.training.windows import Crop
from gsmerge.stages.decode import divide
from gsmerge.stages.match import match
from gsmerge.stages.merge import cluster_runs, merge, pool_runs, take
from gsmerge.types import FeatureGaussians, Gaussians, Matches, as_tensor


@dataclass(frozen=True, eq=False)
class Prediction:
    """A crop's children, corrected by the networks."""

    gaussians: Gaussians  # n corrected children, tensors with gradients
    parents: Tensor  # [n] int64, the merged Feature Gaussian of each, ascending
    merged: FeatureGaussians  # the crop's, merged and refined
    corrections: Tensor  # [n,13] of all stages together, from the analytic children as the targets
    matched: float  # share of the crop's Feature Gaussians that were merged with others


def predict(crop: Crop, networks: Networks, options: TrainOptions, seed: int) -> Prediction:
    """Run a crop through all networks.

    Each stage reads the results of those before it; gradients go through the latents and the corrections. At K = 1 the
    corrections of all stages add up; the children of a larger K are pooled again from the members, so the stages before
    their head reach them through the latent alone.

    The Gaussians of K = 1 are the results of the stages, one after the other; their gradient is that of the sum.
    """
    example = crop.example
    context = NetworkContext(networks, example.members, example.cameras, seed)
    parts = take(example.features, crop.rows)
    group_features = context.describe(parts)
    encoded, shifts = run_encoder(group_features, context)
    matches = match_crop(crop, encoded, options, context)
    merged, before = _merged(encoded, group_features, as_tensor(shifts), matches, context)
    refined, residuals = run_refiner(context.describe(merged), context)
    group_features = context.describe(refined)
    children, parents = divide(refined, example.members, np.full(len(refined), crop.k))
    children = prepare_children(children, parents, group_features, networks.options)
    heads = as_tensor(run_heads(children, parents, group_features, context))
    before = before + as_tensor(residuals) if crop.k == 1 else torch.zeros_like(heads)
    last = heads + (before - before.detach())  # adds the gradient of earlier corrections, which the base has already
    frames = torch.from_numpy(group_features.frames[parents])
    gaussians, corrections = move_tensors(children.to("cpu"), last, frames), before + heads
    if example.targets and networks.options.outputs == "absolute":
        analytic, _ = divide(merge(parts, matches), example.members, np.full(len(refined), crop.k))
        corrections = corrections_between(analytic.to("cpu"), gaussians, frames)
    sizes = np.bincount(matches.clusters, minlength=matches.count)
    matched = float(sizes[sizes > 1].sum()) / max(1, len(matches.clusters))
    return Prediction(gaussians, torch.from_numpy(parents), refined, corrections, matched)


def analytic_gaussians(crop: Crop, options: TrainOptions) -> Gaussians:
    """Decode a crop's children without networks."""
    parts = take(crop.example.features, crop.rows)
    merged = merge(parts, match_crop(crop, parts, options))
    return divide(merged, crop.example.members, np.full(len(merged), crop.k))[0]


def match_crop(
    crop: Crop, parts: FeatureGaussians, options: TrainOptions, context: NetworkContext | None = None
) -> Matches:
    """Match the r Feature Gaussians ``parts`` of a crop, unless its clusters were fitted and so are known."""
    known = crop.example.matches
    if known is not None:
        ids, local = np.unique(known.clusters[crop.rows], return_inverse=True)
        return Matches(local, len(ids))
    with torch.no_grad():
        return match(parts, options.match_options(), context)


def crop_targets(crop: Crop) -> tuple[Tensor, Tensor]:
    """Return the fit's corrections of a crop's children, ``[n,13]``, and a mask ``[n]`` of those that count."""
    matches = crop.example.matches
    assert matches is not None
    rows, targets = merged_rows(matches), crop.example.targets[crop.k]
    inside, inner = np.zeros((2, matches.count), bool)
    inside[rows[crop.rows]], inner[rows[crop.rows[crop.inner]]] = True, True
    own = np.flatnonzero(inside[targets.parents])
    scored = targets.mask[own] & inner[targets.parents[own]]
    return torch.from_numpy(targets.corrections[own]), torch.from_numpy(scored)


def merged_rows(matches: Matches) -> np.ndarray:
    """Find the row after merging of every Feature Gaussian before merging, ``[g]``."""
    alone, order, cuts = cluster_runs(matches)
    rows = np.empty(len(matches.clusters), np.int64)
    rows[alone] = np.arange(len(alone))
    first = np.zeros(len(order), np.int64)
    first[cuts] = 1
    rows[order] = len(alone) + first.cumsum() - 1
    return rows


def _merged(
    parts: FeatureGaussians, group_features: GroupFeatures, shifts: Tensor, matches: Matches, context: NetworkContext
) -> tuple[FeatureGaussians, Tensor]:
    """Merge Feature Gaussians, and return them with the corrections of each by encoder and merger."""
    alone, order, cuts = cluster_runs(matches)
    if len(order) == 0:
        return parts, shifts
    pooled = pool_runs(parts, order, cuts)
    of_pooled = context.describe(pooled)
    frames, sizes = torch.from_numpy(group_features.frames), torch.from_numpy(group_features.sizes)
    moved = rotate_vectors(frames, shifts[:, MEAN] * sizes[:, None])[order]
    run = torch.from_numpy(np.repeat(np.arange(len(cuts)), np.diff(np.append(cuts, len(order)))))
    weights = torch.from_numpy(parts.weights[order])
    share = weights / torch.zeros(len(cuts)).index_add(0, run, weights)[run].clamp_min(1e-12)
    world = torch.zeros(len(cuts), 3).index_add(0, run, share[:, None] * moved)
    back, sizes = torch.from_numpy(of_pooled.frames).transpose(1, 2), torch.from_numpy(of_pooled.sizes)
    local = rotate_vectors(back, world) / sizes[:, None]
    pooled, raw = run_merger(of_pooled, parts, order, cuts, context)
    residuals = as_tensor(raw)
    from_encoder = torch.cat([local, torch.zeros(len(cuts), residuals.shape[1] - 3)], 1)
    merged = FeatureGaussians.concat([take(parts, alone), pooled])
    return merged, torch.cat([shifts[alone], residuals + from_encoder])
