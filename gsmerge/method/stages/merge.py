"""Feature Gaussians and matches -> Feature Gaussians: pool every cluster into one."""

from __future__ import annotations

import numpy as np

from gsmerge.arrays import Array, as_tensor, to_float32
from gsmerge.frozen import dataclass
from gsmerge.method.geometry.pooling import Members
from gsmerge.method.kernels.gaussians.pool import gather_groups
from gsmerge.method.networks.corrector import ANALYTIC, Corrector
from gsmerge.runtime.record import stage
from gsmerge.types import FeatureGaussians, Matches, Segmentation


@dataclass(frozen=True, eq=False)
class MergedViews:
    """Feature Gaussians after merging across views, with everything that decoding needs."""

    features: FeatureGaussians  # One for each cluster
    members: Members  # The scene's Gaussians, indexed by `features.members`
    segmentation: Segmentation  # The superpixels, and the number of Gaussians to make
    num_groups: int  # Number of superpixels with members, before merging
    networks: Corrector = ANALYTIC  # Networks that correct the decoded Gaussians


@stage("match")
def merge(features: FeatureGaussians, matches: Matches, networks: Corrector = ANALYTIC) -> FeatureGaussians:
    """Pool each cluster into one Feature Gaussian.

    Feature Gaussians that are alone in their cluster come first, unchanged. The parts of a cluster are weighted by
    their opacities times their gains. Masses and integrated optical depths are summed, so equal Gaussians on top of
    each other get the opacity 1 - prod(1 - alpha). Covariances are summed in float64 about the cluster's mean, so the
    order of the parts changes the result only by rounding.
    """
    alone, order, cuts = cluster_runs(matches)
    if len(order) == 0:
        return features
    pooled = networks.merge(pool_runs(features, order, cuts), features, order, cuts)
    return FeatureGaussians.concat([take_features(features, alone), pooled])


def cluster_runs(matches: Matches) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the rows that are alone in their cluster, and all other rows in the order of their clusters.

    Returns the rows that are alone, the other rows, and the position among the other rows where each cluster begins.
    """
    clusters = matches.clusters
    alone = np.bincount(clusters, minlength=matches.count)[clusters] == 1
    order = np.flatnonzero(~alone)
    order = order[np.argsort(clusters[order], kind="stable")]
    begins_cluster = np.ones(len(order), bool)
    begins_cluster[1:] = clusters[order][1:] != clusters[order][:-1]
    return np.flatnonzero(alone), order, np.flatnonzero(begins_cluster)


def take_features(features: FeatureGaussians, index: np.ndarray) -> FeatureGaussians:
    """Return the Feature Gaussians in the rows ``index``, with their members."""
    starts, members = gather_groups(features.starts, features.members, index)
    names = [n for n in features.__dataclass_fields__ if n not in ("starts", "members")]
    return FeatureGaussians(starts=starts, members=members, **{n: getattr(features, n)[index] for n in names})


def pool_runs(features: FeatureGaussians, order: np.ndarray, cuts: np.ndarray) -> FeatureGaussians:
    """Pool the Feature Gaussians of each cluster into one.

    The rows of a cluster are adjacent in ``order``, and ``cuts`` are the positions in ``order`` at which clusters
    begin.
    """

    def rows(array: np.ndarray) -> np.ndarray:
        """Return the values of an array in the order of the clusters."""
        return array[order].astype(np.float64)

    def total(values: np.ndarray) -> np.ndarray:
        """Return the sum of the values of each cluster."""
        return np.add.reduceat(values, cuts, axis=0)

    sizes = np.diff(np.append(cuts, len(order)))
    run = np.repeat(np.arange(len(cuts)), sizes)
    gains = rows(features.gains)
    extinctions = rows(features.extinctions)
    share = np.maximum(rows(features.weights) * gains, 1e-12)
    share /= total(share)[run]  # of each part in its cluster
    means = total(share[:, None] * rows(features.means))
    delta = rows(features.means) - means[run]
    covars = total(share[:, None, None] * (rows(features.covars) + delta[:, :, None] * delta[:, None]))
    optical_depths = total(extinctions)
    starts, members = gather_groups(features.starts, features.members, order)

    return FeatureGaussians(
        means=to_float32(means),
        covars=to_float32(covars),
        weights=to_float32(total(rows(features.weights))),
        masses=to_float32(total(rows(features.masses))),
        extinctions=to_float32(optical_depths),
        gains=to_float32(total(gains * extinctions) / np.maximum(optical_depths, 1e-30)),
        sh0=to_float32(total(share[:, None, None] * rows(features.sh0))),
        shN=to_float32(total(share[:, None, None] * rows(features.shN))),
        footprints=to_float32(total(share * rows(features.footprints))),
        views=np.full(len(cuts), -1),
        starts=np.append(starts[cuts], starts[-1]),
        members=members,
        latents=_pool_latents(features.latents[order], to_float32(share), run, len(cuts)),
    )


def _pool_latents(latents: Array, share: np.ndarray, run: np.ndarray, count: int) -> Array:
    """Return the sum ``[count,d]`` of the ``latents [m,d]`` of each cluster, weighted by ``share [m]``.

    ``run [m]`` are the clusters. If the latents are tensors, as in training, gradients pass through the sum.
    """
    if isinstance(latents, np.ndarray):
        sums = np.zeros((count, latents.shape[1]), np.float32)
        np.add.at(sums, run, latents * share[:, None])
        return sums
    import torch

    return torch.zeros(count, latents.shape[1]).index_add(0, as_tensor(run), latents * as_tensor(share)[:, None])
