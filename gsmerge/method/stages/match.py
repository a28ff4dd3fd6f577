"""Feature Gaussians -> matches: cluster Feature Gaussians of different views that show the same piece of surface."""

from __future__ import annotations

import numpy as np

from gsmerge.arrays import as_array, distinct
from gsmerge.method.geometry.transforms import normalize
from gsmerge.method.kernels.gaussians.cluster import connected_components, edge_scores, leader_clusters
from gsmerge.method.networks.cross_view_stats import nearest_of_other_views
from gsmerge.runtime.record import stage
from gsmerge.settings.stages import MatchOptions
from gsmerge.types import SH_C0, FeatureGaussians, Matches

UPPER_TRIANGLE = [0, 1, 2, 4, 5, 8]  # entries xx xy xz yy yz zz of a flattened 3 x 3 covariance


@stage("match")
def match(features: FeatureGaussians, options: MatchOptions) -> Matches:
    """Cluster Feature Gaussians of different views that show the same piece of surface.

    Each cluster grows from a leader. Leaders are chosen by weight, and by position if weights are equal, so the result
    does not depend on the order of the Feature Gaussians. Feature Gaussians that are fully transparent stay alone.
    """
    rows = np.flatnonzero(features.extinctions > 0)
    if options.match == "none" or len(rows) < 2 or len(distinct(features.views)) < 2:
        return Matches(np.arange(len(features)), len(features))
    means = features.means[rows].astype(np.float64)
    views = features.views[rows]
    covars = np.ascontiguousarray(features.covars[rows].astype(np.float64).reshape(-1, 9)[:, UPPER_TRIANGLE])
    colors = SH_C0 * features.sh0[rows, 0].astype(np.float64)
    neighbors = nearest_of_other_views(means, views, options.num_neighbors)
    boxes = options.match == "aabb"
    latents = as_array(features.latents)
    has_latents = boxes and bool(latents.any())  # an encoder makes them; otherwise colours are compared
    latents = normalize(latents[rows] if has_latents else np.zeros((len(rows), 0), latents.dtype))
    scores = np.empty(neighbors.shape)
    limits = options.max_color, options.similarity
    edge_scores(neighbors, means, covars, colors, latents, views, *limits, boxes, scores)  # fills `scores`
    clusters = np.full(len(features), -1, np.int64)
    if boxes:
        clusters[rows], num_clusters = connected_components(neighbors, scores, options.iou)
    else:
        order = np.lexsort((*means.T, -features.weights[rows]))
        max_size = options.cluster_size or len(distinct(views))
        clusters[rows], num_clusters = leader_clusters(order, neighbors, scores, views, options.overlap, max_size)
    alone = np.flatnonzero(clusters < 0)
    clusters[alone] = num_clusters + np.arange(len(alone))
    return Matches(clusters, num_clusters + len(alone))
