"""Split the members of every group into children, by repeated bisection across the widest direction."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.jit import kernel

NUM_FEATURES = 6
COLOR = 0.28209479177387814  # from a spherical harmonic of degree 0 to rgb
PIXEL = 0.012  # one pixel of distance counts as much as this difference of colour


@kernel
def _axis(members, features, weights, mean, axis, scatter):
    """Weighted mean, scatter and principal axis of some members in feature space -> their scatter along it."""
    total = 0.0
    mean[:] = 0.0
    scatter[:] = 0.0
    for i in members:
        total += weights[i]
        for c in range(NUM_FEATURES):
            mean[c] += weights[i] * features[i, c]
    mean /= total
    product = np.empty(NUM_FEATURES)
    for i in members:
        for c in range(NUM_FEATURES):
            w = weights[i] * (features[i, c] - mean[c])
            for d in range(c + 1):
                scatter[c, d] += w * (features[i, d] - mean[d])
    widest = 0
    for c in range(NUM_FEATURES):
        for d in range(c):
            scatter[d, c] = scatter[c, d]
        if scatter[c, c] > scatter[widest, widest]:
            widest = c
    axis[:] = scatter[widest]
    length = 0.0
    for _ in range(7):  # power iteration; a rough axis is enough to cut across
        length = 0.0
        for c in range(NUM_FEATURES):
            length += axis[c] * axis[c]
        length = np.sqrt(length)
        if length <= 1e-30:
            return 0.0
        for c in range(NUM_FEATURES):
            axis[c] /= length
        for c in range(NUM_FEATURES):
            product[c] = 0.0
            for d in range(NUM_FEATURES):
                product[c] += scatter[c, d] * axis[d]
        axis[:] = product
    length = 0.0
    for c in range(NUM_FEATURES):
        length += axis[c] * axis[c]
    return np.sqrt(length)


@kernel
def _partition(members, features, mean, axis):
    """Order members by the side of the mean that they lie on -> size of the first side."""
    low, high = 0, members.shape[0]
    for i in members.copy():
        t = 0.0
        for c in range(NUM_FEATURES):
            t += (features[i, c] - mean[c]) * axis[c]
        if t <= 0.0:
            members[low] = i
            low += 1
        else:
            high -= 1
            members[high] = i
    return low


@kernel
def _thickness(scatter):
    """Smallest eigenvalue of the scatter of the positions: squared distances from their plane."""
    a, b, c = scatter[3, 3], scatter[4, 4], scatter[5, 5]
    d, e, f = scatter[4, 3], scatter[5, 3], scatter[5, 4]
    middle = (a + b + c) / 3.0
    a, b, c = a - middle, b - middle, c - middle
    p = np.sqrt((a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) / 6.0)
    if p <= 1e-30:
        return max(middle, 0.0)
    half = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)) / (2.0 * p * p * p)
    angle = np.arccos(min(max(half, -1.0), 1.0)) / 3.0
    return max(middle + 2.0 * p * np.cos(angle + 2.0943951023931953), 0.0)  # 2 pi / 3


@kernel
def _error(members, weights, scatter, plane_weight):
    """Squared error of colour and, weighted, of the distance from a plane, as if every member weighed one."""
    total = 0.0
    for i in members:
        total += weights[i]
    colour = scatter[0, 0] + scatter[1, 1] + scatter[2, 2]
    return members.shape[0] / total * (colour + plane_weight * _thickness(scatter))


@kernel
def _split(order, count, features, weights, cuts, errors, plane_weight):
    """Cut ``order`` (local member ids) into at most ``count`` runs, bounded by ``cuts`` -> number of runs.

    ``errors[r - 1]`` becomes the summed error of the first r runs found, if there is room for it.
    """
    spread, error, measured = np.zeros(count), np.zeros(count), errors.shape[0] > 0
    mean, axis = np.empty((count, NUM_FEATURES)), np.empty((count, NUM_FEATURES))
    scatter = np.empty((NUM_FEATURES, NUM_FEATURES))
    cuts[0], cuts[1] = 0, order.shape[0]
    runs = 1
    spread[0] = _axis(order, features, weights, mean[0], axis[0], scatter)
    if measured:
        error[0] = errors[0] = _error(order, weights, scatter, plane_weight)
    while runs < count:
        widest = 0
        for run in range(1, runs):
            widest = run if spread[run] > spread[widest] else widest
        if spread[widest] <= 1e-12:
            break
        start, end = cuts[widest], cuts[widest + 1]
        cut = start + _partition(order[start:end], features, mean[widest], axis[widest])
        if cut in (start, end):
            spread[widest] = 0.0
            continue
        for r in range(runs, widest, -1):
            cuts[r + 1] = cuts[r]
            spread[r], mean[r], axis[r], error[r] = spread[r - 1], mean[r - 1], axis[r - 1], error[r - 1]
        cuts[widest + 1] = cut
        runs += 1
        for r in (widest, widest + 1):
            run = order[cuts[r] : cuts[r + 1]]
            spread[r] = _axis(run, features, weights, mean[r], axis[r], scatter)
            if measured:
                error[r] = _error(run, weights, scatter, plane_weight)
        if measured:
            errors[runs - 1] = error[:runs].sum()
    return runs


@kernel
def _fill_features(own, means, sh0, opacities, centre, footprint, features, weights, order):
    """Features and weights of the members of one group, and their places in it."""
    scale = PIXEL / footprint
    for j in range(own.shape[0]):
        i = own[j]
        order[j] = j
        weights[j] = max(opacities[i], 1e-3)
        for c in range(3):
            features[j, c] = COLOR * sh0[i, 0, c]
            features[j, 3 + c] = scale * (means[i, c] - centre[c])


@kernel
def _bisect(starts, ids, means, sh0, opacities, centres, footprints, counts, errors, plane_weight):
    """Children of every group, at most ``counts [g]`` of them, and their ``errors [g, any]``."""
    num_groups = starts.shape[0] - 1
    first, longest, most = starts[0], 0, 1
    child_ids = ids[first : starts[num_groups]].copy()
    child_starts = np.empty(counts.sum() + 1, np.int64)
    parents = np.empty(counts.sum(), np.int64)
    for g in range(num_groups):
        longest, most = max(longest, starts[g + 1] - starts[g]), max(most, counts[g])
    features, weights = np.empty((longest, NUM_FEATURES)), np.empty(longest)
    order, cuts = np.empty(longest, np.int64), np.empty(most + 2, np.int64)
    m = 0
    for g in range(num_groups):
        own = ids[starts[g] : starts[g + 1]]
        n = own.shape[0]
        _fill_features(own, means, sh0, opacities, centres[g], footprints[g], features, weights, order)
        runs = _split(order[:n], counts[g], features, weights, cuts, errors[g], plane_weight)
        for j in range(n):
            child_ids[starts[g] - first + j] = own[order[j]]
        for r in range(runs):
            child_starts[m] = starts[g] - first + cuts[r]
            parents[m] = g
            m += 1
    child_starts[m] = starts[num_groups] - first
    return child_starts[: m + 1].copy(), child_ids, parents[:m].copy()


def gather_groups(starts, ids, rows):
    """Members of the groups ``rows``, one after the other: starts and ids of their own."""
    sizes = starts[rows + 1] - starts[rows]
    local = np.concatenate([[0], np.cumsum(sizes)])
    return local, ids[np.repeat(starts[rows] - local[:-1], sizes) + np.arange(local[-1])]


def bisect(starts, ids, means, sh0, opacities, centres, footprints, num_children):
    """Children of every group: the run of members with the largest spread is halved until there are ``num_children``.

    A member's features are its colour and its position about ``centres [g,3]`` in units of ``footprints [g]``.
    Groups of identical members give fewer children, and children nest: those of 2 are unions of those of 4.
    ``num_children`` is one number or ``[g]``, at least 1.

    Returns ``child_starts [m+1]`` into the returned ``child_ids``, and ``parents [m]``.
    """
    num_groups = len(starts) - 1
    counts = np.array(np.broadcast_to(num_children, num_groups), np.int64)
    return _bisect(starts, ids, means, sh0, opacities, centres, footprints, counts, np.empty((num_groups, 0)), 0.0)


def split_errors(starts, ids, means, sh0, opacities, centres, footprints, max_children, plane_weight):
    """``[g,max_children]`` squared error of every group with 1, 2, ... children, NaN beyond what its members give.

    Children as in :func:`bisect`. A member's error is its squared distance from the child's mean colour, plus that
    from the plane fitted to the child times ``plane_weight``, in features; members weigh one on average, opaque
    ones more.
    """
    num_groups = len(starts) - 1
    counts, errors = np.full(num_groups, max_children, np.int64), np.full((num_groups, max_children), np.nan)
    _bisect(starts, ids, means, sh0, opacities, centres, footprints, counts, errors, plane_weight)
    return errors
