"""Feature Gaussians -> matches: which of them, of different views, show the same piece of surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from gsmerge.geometry import normalize
from gsmerge.kernels.gaussians.cluster import connected_components, edge_scores, leader_clusters
from gsmerge.networks.cross_view_stats import nearest_of_other_views
from gsmerge.runtime.record import stage
from gsmerge.types import SH_C0, FeatureGaussians, Matches, as_array

if TYPE_CHECKING:
    from gsmerge.networks.apply import NetworkContext

Method = Literal["overlap", "aabb", "none"]
Geometry = Literal["analytic", "decoded"]

NEIGHBORS = {"overlap": 16, "aabb": 1}  # Nearest neighbours that are compared; docs/laboratory/notebook.md has figures


@dataclass(frozen=True)
class MatchOptions:
    """Conditions under which two Feature Gaussians are merged.

    Args:
        match: ``"overlap"``: Bhattacharyya coefficient (does not depend on the world's axes), similar colours, and
            star clusters that cannot chain. ``"aabb"``, as in the paper (section 4.4): box IoU, similar latents, and
            connected components. ``"none"``: no merging across views. None: ``"overlap"``, but ``"none"`` in a draft.
        geometry: Of what is compared where networks are loaded: ``"analytic"``, that of the moments, or ``"decoded"``,
            that of the K = 1 head (paper section 4.3), which merges less, takes longer and is no better.
        overlap: Least overlap of ``"overlap"``, 0 to 1.
        iou: Least IoU of the boxes of ``"aabb"``, 0 to 1 (tau_g).
        similarity: Least cosine of the latents of ``"aabb"``, -1 to 1 (tau_f). Without an encoder there are no
            latents, and colours are compared in their place.
        max_color: Largest difference of base colours (Euclidean, sRGB in [0, 1]).
        neighbors: Nearest neighbours of other views in 3D that are compared (k, which the paper leaves open); None: 16
            with ``"overlap"``, 1 with ``"aabb"``, whose components chain and leave holes with more.
        cluster_size: Most Feature Gaussians in a star cluster; None: as many as there are views (a cluster holds
            one of each view at most).

    Raises:
        ValueError: If a setting is unknown or out of range.
    """

    match: Method | None = None
    geometry: Geometry = "analytic"
    overlap: float = 0.7
    iou: float = 0.2
    similarity: float = 0.8
    max_color: float = 0.12
    neighbors: int | None = None
    cluster_size: int | None = None

    def __post_init__(self) -> None:
        if self.match not in (None, "overlap", "aabb", "none"):
            raise ValueError(f'match: expected "overlap", "aabb" or "none", got "{self.match}"')
        if self.geometry not in ("analytic", "decoded"):
            raise ValueError(f'geometry: expected "analytic" or "decoded", got "{self.geometry}"')
        for name, low in (("overlap", 0), ("iou", 0), ("similarity", -1)):
            if not low <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: expected {low} to 1, got {getattr(self, name)}")
        if not self.max_color >= 0:
            raise ValueError(f"max_color: expected at least 0, got {self.max_color}")
        if self.neighbors is not None and self.neighbors < 1:
            raise ValueError(f"neighbors: expected at least 1, got {self.neighbors}")
        if self.cluster_size is not None and self.cluster_size < 1:
            raise ValueError(f"cluster_size: expected at least 1, got {self.cluster_size}")

    @property
    def num_neighbors(self) -> int:
        """Nearest neighbours of other views that are compared."""
        return self.neighbors or NEIGHBORS["aabb" if self.match == "aabb" else "overlap"]


@stage("match")
def match(features: FeatureGaussians, options: MatchOptions, networks: NetworkContext | None = None) -> Matches:
    """Cluster Feature Gaussians of different views that show the same piece of surface.

    The result does not depend on the order of the Feature Gaussians: leaders are taken by weight,
    ties by position. Fully transparent Feature Gaussians stay alone.
    """
    if networks is not None and options.geometry == "decoded" and options.match != "none":
        from gsmerge.networks.apply import match_geometry

        features = match_geometry(features, networks)
    count = len(features)
    clusters = np.full(count, -1, np.int64)
    num_clusters = 0
    if options.match != "none" and len(np.unique(features.views)) > 1:
        solid = np.flatnonzero(features.extinctions > 0)
        if len(solid) > 1:
            clusters[solid], num_clusters = _clusters(features, solid, options)
    alone = np.flatnonzero(clusters < 0)
    clusters[alone] = num_clusters + np.arange(len(alone))
    return Matches(clusters, num_clusters + len(alone))


def _clusters(features: FeatureGaussians, rows: np.ndarray, options: MatchOptions) -> tuple[np.ndarray, int]:
    """Return the cluster of each of some rows, and the number of clusters."""
    means, views = features.means[rows].astype(np.float64), features.views[rows]
    covars = features.covars[rows].astype(np.float64).reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
    colors = SH_C0 * features.sh0[rows, 0].astype(np.float64)
    neighbors = nearest_of_other_views(means, views, options.num_neighbors)
    boxes = options.match == "aabb"
    latents = as_array(features.latents)
    known = boxes and bool(latents.any())  # networks without an encoder leave them zero
    latents = normalize(latents[rows] if known else latents[rows, :0])
    scores = np.empty(neighbors.shape)
    limits = options.max_color, options.similarity
    edge_scores(neighbors, means, np.ascontiguousarray(covars), colors, latents, views, *limits, boxes, scores)
    if boxes:
        return connected_components(neighbors, scores, options.iou)
    order = np.lexsort((*means.T, -features.weights[rows]))
    size = options.cluster_size or len(np.unique(views))
    return leader_clusters(order, neighbors, scores, views, options.overlap, size)
