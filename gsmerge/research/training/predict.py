"""Predict with all networks for crops of examples, with gradients through every stage.

The geometry of the stages is computed on tensors here, so that gradients pass from the results of a stage to the
results of earlier stages. The formulas are those of the kernels that the stages use
(:mod:`gsmerge.method.networks.tokens`, :mod:`gsmerge.method.geometry.pooling`,
:mod:`gsmerge.method.networks.corrections`). Choices have no gradient: members, neighbours, clusters, order of axes,
views, and the agreement of a group with other views. A value that is "zero, with a gradient" is added to results of
kernels: this addition gives the results a gradient, and does not change their values.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsmerge.arrays import Array, as_array, as_tensor
from gsmerge.frozen import dataclass, replace
from gsmerge.method.geometry.pooling import MAX_OPACITY, Members, principal_axes
from gsmerge.method.networks.apply import NetworkContext, prepare_children, run_heads
from gsmerge.method.networks.corrections import (
    COLOR_COLUMNS,
    LOGIT_COLUMN,
    MASS_COLUMN,
    MEAN_COLUMNS,
    ROTATION_COLUMNS,
    SIZE_COLUMNS,
)
from gsmerge.method.networks.cross_view_stats import NUM_STATS
from gsmerge.method.networks.options import CORRECTED, PART_COLUMNS
from gsmerge.method.networks.tensors import (
    gaussian_sizes,
    move_tensors,
    quat_to_rotmat,
    rotate_quats,
    rotate_vectors,
    skew_vectors,
)
from gsmerge.method.networks.tokens import GroupFeatures
from gsmerge.method.stages.decode import divide_groups
from gsmerge.method.stages.match import match
from gsmerge.method.stages.merge import cluster_runs, merge, pool_runs, take_features
from gsmerge.research.training.modules import Networks
from gsmerge.research.training.train_options import TrainOptions
from gsmerge.research.training.windows import Crop
from gsmerge.types import SH_C0, FeatureGaussians, Gaussians, Matches

TINY = 1e-12  # least length whose logarithm is taken, world units
CONSTANT = slice(6, 8)  # columns of ``group`` without a gradient: log of the number of members, and their mean weight


def features_to_tensors(features: FeatureGaussians) -> FeatureGaussians:
    """Convert the columns of Feature Gaussians that networks change to tensors."""
    columns: dict[str, Array] = {name: as_tensor(getattr(features, name)) for name in CORRECTED}
    return replace(features, **columns)


def features_to_arrays(features: FeatureGaussians) -> FeatureGaussians:
    """Convert the columns of Feature Gaussians that are tensors to arrays, without gradients."""
    return replace(features, **{name: as_array(getattr(features, name)) for name in CORRECTED})


def groups_to_arrays(groups: GroupFeatures) -> GroupFeatures:
    """Convert the networks' inputs to arrays, without gradients."""
    numbers = {name: as_array(getattr(groups, name)) for name in ("frames", "sizes", "group")}
    return replace(groups, features=features_to_arrays(groups.features), base=groups.base.numpy(), **numbers)


def differentiate_axes(covars: Tensor) -> tuple[Tensor, Tensor]:
    """Compute scales ``[g,3]``, ascending, and quaternions ``[g,4]`` of covariances ``[g,3,3]``, differentiable.

    Values are those of :func:`gsmerge.method.geometry.pooling.principal_axes`. Gradients follow from first-order
    perturbation theory. Axes of nearly equal scales have no clear direction, so the gradient of their rotation is
    damped.
    """
    scales, quats = (torch.from_numpy(axes).float() for axes in principal_axes(as_array(covars)))
    if not covars.requires_grad:
        return scales, quats
    axes = quat_to_rotmat(quats)
    change = axes.transpose(1, 2) @ (covars - covars.detach()) @ axes  # zero, with a gradient
    squares = scales.square()
    gaps = squares[:, None] - squares[:, :, None]  # [i,j]: square of j minus that of i
    min_gap = 1e-3  # least difference of two squared scales in the gradient of axes, over the largest squared scale
    least = (min_gap * squares[:, 2])[:, None, None]
    spins = change * gaps / (gaps.square() + least.square()).clamp_min(1e-37)
    grown = scales + change.diagonal(dim1=1, dim2=2) / (2 * scales)
    return grown, rotate_quats(rotate_vectors(axes, skew_vectors(spins)), quats)


