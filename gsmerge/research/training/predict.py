"""Predictions of all networks for crops of examples, with gradients through every stage."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsmerge.moments import Members
from gsmerge.networks.apply import (
    NetworkContext,
    encode_features,
    merge_features,
    prepare_children,
    refine_features,
    run_heads,
)
from gsmerge.networks.tensors import move_tensors
from gsmerge.networks.tokens import GroupFeatures
from gsmerge.research.training.geometry import (
    differentiate_base,
    differentiate_groups,
    differentiate_tokens,
    features_to_arrays,
    features_to_tensors,
    groups_to_arrays,
    make_round_tensors,
    move_feature_tensors,
    pool_tensors,
)
from gsmerge.research.training.modules import Networks
from gsmerge.research.training.train_options import TrainOptions
from gsmerge.research.training.windows import Crop
from gsmerge.stages.decode import divide
from gsmerge.stages.match import match
from gsmerge.stages.merge import cluster_runs, merge, take
from gsmerge.types import Array, FeatureGaussians, Gaussians, Matches, as_tensor


class TrainingContext(NetworkContext):
    """The networks and their inputs, with the stages' formulas on tensors."""

    def make_base(self, features: FeatureGaussians) -> Gaussians:
        """Decode every Feature Gaussian into one Gaussian of tensors."""
        return differentiate_base(features)

    def describe(self, features: FeatureGaussians) -> GroupFeatures:
        """Compute the networks' inputs as tensors."""
        known = super().describe(features_to_arrays(features))
        return differentiate_groups(features, known, np.asarray(self.cameras.viewmats))

    def make_tokens(
        self, parts: Gaussians | Members, ids: np.ndarray, owners: np.ndarray, group_features: GroupFeatures
    ) -> Array:
        """Describe Gaussians as tensors; members as arrays, since no network comes before the encoder."""
        if isinstance(parts, Gaussians):
            return differentiate_tokens(parts, ids, owners, group_features)
        return super().make_tokens(parts, ids, owners, groups_to_arrays(group_features))

    def correct_features(self, group_features: GroupFeatures, residuals: Array) -> FeatureGaussians:
        """Apply corrections ``[g,14]`` to Feature Gaussians of tensors."""
        return move_feature_tensors(group_features, residuals)


@dataclass(frozen=True, eq=False)
class Prediction:
    """A crop's children, corrected by the networks."""

    gaussians: Gaussians  # n corrected children, tensors with gradients
    parents: Tensor  # [n] int64, the merged Feature Gaussian of each, ascending
    merged: FeatureGaussians  # the crop's, merged and refined, without gradients
    frames: Tensor  # [n,3,3] axes of each one's group as columns, world
    sizes: Tensor  # [n] size of each one's group, world units
    matches: Matches  # the crop's clusters
    matched: float  # share of the crop's Feature Gaussians that were merged with others


def predict(crop: Crop, networks: Networks, options: TrainOptions, seed: int) -> Prediction:
    """Run a crop through all networks; each stage reads the results of those before it, and passes gradients on.

    Analytic children of K > 1 are pooled again from the members, so earlier stages reach those of residual heads
    through what the heads read alone.
    """
    example = crop.example
    context = TrainingContext(networks, example.members, example.cameras, seed)
    encoded = encode_features(features_to_tensors(take(example.features, crop.rows)), context)
    encoded = replace(encoded, latents=as_tensor(encoded.latents))
    matches = match_crop(crop, features_to_arrays(encoded), options, networks, seed)
    refined = refine_features(_merge(encoded, matches, context), context)
    group_features, arrays = context.describe(refined), features_to_arrays(refined)
    children, parents = _make_children(crop, arrays, group_features, networks)
    corrections = as_tensor(run_heads(children, parents, group_features, context))
    own = torch.from_numpy(parents)
    frames, sizes = group_features.frames[own], group_features.sizes[own]
    gaussians = move_tensors(children, corrections, frames)
    counts = np.bincount(matches.clusters, minlength=matches.count)
    matched = float(counts[counts > 1].sum()) / max(1, len(matches.clusters))
    return Prediction(gaussians, own, arrays, frames, sizes, matches, matched)


def _merge(encoded: FeatureGaussians, matches: Matches, context: TrainingContext) -> FeatureGaussians:
    """Merge Feature Gaussians of tensors as :func:`gsmerge.stages.merge.merge` does."""
    alone, order, cuts = cluster_runs(matches)
    if len(order) == 0:
        return encoded
    pooled = merge_features(pool_tensors(encoded, order, cuts), encoded, order, cuts, context)
    return FeatureGaussians.concat([take(encoded, alone), pooled])


def _make_children(
    crop: Crop, arrays: FeatureGaussians, group_features: GroupFeatures, networks: Networks
) -> tuple[Gaussians, np.ndarray]:
    """Make the Gaussians that the heads correct, tensors, and the rising row ``[n]`` of the group of each."""
    if networks.options.outputs == "residual" and crop.k == 1:
        return group_features.base, np.arange(len(arrays))
    children, parents = divide(arrays, crop.example.members, np.full(len(arrays), crop.k))
    if networks.options.outputs == "residual":
        return children.to("cpu"), parents
    round_ones = prepare_children(children, parents, groups_to_arrays(group_features), networks.options)
    return make_round_tensors(parents, group_features, round_ones), parents


def analytic_gaussians(crop: Crop, matches: Matches) -> Gaussians:
    """Decode a crop's children without networks."""
    merged = merge(take(crop.example.features, crop.rows), matches)
    return divide(merged, crop.example.members, np.full(len(merged), crop.k))[0]


def match_crop(
    crop: Crop, parts: FeatureGaussians, options: TrainOptions, networks: Networks | None = None, seed: int = 0
) -> Matches:
    """Match the r Feature Gaussians ``parts`` of a crop, unless its clusters were fitted and so are known."""
    known = crop.example.matches
    if known is not None:
        ids, local = np.unique(known.clusters[crop.rows], return_inverse=True)
        return Matches(local, len(ids))
    example = crop.example
    context = None if networks is None else NetworkContext(networks, example.members, example.cameras, seed)
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
