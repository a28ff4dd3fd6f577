"""Pixels of incomplete files that go pixel by pixel, the views of one pixel side by side."""

from __future__ import annotations

import numpy as np

from gsmerge.io.alignment.layouts import Layout
from gsmerge.io.alignment.projected_rows import MIN_BLOCK, ProjectedRows
from gsmerge.kernels.jit import kernel

BACK = 200.0  # cost of a step that goes back, in pixels
FAR = 50.0  # cost of any longer step forward: a stretch that was dropped costs no more
MAX_BACK = 0.01  # share of the steps that may go back; of rows in no such order a quarter or more do
MIN_CHANGES = 0.3  # share of the steps that change the view: fewer are views one after the other
PROBES, PROBE = 5, 4000  # pieces of a file that are tried first, and the rows of each
MAX_VIEWS = 127  # that an int8 can count
MAX_CELLS = 300_000_000  # rows times views that are worth the memory


def interleaved_layout(rows: ProjectedRows) -> Layout | None:
    """Which pixel of which view every row is, if its mean lies inside its pixel.

    Every row lies in some pixel of every view. In the order of the file the true ones can only go forward: pixel by
    pixel, within a pixel view by view. The path through the views that goes forward in the smallest steps wins; None if
    none goes forward, or hardly any step changes the view.
    """
    count, views = len(rows), rows.num_views
    if not 1 < views <= MAX_VIEWS or count < MIN_BLOCK * views or count * views > MAX_CELLS:
        return None
    if count > PROBES * PROBE:  # a few pieces quickly show the many files that have no such order
        starts = np.linspace(0, count - PROBE, PROBES).astype(int)
        if not all(_best_path(_pixels_in_views(rows, slice(start, start + PROBE)))[1] for start in starts):
            return None
    pixels = _pixels_in_views(rows, slice(None))
    chosen, goes_forward = _best_path(pixels)
    if not goes_forward:
        return None
    own_pixel = pixels[np.arange(count), chosen]
    parts = []
    for view in range(views):
        own = np.flatnonzero((chosen == view) & (own_pixel >= 0))
        first = np.unique(own_pixel[own], return_index=True)[1]  # a step back may come to a pixel twice
        own = own[np.sort(first)]
        parts.append((view, own, own_pixel[own].astype(np.int64)))
    if min(len(own) for _, own, _ in parts) < MIN_BLOCK:
        return None
    return rows.layout("view-fastest", parts, missing=views * rows.width * rows.height - count)


def _best_path(pixels: np.ndarray) -> tuple[np.ndarray, bool]:
    """The best view ``[n]`` of every row, and whether its pixels then only go forward, from view to view."""
    chosen = np.empty(len(pixels), np.int64)
    back = cheapest_views(pixels, np.zeros(pixels.shape, np.int8), chosen)
    return chosen, bool(back <= MAX_BACK * len(pixels) and np.mean(chosen[1:] != chosen[:-1]) >= MIN_CHANGES)


def _pixels_in_views(rows: ProjectedRows, some: slice) -> np.ndarray:
    """``[r,c]`` int32 pixel that each of some rows lies in, in each view; -1 outside."""
    return np.stack([rows.pixels(some, view)[0] for view in range(rows.num_views)], 1)


@kernel
def _step_cost(before, view_before, after, view):
    """Of going from one (pixel, view) to another: pixels forward, little within a pixel, much for going back."""
    if after < 0 or before < 0:
        return BACK
    forward = after - before
    if forward < 0 or (forward == 0 and view <= view_before):
        return BACK
    return min(float(forward), FAR)


@kernel
def cheapest_views(pixels, came_from, views):
    """Viterbi's path through ``pixels [n,v]`` int32, the pixel of each row in each view, -1 outside it.

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