def differentiate_base(features: FeatureGaussians) -> Gaussians:
    """Decode Feature Gaussians like :func:`gsmerge.method.geometry.pooling.feature_to_gaussians`, differentiable."""
    scales, quats = differentiate_axes(features.covars)
    depths = features.extinctions * as_tensor(features.gains) / (scales[:, 1] * scales[:, 2])
    opacities = (1 - torch.exp(-depths)).clamp(0, MAX_OPACITY)
    return Gaussians(
        features.means, quats=quats, scales=scales, opacities=opacities, sh0=features.sh0, shN=as_tensor(features.shN)
    )


def differentiate_groups(features: FeatureGaussians, inputs: GroupFeatures, viewmats: np.ndarray) -> GroupFeatures:
    """Compute the networks' inputs for Feature Gaussians as tensors, so that a loss can be differentiated by them.

    ``inputs`` are the arrays that the kernels made: views, footprints and statistics are taken from them.
    """
    group_viewmats = torch.from_numpy(viewmats[inputs.views]).float()
    base = differentiate_base(features)
    frames = torch.from_numpy(inputs.frames)
    if features.means.requires_grad:
        # A frame depends on the group's mean and on its view. It has no gradient if the ray to the mean is parallel to
        # the image's right axis
        centres = -rotate_vectors(group_viewmats[:, :3, :3].transpose(1, 2), group_viewmats[:, :3, 3])
        away = normalize(features.means - centres, dim=1)
        across = group_viewmats[:, 0, :3] - (group_viewmats[:, 0, :3] * away).sum(1, keepdim=True) * away
        right = normalize(across, dim=1)
        computed = torch.stack([right, torch.linalg.cross(away, right), away], 2)
        is_stable = (across.norm(dim=1) > 1e-3)[:, None, None]
        frames = torch.where(is_stable, frames + computed - computed.detach(), frames)  # adds zero, with a gradient
    sizes = gaussian_sizes(base.scales).clamp_min(TINY)
    pixels = torch.from_numpy(inputs.footprints).clamp_min(TINY)
    covars = frames.transpose(1, 2) @ features.covars @ frames / sizes.square()[:, None, None]
    positions = rotate_vectors(group_viewmats[:, :3, :3], features.means) + group_viewmats[:, :3, 3]
    numbers = [
        _log_scales(base.scales, pixels),
        _logits(base.opacities)[:, None],
        _log_ratio(features.masses, pixels**3)[:, None],
        _log_ratio(features.extinctions, pixels**2)[:, None],
        torch.from_numpy(inputs.group[:, CONSTANT]),
        SH_C0 * features.sh0[:, 0],
        torch.asinh(torch.stack([covars[:, i, j] for i in range(3) for j in range(i, 3)], 1)),
        (positions[:, :2] / positions[:, 2:].clamp_min(1e-6)).clamp(-3, 3),
    ]
    group = torch.cat([torch.cat(numbers, 1).nan_to_num(), torch.from_numpy(inputs.group[:, -NUM_STATS:])], 1)
    return replace(inputs, features=features, base=base, frames=frames, sizes=sizes, group=group)


