"""feature gaussians -> matches: which Feature Gaussians of different views show the same piece of surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from gsmerge.kernels.cluster import connected_components, edge_scores, leader_clusters
from gsmerge.threads import available_threads
from gsmerge.types import SH_C0, FeatureGaussians, Matches

Method = Literal["overlap", "aabb", "none"]


@dataclass(frozen=True)
class MatchOptions:
    """When two Feature Gaussians are taken for one.

    Args:
        match: ``"overlap"``: Bhattacharyya coefficient (does not depend on the world's axes) and star clusters
            that cannot chain. ``"aabb"``: the paper's box IoU and connected components. ``"none"``: no merging
            across views.
        overlap: Least overlap, 0 to 1.
        max_color: Largest difference of base colours (Euclidean, sRGB in [0, 1]).
        neighbors: Nearest neighbours in 3D that are looked at, the own view's included.
        cluster_size: Most Feature Gaussians in a star cluster.

    Raises:
        ValueError: If a setting is unknown or out of range.
    """

    match: Method = "overlap"
    overlap: float = 0.7
    max_color: float = 0.12
    neighbors: int = 16
    cluster_size: int = 4

    def __post_init__(self) -> None:
        if self.match not in ("overlap", "aabb", "none"):
            raise ValueError(f'match: expected "overlap", "aabb" or "none", got "{self.match}"')
        if not 0 <= self.overlap <= 1:
            raise ValueError(f"overlap: expected 0 to 1, got {self.overlap}")
        for name in ("neighbors", "cluster_size"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")


def match(features: FeatureGaussians, options: MatchOptions) -> Matches:
    """Clusters of Feature Gaussians of different views.

    The backing layer is left alone. The result does not depend on the order of the Feature Gaussians: leaders are
    taken by weight, ties by position.
    """
    count = len(features)
    front = torch.nonzero(~features.backing)[:, 0].numpy()
    if options.match == "none" or len(front) < 2 or len(torch.unique(features.views)) < 2:
        return Matches(torch.arange(count), count)
    means = features.means.double().numpy()[front]
    views = features.views.numpy()[front]
    neighbors = _nearest(means, options.neighbors)
    covars = features.covars.double().numpy()[front].reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
    colors = SH_C0 * features.sh0[:, 0].double().numpy()[front]
    scores = np.empty(neighbors.shape)
    boxes = options.match == "aabb"
    edge_scores(neighbors, means, np.ascontiguousarray(covars), colors, views, options.max_color, boxes, scores)
    if boxes:
        found, num_found = connected_components(neighbors, scores, options.overlap)
    else:
        order = np.lexsort((*means.T, -features.weights.numpy()[front]))
        found, num_found = leader_clusters(order, neighbors, scores, views, options.overlap, options.cluster_size)
    clusters = np.empty(count, np.int64)
    clusters[front] = found
    backing = np.nonzero(features.backing.numpy())[0]
    clusters[backing] = num_found + np.arange(len(backing))
    return Matches(torch.from_numpy(clusters), num_found + len(backing))


def _nearest(means: np.ndarray, count: int) -> np.ndarray:
    """``[g,k]`` int64 nearest neighbours of each point, without itself; -1 where there are fewer."""
    from scipy.spatial import cKDTree  # late: a quarter of a second that --match none does not need

    k = min(count + 1, len(means))
    _, found = cKDTree(means).query(means, k=k, workers=min(2, available_threads()))
    found = found.astype(np.int64)
    found[found == np.arange(len(means))[:, None]] = -1
    return found
