"""feature gaussians + matches -> feature gaussians: every cluster pooled into one, then in line with its neighbours."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsmerge.moments import Members
from gsmerge.networks import NetworkContext, merge_features, refine_features
from gsmerge.types import FeatureGaussians, Gaussians, Matches, Segmentation


@dataclass(frozen=True, eq=False)
class MergedViews:
    """Feature Gaussians merged across views, and what decoding them takes.

    Args:
        features: The Feature Gaussians.
        members: The scene's Gaussians that ``features.members`` points into.
        segmentation: The superpixels that they come from, and how many Gaussians they are to become.
        networks: Networks that correct; None: those are not used.
        choices: What the stages decided, for the report.
        k1_gaussians: What they become at K = 1, where that had to be known to choose them; None elsewhere.
        saliency: ``[v·h·w]`` corner response of every pixel, where K depends on it; None elsewhere.
    """

    features: FeatureGaussians
    members: Members
    segmentation: Segmentation
    networks: NetworkContext | None = None
    choices: Mapping[str, Any] = field(default_factory=dict)
    k1_gaussians: Gaussians | None = None
    saliency: np.ndarray | None = None


def merge(features: FeatureGaussians, matches: Matches, networks: NetworkContext | None = None) -> FeatureGaussians:
    """One Feature Gaussian per cluster; those that are alone pass unchanged.

    Members are weighted with their opacities times what the photos say of them (gains); masses and integrated
    optical depths add, so equal ones stacked on each other become 1 - prod(1 - alpha). Sums run in float64 about
    the cluster's own mean: the result does not depend on the order of the members beyond rounding.

    Args:
        features: g Feature Gaussians.
        matches: A cluster for each.
        networks: Networks whose merger corrects what is pooled; None: none does.

    Returns:
        ``matches.count`` Feature Gaussians: first those that are alone in their old order, then the merged ones.
    """
    alone, order, cuts = cluster_runs(matches)
    if len(order) == 0:
        return features
    pooled = pool_runs(features, order, cuts)
    if networks is not None:
        pooled = merge_features(pooled, features, order.numpy(), cuts, networks)
    return FeatureGaussians.concat([take(features, alone), pooled])


def refine(features: FeatureGaussians, networks: NetworkContext | None) -> FeatureGaussians:
    """Feature Gaussians with the refiner's corrections (paper section 4.5); as they are without networks.

    Args:
        features: Merged Feature Gaussians of all views.
        networks: Networks and the scene, or None.
    """
    return features if networks is None else refine_features(features, networks)


def cluster_runs(matches: Matches) -> tuple[Tensor, Tensor, np.ndarray]:
    """Rows that are alone in their cluster; the others cluster by cluster; where each cluster begins among them."""
    clusters = matches.clusters
    alone = torch.bincount(clusters, minlength=matches.count)[clusters] == 1
    order = torch.nonzero(~alone)[:, 0]
    order = order[torch.argsort(clusters[order], stable=True)]
    first = torch.ones(len(order), dtype=torch.bool)
    first[1:] = clusters[order][1:] != clusters[order][:-1]
    return torch.nonzero(alone)[:, 0], order, torch.nonzero(first)[:, 0].numpy()


def take(features: FeatureGaussians, index: Tensor) -> FeatureGaussians:
    """The Feature Gaussians that an integer ``index`` selects, with their members."""
    starts, members = _gather(features, index)
    names = [n for n in features.__dataclass_fields__ if n not in ("starts", "members")]
    return FeatureGaussians(starts=starts, members=members, **{n: getattr(features, n)[index] for n in names})


def _gather(features: FeatureGaussians, index: Tensor) -> tuple[Tensor, Tensor]:
    """Members of the indexed Feature Gaussians, one after the other: starts and rows."""
    begin, sizes = features.starts[index], (features.starts[1:] - features.starts[:-1])[index]
    starts = torch.cat([torch.zeros(1, dtype=torch.int64), sizes.cumsum(0)])
    offsets = torch.arange(int(starts[-1])) - starts[:-1].repeat_interleave(sizes)
    return starts, features.members[begin.repeat_interleave(sizes) + offsets]


def pool_runs(features: FeatureGaussians, order: Tensor, cuts: np.ndarray) -> FeatureGaussians:
    """One Feature Gaussian for each run of rows in ``order`` that begins at ``cuts``."""

    def rows(tensor: Tensor) -> np.ndarray:
        return tensor[order].double().numpy()

    def total(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(values, cuts, axis=0)

    sizes = np.diff(np.append(cuts, len(order)))
    run = np.repeat(np.arange(len(cuts)), sizes)
    gains, extinctions = rows(features.gains), rows(features.extinctions)
    share = np.maximum(rows(features.weights) * gains, 1e-12)
    share /= total(share)[run]
    means = total(share[:, None] * rows(features.means))
    delta = rows(features.means) - means[run]
    covars = total(share[:, None, None] * (rows(features.covars) + delta[:, :, None] * delta[:, None]))
    summed = total(extinctions)
    starts, members = _gather(features, order)

    latents = features.latents[order] * torch.from_numpy(share).float()[:, None]  # in torch: gradients pass

    def single(values: np.ndarray) -> Tensor:
        return torch.from_numpy(values).float()

    return FeatureGaussians(
        means=single(means),
        covars=single(covars),
        weights=single(total(rows(features.weights))),
        masses=single(total(rows(features.masses))),
        extinctions=single(summed),
        gains=single(total(gains * extinctions) / np.maximum(summed, 1e-30)),
        spreads=single(np.maximum.reduceat(rows(features.spreads), cuts)),
        sh0=single(total(share[:, None, None] * rows(features.sh0))),
        shN=single(total(share[:, None, None] * rows(features.shN))),
        footprints=single(total(share * rows(features.footprints))),
        views=torch.full((len(cuts),), -1),
        backing=features.backing[order][torch.from_numpy(cuts)],
        starts=torch.cat([starts[torch.from_numpy(cuts)], starts[-1:]]),
        members=members,
        latents=torch.zeros(len(cuts), latents.shape[1]).index_add(0, torch.from_numpy(run), latents),
    )
