"""Overlap of neighbouring Gaussians, and clusters of those that overlap."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.jit import kernel


@kernel
def _det(a):
    """Determinant of a symmetric 3 x 3 given as xx xy xz yy yz zz."""
    return a[0] * (a[3] * a[5] - a[4] * a[4]) - a[1] * (a[1] * a[5] - a[4] * a[2]) + a[2] * (a[1] * a[4] - a[3] * a[2])


@kernel(part=True)
def bhattacharyya(mean_a, cov_a, mean_b, cov_b, half):
    """Bhattacharyya coefficient of two Gaussians, 1 for equal ones; covariances as xx xy xz yy yz zz."""
    for k in range(6):
        half[k] = 0.5 * (cov_a[k] + cov_b[k])
    det = _det(half)
    if det <= 0.0:
        return 0.0
    x, y, z = mean_b[0] - mean_a[0], mean_b[1] - mean_a[1], mean_b[2] - mean_a[2]
    # adjugate of the mean covariance
    xx, yy, zz = half[3] * half[5] - half[4] ** 2, half[0] * half[5] - half[2] ** 2, half[0] * half[3] - half[1] ** 2
    xy, xz = half[2] * half[4] - half[1] * half[5], half[1] * half[4] - half[2] * half[3]
    yz = half[1] * half[2] - half[0] * half[4]
    distance = (xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z)) / det
    volume = np.sqrt(max(_det(cov_a), 0.0)) * np.sqrt(max(_det(cov_b), 0.0))
    return np.exp(-0.125 * distance) * np.sqrt(volume / det)


@kernel(part=True)
def box_overlap(mean_a, cov_a, mean_b, cov_b):
    """Intersection over union of the axis-aligned boxes of one standard deviation (paper section 4.4)."""
    shared, volume_a, volume_b = 1.0, 1.0, 1.0
    for c in range(3):
        k = 0 if c == 0 else (3 if c == 1 else 5)
        a, b = np.sqrt(cov_a[k]), np.sqrt(cov_b[k])
        low, high = max(mean_a[c] - a, mean_b[c] - b), min(mean_a[c] + a, mean_b[c] + b)
        shared *= max(high - low, 0.0)
        volume_a *= 2 * a
        volume_b *= 2 * b
    union = volume_a + volume_b - shared
    return shared / union if union > 0 else 0.0


@kernel
def edge_scores(neighbors, means, covars, colors, latents, views, max_color, similarity, boxes, out):
    """Overlap of every Gaussian with each of its ``neighbors [g,k]`` (below 0: none) -> ``out [g,k]``.

    -1 where the two are of one view (views below 0 are of none), where the cosine of their ``latents [g,d]`` of length
    1 is below ``similarity``, or, where d is 0, their colours differ by more than ``max_color``.
    """
    half = np.empty(6)
    for i in range(neighbors.shape[0]):
        for k in range(neighbors.shape[1]):
            j = neighbors[i, k]
            out[i, k] = -1.0
            if j < 0 or (views[i] >= 0 and views[i] == views[j]):
                continue
            if latents.shape[1] > 0:
                cosine = 0.0
                for c in range(latents.shape[1]):
                    cosine += latents[i, c] * latents[j, c]
                if cosine < similarity:
                    continue
            else:
                difference = 0.0
                for c in range(3):
                    difference += (colors[i, c] - colors[j, c]) ** 2
                if difference > max_color * max_color:
                    continue
            if boxes:
                out[i, k] = box_overlap(means[i], covars[i], means[j], covars[j])
            else:
                out[i, k] = bhattacharyya(means[i], covars[i], means[j], covars[j], half)


@kernel
def leader_clusters(order, neighbors, scores, views, threshold, max_size):
    """Cluster Gaussians in stars: each in ``order`` that is still free leads its free neighbours that overlap enough.

    At most ``max_size`` to a cluster and one of each view, the best overlaps first; no member is reached through
    another, so clusters cannot chain. Returns the cluster of each Gaussian and the number of clusters.
    """
    clusters = np.empty(order.shape[0], np.int64)
    for i in range(clusters.shape[0]):
        clusters[i] = -1
    tried = np.empty(neighbors.shape[1], np.bool_)
    count = 0
    for leader in order:
        if clusters[leader] >= 0:
            continue
        clusters[leader] = count
        size = 1
        for i in range(tried.shape[0]):
            tried[i] = False
        while size < max_size:
            best = _best_left(scores[leader], tried, threshold)
            if best < 0:
                break
            tried[best] = True
            j = neighbors[leader, best]
            if clusters[j] < 0 and not _view_taken(neighbors[leader], clusters, count, views, views[j]):
                clusters[j] = count
                size += 1
        count += 1
    return clusters, count


@kernel
def _best_left(scores, tried, threshold):
    """Position of the best score that has not been tried and reaches the threshold, -1 if there is none."""
    best = -1
    for k in range(scores.shape[0]):
        if not tried[k] and scores[k] >= threshold and (best < 0 or scores[k] > scores[best]):
            best = k
    return best


@kernel
def _view_taken(candidates, clusters, cluster, views, view):
    """Return whether the cluster has a member of a view already; views below 0 are of none."""
    for j in candidates:
        if j >= 0 and view >= 0 and clusters[j] == cluster and views[j] == view:
            return True
    return False


@kernel
def _root(parents, i):
    while parents[i] != i:
        parents[i] = parents[parents[i]]
        i = parents[i]
    return i


@kernel
def connected_components(neighbors, scores, threshold):
    """Connected components of the edges that overlap enough (paper section 4.4) -> cluster of each, number."""
    n = neighbors.shape[0]
    parents = np.arange(n)
    for i in range(n):
        for k in range(neighbors.shape[1]):
            if scores[i, k] >= threshold:
                a, b = _root(parents, i), _root(parents, neighbors[i, k])
                parents[max(a, b)] = min(a, b)
    clusters = np.full(n, -1, np.int64)
    count = 0
    for i in range(n):
        r = _root(parents, i)
        if clusters[r] < 0:
            clusters[r] = count
            count += 1
        clusters[i] = clusters[r]
    return clusters, count