def differentiate_tokens(
    parts: Gaussians, ids: np.ndarray, owners: np.ndarray, group_features: GroupFeatures
) -> Tensor:
    """Describe Gaussians relative to their groups by tokens ``[n,13]``, as tensors with a gradient.

    The function and its arguments are those of :func:`gsmerge.method.networks.tokens.part_tokens`.
    """
    g = group_features
    owner_ids = torch.from_numpy(owners)
    selected = parts[torch.from_numpy(ids)]
    to_frames = g.frames[owner_ids].transpose(1, 2)
    pixels = torch.from_numpy(g.footprints)[owner_ids].clamp_min(TINY)
    offsets = rotate_vectors(to_frames, selected.means - g.base.means[owner_ids]) / g.sizes[owner_ids, None]
    ascending_scales = selected.scales.sort(-1).values.clamp_min(TINY)
    shortest = selected.scales.argmin(1)[:, None, None].expand(-1, 3, 1)
    normals = rotate_vectors(to_frames, quat_to_rotmat(selected.quats).gather(2, shortest)[..., 0])
    flatness = 1 - ascending_scales[:, 0] / ascending_scales[:, 1]
    towards_view = -flatness * normals[:, 2].sign()
    colors = SH_C0 * (selected.sh0 - g.base.sh0[owner_ids])[:, 0]
    numbers = [
        torch.asinh(offsets),
        _log_scales(ascending_scales, pixels),
        _logits(selected.opacities)[:, None],
        colors,
    ]
    tokens = torch.cat([*numbers, towards_view[:, None] * normals], 1)
    assert tokens.shape[1] == PART_COLUMNS
    return tokens.nan_to_num()


def _log_scales(scales: Tensor, pixels: Tensor) -> Tensor:
    """Make inputs of networks from scales ``[n,3]``: logarithms in units of ``pixels [n]``, clipped and scaled down."""
    return torch.log(scales.clamp_min(TINY) / pixels[:, None]).clamp(-12, 12) / 4


def _logits(opacities: Tensor) -> Tensor:
    """Make inputs of networks from opacities ``[n]``: logits, clipped and scaled down."""
    return torch.logit(opacities.clamp(1e-4, 1 - 1e-4)) / 3


def _log_ratio(values: Tensor, units: Tensor) -> Tensor:
    """Make inputs of networks from masses or extinctions ``[g]``: logarithms in ``units [g]``, clipped, scaled down."""
    return (torch.log(values.clamp_min(1e-30)) - torch.log(units)).clamp(-30, 30) / 10


def pool_tensors(features: FeatureGaussians, order: np.ndarray, cuts: np.ndarray) -> FeatureGaussians:
    """Pool each cluster of Feature Gaussians into one, as tensors with a gradient.

    The rows of the clusters are ``order``, cluster after cluster. ``cuts`` are the places in ``order`` where clusters
    begin. Values are those of :func:`gsmerge.method.stages.merge.pool_runs`.
    """
    pooled = pool_runs(features_to_arrays(features), order, cuts)
    clusters = torch.from_numpy(np.repeat(np.arange(len(cuts)), np.diff(np.append(cuts, len(order)))))
    weights = torch.from_numpy(np.maximum(features.weights[order].astype(np.float64) * features.gains[order], 1e-12))
    share = (weights / torch.zeros(len(cuts), dtype=torch.float64).index_add(0, clusters, weights)[clusters]).float()

    def total(values: Tensor) -> Tensor:
        """Sum over the rows of each cluster."""
        return torch.zeros(len(cuts), *values.shape[1:]).index_add(0, clusters, values)

    def average(values: Tensor) -> Tensor:
        """Average over the rows of each cluster, weighted by ``share``."""
        return total(values * share.reshape(-1, *[1] * (values.ndim - 1)))

    means = average(features.means[order])
    offsets = features.means[order] - means[clusters]
    spread = features.covars[order] + offsets[:, :, None] * offsets[:, None]
    columns: dict[str, Array] = {"means": means, "covars": average(spread), "sh0": average(features.sh0[order])}
    columns |= {name: total(getattr(features, name)[order]) for name in ("masses", "extinctions")}
    return replace(pooled, **columns, latents=average(features.latents[order]))


