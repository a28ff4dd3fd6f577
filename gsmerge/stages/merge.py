"""Feature Gaussians and matches -> Feature Gaussians: every cluster pooled into one, then refined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmerge.geometry.pooling import Members
from gsmerge.networks.corrector import ANALYTIC, Corrector
from gsmerge.runtime.record import stage
from gsmerge.types import FeatureGaussians, Matches, Segmentation
from gsmerge.values.arrays import Array, as_tensor, to_float32


@dataclass(frozen=True, eq=False)
class MergedViews:
    """Feature Gaussians merged across views, with everything that decoding needs."""

    features: FeatureGaussians  # The Feature Gaussians
    members: Members  # The scene's Gaussians, indexed by `features.members`
    segmentation: Segmentation  # The superpixels, and the number of Gaussians to make
    num_groups: int  # Superpixels with Gaussians, before merging
    networks: Corrector = ANALYTIC  # Corrections of the decoded Gaussians


@stage("match")
def merge(features: FeatureGaussians, matches: Matches, networks: Corrector = ANALYTIC) -> FeatureGaussians:
    """Pool each cluster into one Feature Gaussian; clusters of one come first, unchanged.

    Members are weighted by their opacities times their gains. Masses and integrated optical depths are summed, so equal
    Gaussians on top of each other get the opacity 1 - prod(1 - alpha). Covariances are summed in float64 about the
    cluster's mean, so the order of the members changes the result only by rounding.
    """
    alone, order, cuts = cluster_runs(matches)
    if len(order) == 0:
        return features
    pooled = networks.merge(pool_runs(features, order, cuts), features, order, cuts)
    return FeatureGaussians.concat([take_features(features, alone), pooled])


def cluster_runs(matches: Matches) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rows that are alone in their cluster, the other rows by cluster, and the starts of these clusters."""
    clusters = matches.clusters
    alone = np.bincount(clusters, minlength=matches.count)[clusters] == 1
    order = np.flatnonzero(~alone)
    order = order[np.argsort(clusters[order], kind="stable")]
    begins_cluster = np.ones(len(order), bool)
    begins_cluster[1:] = clusters[order][1:] != clusters[order][:-1]
    return np.flatnonzero(alone), order, np.flatnonzero(begins_cluster)


def take_features(features: FeatureGaussians, index: np.ndarray) -> FeatureGaussians:
    """Select Feature Gaussians by an integer ``index``, with their members."""
    starts, members = _gather(features, index)
    names = [n for n in features.__dataclass_fields__ if n not in ("starts", "members")]
    return FeatureGaussians(starts=starts, members=members, **{n: getattr(features, n)[index] for n in names})


def _gather(features: FeatureGaussians, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the members of the indexed Feature Gaussians, as starts and rows."""
    begin, sizes = features.starts[index], np.diff(features.starts)[index]
    starts = np.concatenate([np.zeros(1, np.int64), sizes.cumsum()])
    positions = (begin - starts[:-1]).astype(np.int32).repeat(sizes)  # in the members of all Feature Gaussians
    positions += np.arange(starts[-1], dtype=np.int32)
    return starts, features.members[positions]


def pool_runs(features: FeatureGaussians, order: np.ndarray, cuts: np.ndarray) -> FeatureGaussians:
    """Pool each run of rows in ``order`` into one Feature Gaussian; runs start at ``cuts``."""

    def rows(array: np.ndarray) -> np.ndarray:
        return array[order].astype(np.float64)

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

    return FeatureGaussians(
        means=to_float32(means),
        covars=to_float32(covars),
        weights=to_float32(total(rows(features.weights))),
        masses=to_float32(total(rows(features.masses))),
        extinctions=to_float32(summed),
        gains=to_float32(total(gains * extinctions) / np.maximum(summed, 1e-30)),
        sh0=to_float32(total(share[:, None, None] * rows(features.sh0))),
        shN=to_float32(total(share[:, None, None] * rows(features.shN))),
        footprints=to_float32(total(share * rows(features.footprints))),
        views=np.full(len(cuts), -1),
        starts=np.append(starts[cuts], starts[-1]),
        members=members,
        latents=_pool_latents(features.latents[order], to_float32(share), run, len(cuts)),
    )


def _pool_latents(latents: Array, share: np.ndarray, run: np.ndarray, count: int) -> Array:
    """Return weighted sums ``[count,d]`` of latents ``[m,d]`` over runs; differentiable for tensors."""
    if isinstance(latents, np.ndarray):
        sums = np.zeros((count, latents.shape[1]), np.float32)
        np.add.at(sums, run, latents * share[:, None])
        return sums
    import torch

    return torch.zeros(count, latents.shape[1]).index_add(0, as_tensor(run), latents * as_tensor(share)[:, None])
