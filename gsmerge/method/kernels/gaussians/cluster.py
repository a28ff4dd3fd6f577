"""Measure the overlap of neighbouring Gaussians, and cluster Gaussians that overlap."""

from __future__ import annotations

import numpy as np

from gsmerge.method.kernels.signature import STATUS, declare, f4, f8, i4, i8, native


@native(f8(), mean_a=f8(3), cov_a=f8(6), mean_b=f8(3), cov_b=f8(6))
def bhattacharyya(mean_a, cov_a, mean_b, cov_b):
    """Return the Bhattacharyya coefficient of two Gaussians, from 0 to 1 for equal ones.

    Covariances are given as xx xy xz yy yz zz.
    """


@native(f8(), mean_a=f8(3), cov_a=f8(6), mean_b=f8(3), cov_b=f8(6))
def box_overlap(mean_a, cov_a, mean_b, cov_b):
    """Return the intersection over union of the boxes of two Gaussians (paper section 4.4).

    A box is aligned with the axes. On each axis it reaches from one standard deviation below the mean to one above.
    """


@native(
    STATUS, neighbors=i8("g", "k"), means=f8("g", 3), covars=f8("g", 6), colors=f8("g", 3), latents=f4("g", "d"),
    views=i8("g"), max_color=f8(), similarity=f8(), boxes=i4(), out=f8("g", "k", out=True),
)  # fmt: skip
def edge_scores(neighbors, means, covars, colors, latents, views, max_color, similarity, boxes, out):
    """Write the overlap of every Gaussian with each of its neighbours.

    The overlaps are the weights of the edges of a graph, in which Gaussians are clustered.

    Args:
        neighbors: ``[g,k]`` int64 rows of neighbours, below 0 where there is none.
        covars: ``[g,6]`` float64, as xx xy xz yy yz zz.
        colors: ``[g,3]`` float64 base colours.
        latents: ``[g,d]`` float32, each of length 1, or with d = 0.
        views: ``[g]`` int64, below 0 for Gaussians of no view.
        max_color: Largest difference of the colours of similar Gaussians, if there are no latents.
        similarity: Least cosine of the latents of similar Gaussians.
        boxes: 1 to measure overlap by :func:`box_overlap`, 0 to measure it by :func:`bhattacharyya`.
        out: ``[g,k]`` float64, written: overlaps with similar neighbours of other views, and -1 for all others.
    """


_find_stars = declare(
    "find_stars", STATUS, neighbors=i8("n", "k"), scores=f8("n", "k"), views=i8("n"), order=i8("m", least=0, below="n"),
    threshold=f8(), max_size=i8(), left=f8("k", out=True), clusters=i8("n", out=True), num_clusters=i8(1, out=True),
)  # fmt: skip


def leader_clusters(order, neighbors, scores, views, threshold, max_size):
    """Cluster Gaussians around leaders, so that all Gaussians of a cluster overlap with its leader.

    The Gaussians are visited in a given order, and each one that is in no cluster yet becomes a leader. Neighbours that
    overlap enough and are in no cluster join the leader, the largest overlap first, at most one from each view. Returns
    the cluster ``[n]`` int64 of each Gaussian and the number of clusters.

    Args:
        order: ``[n]`` int64 rows of all Gaussians.
        neighbors: ``[n,k]`` int64 rows of neighbours, below 0 where there is none.
        scores: ``[n,k]`` float64 overlaps with the neighbours.
        views: ``[n]`` int64, below 0 for Gaussians of no view.
        threshold: Least overlap.
        max_size: Largest number of Gaussians in a cluster, with the leader.
    """
    n, k = neighbors.shape
    clusters = np.empty(n, np.int64)
    count = np.zeros(1, np.int64)
    _find_stars(neighbors, scores, views, order, threshold, max_size, np.empty(k), clusters, count)
    return clusters, int(count[0])


_find_components = declare(
    "find_components", STATUS, neighbors=i8("n", "k"), scores=f8("n", "k"), threshold=f8(), parents=i8("n", out=True),
    clusters=i8("n", out=True), num_clusters=i8(1, out=True),
)  # fmt: skip


def connected_components(neighbors, scores, threshold):
    """Cluster Gaussians by the connected components of a graph whose edges are overlaps (paper section 4.4).

    A Gaussian and its neighbour are connected if their score is at least ``threshold``. ``neighbors`` and ``scores``
    are as in :func:`leader_clusters`. Returns the cluster ``[n]`` int64 of each Gaussian and the number of clusters.
    """
    parents, clusters = np.empty((2, len(neighbors)), np.int64)
    count = np.zeros(1, np.int64)
    _find_components(neighbors, scores, threshold, parents, clusters, count)
    return clusters, int(count[0])