class TrainingContext(NetworkContext):
    """Networks and their inputs for training: the stages' formulas on tensors, with gradients."""

    def make_base(self, features: FeatureGaussians) -> Gaussians:
        """Return for each Feature Gaussian the Gaussian with the same moments, as tensors."""
        return differentiate_base(features)

    def describe(self, features: FeatureGaussians) -> GroupFeatures:
        """Compute the networks' inputs as tensors."""
        inputs = super().describe(features_to_arrays(features))
        return differentiate_groups(features, inputs, np.asarray(self.cameras.viewmats))

    def make_tokens(
        self, parts: Gaussians | Members, ids: np.ndarray, owners: np.ndarray, group_features: GroupFeatures
    ) -> Array:
        """Make tokens.

        Tokens of Gaussians are tensors, but tokens of members are arrays, since no network changes members. The
        arguments are those of :func:`gsmerge.method.networks.tokens.part_tokens`.
        """
        if isinstance(parts, Gaussians):
            return differentiate_tokens(parts, ids, owners, group_features)
        return super().make_tokens(parts, ids, owners, groups_to_arrays(group_features))

    def correct_features(self, group_features: GroupFeatures, residuals: Array) -> FeatureGaussians:
        """Apply corrections ``residuals [g,14]`` to Feature Gaussians, as tensors with a gradient.

        The corrections are those of :func:`gsmerge.method.networks.corrections.move_features`.
        """
        g = group_features
        f = group_features.features
        # Rotations of the rotation vectors (Rodrigues), also differentiable at zero
        vectors = rotate_vectors(g.frames, residuals[:, ROTATION_COLUMNS])
        x, y, z = vectors.unbind(1)
        zero = torch.zeros_like(x)
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
        angles = (vectors.square().sum(1) + 1e-12).sqrt()[:, None, None]
        rotations = torch.eye(3) + torch.sin(angles) / angles * cross
        rotations = rotations + (1 - torch.cos(angles)) / angles**2 * cross @ cross
        axes = quat_to_rotmat(g.base.quats)
        log_stretches = residuals[:, SIZE_COLUMNS]
        stretches = torch.eye(3) + (axes * torch.expm1(log_stretches)[:, None]) @ axes.transpose(1, 2)
        changes = rotations @ stretches
        covars = changes @ f.covars @ changes.transpose(1, 2)
        log_areas = log_stretches[:, 1] + log_stretches[:, 2]  # change of the area of the two largest scales
        return replace(
            f,
            means=f.means
            + rotate_vectors(g.frames, residuals[:, MEAN_COLUMNS] * gaussian_sizes(g.base.scales)[:, None]),
            covars=(covars + covars.transpose(1, 2)) / 2,
            masses=f.masses
            * torch.exp(residuals[:, LOGIT_COLUMN] + log_stretches[:, 0] + log_areas + residuals[:, MASS_COLUMN]),
            extinctions=f.extinctions * torch.exp(residuals[:, LOGIT_COLUMN] + log_areas),
            sh0=f.sh0 + residuals[:, None, COLOR_COLUMNS] / SH_C0,
        )

    def decode_covars(self, features: FeatureGaussians) -> Array:
        """Decode each Feature Gaussian into one child; return the children's covariances, tensors with a gradient."""
        g = self.correct_children(None, np.arange(len(features)), self.describe(features))
        half = quat_to_rotmat(g.quats) * g.scales[:, None]
        return half @ half.transpose(1, 2)

    def correct_children(
        self, children: Gaussians | None, parents: np.ndarray, group_features: GroupFeatures
    ) -> Gaussians:
        """Correct the children of groups by the heads. If ``children`` is None, the heads get round Gaussians.

        Heads whose outputs are "absolute" make children by correcting round Gaussians.
        """
        if children is None:
            arrays = groups_to_arrays(group_features)
            parent_ids = torch.from_numpy(parents)
            round_gaussians = prepare_children(arrays.base[parents], parents, arrays, self.options).to("cpu")
            frames = group_features.frames[parent_ids]
            base = group_features.base
            rotations = (frames - frames.detach()) @ frames.detach().transpose(1, 2)  # zero, with a gradient
            children = replace(
                round_gaussians,
                means=base.means[parent_ids],
                quats=rotate_quats(skew_vectors(rotations), round_gaussians.quats),
                scales=group_features.sizes[parent_ids, None].expand(-1, 3),
                sh0=base.sh0[parent_ids],
            )
        corrections = as_tensor(run_heads(children, parents, group_features, self))
        return move_tensors(children, corrections, group_features.frames[torch.from_numpy(parents)])


