"""Pixels of files that dropped some, nobody knows which: views one after the other, each row by row.

Where one view ends and the next begins, the projected rows start again from the top; within a view the pixels can
only go forward.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gsmerge.io.alignment.layouts import Layout
from gsmerge.io.alignment.similarity import Frame

WINDOW = 40  # rows averaged on either side of a restart
RESTART = 0.25  # of the image's height: how far back a restart goes at least
SHORT = 1500  # rows that tell which view a block is of
MIN_BLOCK = 500  # rows; less of a view cannot be told from noise
SCALES = np.geomspace(1 / 30, 30, 69)  # of the cameras' positions, tried in turn
SPAN = 1.25  # how far the first guess of the scale may be off
MOST_SCALES = 400  # that are tried
TRIED_BLOCKS, STRETCH = 4, 2000  # blocks, and rows of each in a row, that a scale is tried on
_SMALL = 1e-6  # weight of a point that says nothing

Project = Callable[[np.ndarray, int], tuple[np.ndarray, np.ndarray]]


def projector(points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray) -> Project:
    """``(rows, view) -> (u, v)`` in pixels; NaN behind the camera."""

    def project(rows: np.ndarray, view: int) -> tuple[np.ndarray, np.ndarray]:
        matrix = Ks[view] @ viewmats[view, :3]
        image = points[rows] @ matrix[:, :3].T + matrix[:, 3]
        with np.errstate(all="ignore"):
            u, v = image[:, 0] / image[:, 2], image[:, 1] / image[:, 2]
        u[image[:, 2] <= 0] = np.nan
        v[image[:, 2] <= 0] = np.nan
        return u, v

    return project


def pruned_layout(points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray, width: int, height: int) -> Layout | None:
    """Which pixel of which view every row is, for cameras in the frame of the Gaussians.

    Args:
        points: ``[n,3]`` float64, all finite.
        viewmats: ``[c,4,4]``.
        Ks: ``[c,3,3]``.
        width: Of the grid, pixels.
        height: The same.

    Returns:
        A layout, right or wrong: its pixels have to be measured. None if the rows do not look like views at all.
    """
    project = projector(points, viewmats, Ks)
    blocks = _blocks(project, len(points), len(viewmats), width * height, height)
    if blocks is None:
        return None
    pixels = [assign_pixels(*project(rows, view), width, height) for view, rows in blocks]
    missing = len(blocks) * width * height - len(points)
    return Layout(
        words=f"{missing:,} pixels of {len(blocks)} views dropped, view-major",
        kind="pruned",
        order="view-major",
        width=width,
        height=height,
        views=tuple(view for view, _ in blocks),
        rows=tuple(rows for _, rows in blocks),
        pixels=tuple(pixels),
    )


def _blocks(project: Project, count: int, views: int, most: int, height: int) -> list[tuple[int, np.ndarray]] | None:
    """(view, rows) of each block, views increasing; None if the rows do not look like that.

    Where a block ends shows in any view that is nearly its own. Which views they are is decided for all together.
    """
    start, view = 0, -1
    parts: list[np.ndarray] = []
    costs: list[np.ndarray] = []
    while start < count:
        rows = np.arange(start, min(count, start + SHORT))
        cost = np.array([_unevenness(*project(rows, view)) for view in range(views)])
        if len(parts) == views or not np.isfinite(cost).any():
            return None
        later = cost[view + 1 :]
        view = view + 1 + int(np.argmin(later)) if np.isfinite(later).any() else int(np.argmin(cost))
        end = _block_end(project, start, min(count, start + most), view, height)
        if end - start < MIN_BLOCK:
            return None
        parts.append(np.arange(start, end, dtype=np.int64))
        costs.append(cost)
        start = end
    chosen = _increasing(np.array(costs))
    return None if chosen is None else list(zip(chosen, parts, strict=True))


def _increasing(costs: np.ndarray) -> list[int] | None:
    """Increasing columns of ``[b,v]``, one for each row, with the smallest sum; None where every choice is infinite."""
    total, came_from = costs[0], []
    for cost in costs[1:]:
        best = np.minimum.accumulate(total)
        where = np.maximum.accumulate(np.where(total == best, np.arange(len(total)), 0))
        came_from.append(np.concatenate([[0], where[:-1]]))
        total = cost + np.concatenate([[np.inf], best[:-1]])
    if not np.isfinite(total).any():
        return None
    chosen = [int(np.argmin(total))]
    for where in reversed(came_from):
        chosen.append(int(where[chosen[-1]]))
    return chosen[::-1]


def _unevenness(u: np.ndarray, v: np.ndarray) -> float:
    """How far the typical step is from one pixel to the right."""
    du, dv = np.diff(u), np.diff(v)
    good = np.isfinite(du) & np.isfinite(dv)
    if good.sum() < max(8, 0.5 * len(du)):
        return np.inf
    return float(abs(np.median(du[good]) - 1) + np.median(np.abs(du[good] - 1)) + np.median(np.abs(dv[good])))


def _block_end(project: Project, start: int, stop: int, view: int, height: int) -> int:
    """The row after the last one of the block: the first clear restart, at its steepest step."""
    _, v = project(np.arange(start, stop), view)
    v = np.clip(np.nan_to_num(v, nan=0.0), -height, 2 * height)
    if len(v) < 2 * WINDOW:
        return stop
    total = np.concatenate([[0.0], np.cumsum(v)])
    middle = np.arange(WINDOW, len(v) - WINDOW + 1)
    before = (total[middle] - total[middle - WINDOW]) / WINDOW
    behind = (total[middle + WINDOW] - total[middle]) / WINDOW
    drop = before - behind
    far = np.flatnonzero(drop > RESTART * height)
    if len(far) == 0:
        return stop
    first = far[0]
    last = first + int(np.argmin(drop[first:] > RESTART * height)) if (drop[first:] <= RESTART * height).any() else None
    peak = int(middle[first + int(np.argmax(drop[first:last]))])
    near = slice(max(1, peak - WINDOW), min(len(v), peak + WINDOW))
    return start + near.start + int(np.argmin(np.diff(v)[near.start - 1 : near.stop - 1]))


def assign_pixels(u: np.ndarray, v: np.ndarray, width: int, height: int) -> np.ndarray:
    """Strictly increasing pixels for the rows of one view.

    The rows are cut into scanlines where u falls back; a scanline's row is the median of v, never decreasing. With
    the row known, ``pixel - rank`` never decreases, and is found by isotonic regression, which averages the
    jitter over stretches without gaps.

    Args:
        u: ``[n]`` projected columns, pixels; NaN where unknown.
        v: ``[n]`` projected rows.
        width: Of the grid, pixels.
        height: The same.
    """
    count, known = len(u), np.isfinite(u) & np.isfinite(v)
    u, v = np.where(known, u, 0.0), np.where(known, v, 0.0)
    du = np.diff(u)
    noise = float(np.median(np.abs(du[known[1:] & known[:-1]] - 1))) if (known[1:] & known[:-1]).any() else 0.0
    cut = (du < -max(2.0, 4 * noise + 1)) & known[1:] & known[:-1]
    scanline = np.concatenate([[0], np.cumsum(cut)])
    row = np.clip(np.floor(_rows_of(scanline, np.where(known, v, np.nan))), 0, height - 1)[scanline]
    rank = np.arange(count)
    sure = known & (np.abs(v - row - 0.5) < 2 + 4 * noise) & (u > -2 - 4 * noise) & (u < width + 2 + 4 * noise)
    key = row * width + np.clip(u, 0, width) - 0.5 - rank
    found = _never_falling(key, np.where(sure, 1.0, _SMALL))
    return np.asarray(np.clip(np.rint(found), 0, width * height - count), np.int64) + rank


def _rows_of(scanline: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Median of v of every scanline, made never to decrease."""
    order = np.lexsort((v, scanline))  # NaN comes last
    sizes = np.bincount(scanline)
    finite = np.bincount(scanline, np.isfinite(v)).astype(np.int64)
    first = np.cumsum(sizes) - sizes
    low, high = (v[order[first + np.maximum(np.maximum(finite, 1) - shift, 0) // 2]] for shift in (1, 0))
    median = np.where(finite > 0, (low + np.where(np.isfinite(high), high, low)) / 2, 0.0)
    return _never_falling(median, np.maximum(finite, _SMALL))


def _never_falling(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The nearest non-decreasing sequence, by weighted squares."""
    from scipy.optimize import isotonic_regression  # loads slowly, and is seldom needed

    return np.asarray(isotonic_regression(values, weights=weights).x)


def rough_scale(points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray) -> float:
    """The scale of the cameras' positions under which rows step by single pixels, before any pixel is known."""
    views = len(viewmats)
    windows = [
        (view, np.arange(middle - SHORT // 4, middle + SHORT // 4).clip(0, len(points) - 1))
        for view, middle in enumerate((np.arange(views) + 0.5) / views * len(points))
    ]
    windows = [(view, rows.astype(np.int64)) for view, rows in windows]

    def cost(size: float) -> float:
        frame = Frame(np.eye(3), size, np.zeros(3))
        return _mean_unevenness(points, frame.move_cameras(viewmats), Ks, windows)

    costs = [cost(size) for size in SCALES]
    best = float(SCALES[int(np.argmin(costs))])
    for width_of_search in (1.08, 1.02, 1.005):
        near = best * np.geomspace(1 / width_of_search, width_of_search, 9)
        best = float(near[int(np.argmin([cost(size) for size in near]))])
    return best


def scaled(scale: float, words: str = "") -> Frame:
    """The cameras' frame with other units."""
    return Frame(np.eye(3), scale, np.zeros(3), f"positions scaled by {scale:.4g}{words}", "scaled")


def finer_scale(points: np.ndarray, layout: Layout, viewmats: np.ndarray, Ks: np.ndarray, rough: float) -> float:
    """The scale, up to a quarter off ``rough``, under which rows lie nearest to the pixels that they come to.

    A scale that is wrong by little moves rows by parts of a pixel, which finding their pixels hides: so scales are
    tried in steps that move most rows by a quarter of a pixel at most.

    Args:
        points: ``[n,3]`` float64.
        layout: Its blocks are right, its pixels need not be.
        viewmats: ``[c,4,4]`` in the cameras' own frame.
        Ks: ``[c,3,3]``.
        rough: Where to look.
    """
    chosen = np.unique(np.linspace(0, len(layout.views) - 1, TRIED_BLOCKS).astype(int))
    middles = [(len(layout.rows[b]) - STRETCH) // 2 for b in chosen]
    parts = [
        (layout.views[b], layout.rows[b][max(0, a) : max(0, a) + STRETCH]) for b, a in zip(chosen, middles, strict=True)
    ]

    def seen(scale: float) -> list[tuple[np.ndarray, np.ndarray]]:
        project = projector(points, scaled(scale).move_cameras(viewmats), Ks)
        return [project(rows, view) for view, rows in parts]

    def cost(scale: float) -> float:
        return float(np.mean([_distance(u, v, layout.width, layout.height) for u, v in seen(scale)]))

    here, there = seen(rough), seen(rough * 1.001)
    moved = np.concatenate([np.hypot(b[0] - a[0], b[1] - a[1]) for a, b in zip(here, there, strict=True)]) / 0.001
    speed = float(np.nanquantile(moved, 0.9)) if np.isfinite(moved).any() else 0.0
    if speed <= 0:
        return rough
    step = max(0.25 / speed, 2 * np.log(SPAN) / MOST_SCALES)
    best = rough
    for reach in (max(step, np.log(SPAN)), step, step / 8):
        near = best * np.exp(np.linspace(-reach, reach, 2 * max(1, int(np.ceil(reach / step))) + 1))
        best = float(near[int(np.argmin([cost(scale) for scale in near]))])
        step = min(step, reach) / 8
    return best


def _distance(u: np.ndarray, v: np.ndarray, width: int, height: int) -> float:
    """Median distance of projected rows from the pixels that they come to."""
    y, x = np.divmod(assign_pixels(u, v, width, height), width)
    away = np.hypot(u - x - 0.5, v - y - 0.5)
    return float(np.median(np.where(np.isfinite(away), away, width)))


def _mean_unevenness(
    points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray, windows: Sequence[tuple[int, np.ndarray]]
) -> float:
    project = projector(points, viewmats, Ks)
    return float(np.mean([min(_unevenness(*project(rows, view)), 10.0) for view, rows in windows]))
