"""Split the members of every group into children, by repeated bisection across the widest direction."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.jit import kernel

NUM_FEATURES = 6
COLOR = 0.28209479177387814  # from a spherical harmonic of degree 0 to rgb
PIXEL = 0.012  # one pixel of distance counts as much as this difference of colour


@kernel
def _axis(members, features, weights, mean, axis):
    """Weighted mean and principal axis of some members in feature space -> their weighted scatter along it."""
    total = 0.0
    mean[:] = 0.0
    for i in members:
        total += weights[i]
        for c in range(NUM_FEATURES):
            mean[c] += weights[i] * features[i, c]
    mean /= total
    scatter = np.zeros((NUM_FEATURES, NUM_FEATURES))
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
def _split(order, count, features, weights, cuts):
    """Cut ``order`` (local member ids) into at most ``count`` runs, bounded by ``cuts`` -> number of runs."""
    spread = np.zeros(count)
    mean, axis = np.empty((count, NUM_FEATURES)), np.empty((count, NUM_FEATURES))
    cuts[0], cuts[1] = 0, order.shape[0]
    runs = 1
    spread[0] = _axis(order, features, weights, mean[0], axis[0])
    while runs < count:
        widest = np.argmax(spread[:runs])
        if spread[widest] <= 1e-12:
            break
        start, end = cuts[widest], cuts[widest + 1]
        cut = start + _partition(order[start:end], features, mean[widest], axis[widest])
        if cut in (start, end):
            spread[widest] = 0.0
            continue
        for r in range(runs, widest, -1):
            cuts[r + 1] = cuts[r]
            spread[r], mean[r], axis[r] = spread[r - 1], mean[r - 1], axis[r - 1]
        cuts[widest + 1] = cut
        runs += 1
        for r in (widest, widest + 1):
            spread[r] = _axis(order[cuts[r] : cuts[r + 1]], features, weights, mean[r], axis[r])
    return runs


@kernel
def bisect(starts, ids, means, sh, opacities, centres, footprints, num_children):
    """Children of every group: the run of members with the largest spread is halved until there are ``num_children``.

    A member's features are its colour and its position about ``centres [g,3]`` in units of ``footprints [g]``.
    Groups of identical members give fewer children, and children nest: those of 2 are unions of those of 4.

    Returns ``child_starts [m+1]`` into the returned ``child_ids``, and ``parents [m]``.
    """
    num_groups = starts.shape[0] - 1
    first = starts[0]
    child_ids = ids[first : starts[num_groups]].copy()
    child_starts = np.empty(num_groups * num_children + 1, np.int64)
    parents = np.empty(num_groups * num_children, np.int64)
    longest = 0
    for g in range(num_groups):
        longest = max(longest, starts[g + 1] - starts[g])
    features, weights = np.empty((longest, NUM_FEATURES)), np.empty(longest)
    order, cuts = np.empty(longest, np.int64), np.empty(num_children + 2, np.int64)
    m = 0
    for g in range(num_groups):
        n = starts[g + 1] - starts[g]
        scale = PIXEL / footprints[g]
        for j in range(n):
            i = ids[starts[g] + j]
            order[j] = j
            weights[j] = max(opacities[i], 1e-3)
            for c in range(3):
                features[j, c] = COLOR * sh[i, 0, c]
                features[j, 3 + c] = scale * (means[i, c] - centres[g, c])
        runs = _split(order[:n], num_children, features, weights, cuts)
        for j in range(n):
            child_ids[starts[g] - first + j] = ids[starts[g] + order[j]]
        for r in range(runs):
            child_starts[m] = starts[g] - first + cuts[r]
            parents[m] = g
            m += 1
    child_starts[m] = starts[num_groups] - first
    return child_starts[: m + 1].copy(), child_ids, parents[:m].copy()
