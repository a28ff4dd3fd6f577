"""Pixels of files that dropped some and go pixel by pixel, the views of one pixel side by side."""

from __future__ import annotations

import numpy as np

from gsmerge.io.alignment.interleave_kernel import cheapest_views
from gsmerge.io.alignment.layouts import Layout
from gsmerge.io.alignment.pruned import MIN_BLOCK, projector

MAX_BACK = 0.01  # share of the steps that may go back; of rows in no such order a quarter or more do
MIN_CHANGES = 0.3  # share of the steps that change the view: fewer are views one after the other
PROBES, PROBE = 5, 4000  # pieces of a file that are looked at first, and the rows of each
MAX_VIEWS = 127
MAX_CELLS = 300_000_000  # rows times views that are worth the memory


def interleaved_layout(
    points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray, width: int, height: int
) -> Layout | None:
    """Which pixel of which view every row is, for cameras in the frame of the Gaussians and means inside their pixels.

    Every row lies in some pixel of every view. In the order of the file the true ones can only go forward: pixel by
    pixel, within a pixel view by view. The path through the views that goes forward in the smallest steps is taken.

    Args:
        points: ``[n,3]`` float64, all finite.
        viewmats: ``[c,4,4]``.
        Ks: ``[c,3,3]``.
        width: Of the grid, pixels.
        height: The same.

    Returns:
        A layout; None if no path goes forward, or hardly any step changes the view.
    """
    views = len(viewmats)
    if not 1 < views <= MAX_VIEWS or len(points) < MIN_BLOCK * views or len(points) * views > MAX_CELLS:
        return None
    starts = np.linspace(0, max(0, len(points) - PROBE), PROBES).astype(int)
    pieces = [points[start : start + PROBE] for start in starts] if len(points) > PROBES * PROBE else []
    # quick for the many files that have no such order: a few pieces tell
    if not all(_forward(_pixels_in_views(p, viewmats, Ks, width, height))[1] for p in pieces):
        return None
    pixels = _pixels_in_views(points, viewmats, Ks, width, height)
    chosen, goes_forward = _forward(pixels)
    if not goes_forward:
        return None
    mine = pixels[np.arange(len(points)), chosen]
    rows, cells = [], []
    for view in range(views):
        own = np.flatnonzero((chosen == view) & (mine >= 0))
        first = np.unique(mine[own], return_index=True)[1]  # a step back may have found a pixel twice
        rows.append(own[np.sort(first)].astype(np.int64))
        cells.append(mine[rows[-1]].astype(np.int64))
    if min(len(own) for own in rows) < MIN_BLOCK:
        return None
    missing = views * width * height - len(points)
    return Layout(
        words=f"{missing:,} pixels of {views} views dropped, view-fastest",
        kind="pruned",
        order="view-fastest",
        width=width,
        height=height,
        views=tuple(range(views)),
        rows=tuple(rows),
        pixels=tuple(cells),
    )


def _forward(pixels: np.ndarray) -> tuple[np.ndarray, bool]:
    """The best view ``[n]`` of every row, and whether its pixels then only go forward, from view to view."""
    chosen = np.empty(len(pixels), np.int64)
    back = cheapest_views(pixels, np.zeros(pixels.shape, np.int8), chosen)
    return chosen, bool(back <= MAX_BACK * len(pixels) and np.mean(chosen[1:] != chosen[:-1]) >= MIN_CHANGES)


def _pixels_in_views(points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray, width: int, height: int) -> np.ndarray:
    """``[n,c]`` int32 pixel that each point lies in, in each view; -1 outside."""
    project, every = projector(points, viewmats, Ks), np.arange(len(points))
    pixels = np.full((len(points), len(viewmats)), -1, np.int32)
    for view in range(len(viewmats)):
        u, v = project(every, view)
        inside = np.isfinite(u) & np.isfinite(v) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        pixels[inside, view] = v[inside].astype(np.int32) * width + u[inside].astype(np.int32)
    return pixels