@dataclass(frozen=True, eq=False)
class Prediction:
    """What the networks make of a crop."""

    gaussians: Gaussians  # n corrected children, tensors with a gradient
    parents: Tensor  # [n] int64 merged Feature Gaussian of each child, ascending
    merged: FeatureGaussians  # Feature Gaussians of the crop, merged and refined, without gradients
    sizes: Tensor  # [n] size of each child's group, world units
    matched: float  # share of the crop's Feature Gaussians that were merged with others


@dataclass(frozen=True, eq=False)
class RefinedCrop:
    """The merged and refined Feature Gaussians of a crop, which do not depend on K."""

    context: TrainingContext
    described: GroupFeatures  # these Feature Gaussians as inputs of the heads, tensors with a gradient
    matches: Matches  # the crop's clusters


def refine_crop(crop: Crop, networks: Networks, options: TrainOptions, seed: int) -> RefinedCrop:
    """Run encoder, merger and refiner on a crop, one after the other, with gradients."""
    example = crop.example
    context = TrainingContext(networks, example.members, example.cameras, seed)
    encoded = context.encode(features_to_tensors(take_features(example.features, crop.rows)))
    encoded = replace(encoded, latents=as_tensor(encoded.latents))  # without an encoder they are an array of zeros
    matches = match(features_to_arrays(encoded), options.match_options())
    alone, order, cuts = cluster_runs(matches)
    merged = encoded
    if len(order) > 0:  # as in gsmerge.method.stages.merge.merge, but tensors with a gradient
        pooled = context.merge(pool_tensors(encoded, order, cuts), encoded, order, cuts)
        merged = FeatureGaussians.concat([take_features(encoded, alone), pooled])
    refined = context.refine(merged)
    return RefinedCrop(context, context.describe(refined), matches)


def decode_crop(refined: RefinedCrop, crop: Crop, k: int) -> Prediction:
    """Decode every Feature Gaussian of a crop into ``k`` children, and correct them by the heads, with gradients.

    If ``k`` is more than 1, the closed formulas make the children from the members, without a gradient. Earlier stages
    then get gradients only through the inputs of the heads. Heads with "absolute" outputs make the children themselves.
    """
    described = refined.described
    context = refined.context
    arrays = features_to_arrays(described.features)
    children: Gaussians | None = None
    parents = np.repeat(np.arange(len(arrays)), k)
    if not context.makes_children and k == 1:
        children = described.base
    elif not context.makes_children:
        divided, parents = divide_groups(arrays, crop.example.members, np.full(len(arrays), k))
        children = divided.to("cpu")
    gaussians = context.correct_children(children, parents, described)
    parent_ids = torch.from_numpy(parents)
    counts = np.bincount(refined.matches.clusters)
    matched = float(counts[counts > 1].sum()) / max(1, len(refined.matches.clusters))
    return Prediction(gaussians, parent_ids, arrays, described.sizes[parent_ids], matched)


def predict(crop: Crop, networks: Networks, options: TrainOptions, seed: int) -> Prediction:
    """Run all networks on a crop, with gradients."""
    return decode_crop(refine_crop(crop, networks, options, seed), crop, crop.k)


def analytic_gaussians(crop: Crop, options: TrainOptions) -> Gaussians:
    """Merge and decode a crop by closed formulas, without networks."""
    features = take_features(crop.example.features, crop.rows)
    merged = merge(features, match(features, options.match_options()))
    return divide_groups(merged, crop.example.members, np.full(len(merged), crop.k))[0]
