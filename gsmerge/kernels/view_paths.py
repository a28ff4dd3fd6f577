"""The cheapest path through the views of rows that go pixel by pixel, the views of one pixel side by side."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.jit import kernel

BACK = 200.0  # cost of a step that goes back, in pixels
FAR = 50.0  # cost of any longer step forward: a stretch that was dropped costs no more


@kernel
def _step_cost(before, view_before, after, view):
    """Cost of going from one (pixel, view) to another: pixels forward, little within a pixel, much for going back."""
    if after < 0 or before < 0:
        return BACK
    forward = after - before
    if forward < 0 or (forward == 0 and view <= view_before):
        return BACK
    return min(float(forward), FAR)


@kernel
def cheapest_views(pixels, came_from, views):
    """Find Viterbi's path through ``pixels [n,v]`` int32, the pixel of each row in each view, -1 outside it.

    Returns how many of its steps go back. Overwritten: ``views [n]`` int64, the view of each row; ``came_from [n,v]``
    int8, the best view of the row before.
    """
    n, num_views = pixels.shape
    cost, fresh = np.zeros(num_views), np.zeros(num_views)
    for v in range(num_views):
        cost[v] = 0.0 if pixels[0, v] >= 0 else BACK
    for i in range(1, n):
        for v in range(num_views):
            best, which = np.inf, 0
            for u in range(num_views):
                total = cost[u] + _step_cost(pixels[i - 1, u], u, pixels[i, v], v)
                if total < best:
                    best, which = total, u
            fresh[v] = best
            came_from[i, v] = which
        low = fresh.min()
        for v in range(num_views):
            cost[v] = fresh[v] - low
    views[n - 1] = np.argmin(cost)
    back = 0
    for i in range(n - 1, 0, -1):
        views[i - 1] = came_from[i, views[i]]
        if _step_cost(pixels[i - 1, views[i - 1]], views[i - 1], pixels[i, views[i]], views[i]) >= BACK:
            back += 1
    return back
