"""Find the pixels of rows from the rows alone if some pixels have no row; rows are view by view and line by line.

Some lines are complete, for example in the middle of views without borders and far pixels. Between complete lines, the
long step back to the left edge repeats once per line. A projective camera is solved from a few such lines. It then
shows the lines before and after them in their pixels, also the incomplete ones, up to the end of the view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.cameras.calibration import Calibration, calibrate
from gsmerge.cameras.layouts import Layout
from gsmerge.cameras.resection import projective_camera
from gsmerge.cameras.score import find_correspondences, is_as_near
from gsmerge.kernels.matrices import matmul
from gsmerge.kernels.reproject import follow_pixels

_MIN_SIDE, _MAX_WIDTH = 16, 2048  # fewest and most pixels of a line
# A length of lines is tried if at least this share of the sampled rows shows it; and the number of lengths tried
_MIN_SHARE, _MAX_LENGTHS = 0.02, 2
# Least step back to the left, divided by the usual step; and largest step down to the next line, divided by the step
# back
_WRAP, _BELOW = 8.0, 0.25
_MIN_LINES = 6  # fewest complete lines in a series
_SOLVED_FROM = 800  # rows of a view that its camera is solved from
_MAX_PX = 1.0  # largest median distance of a view's rows from their pixels
# A camera is used for some lines beyond those from which it was solved: this share of their number, at least _MIN_AHEAD
_AHEAD, _MIN_AHEAD = 0.3, 2
_MIN_PLACED = 0.9  # share of the rows that must have a pixel


def find_dropped_grid(means: np.ndarray, valid: np.ndarray) -> tuple[Layout, Calibration] | None:
    """Find the pixels of rows ``means [n,3]`` and the cameras of their views, if some pixels have no row.

    ``valid [n]`` bool marks the finite rows. Lines and columns at the borders without rows are not part of the grid.
    Returns None if the rows are not in the order of pixels.
    """
    rows = np.flatnonzero(valid)
    if len(rows) < _MIN_LINES * _MIN_SIDE:
        return None
    points = means[rows].astype(np.float64)
    points -= np.median(points, 0)
    for length in _find_line_lengths(points):
        views = _find_views(points, length)
        if sum(len(view.x) for view in views) >= _MIN_PLACED * len(rows):
            layout = _make_layout(rows, views, len(means))
            pairs = find_correspondences(means, valid, layout, _SOLVED_FROM)
            calibration = calibrate(pairs, layout.width, layout.height)
            if calibration is not None:
                return layout, calibration
    return None


def _find_line_lengths(points: np.ndarray) -> list[int]:
    """List the likely lengths of lines, in rows.

    They are the most common distances from a row to its nearest neighbour among later rows.
    """
    longest = min(_MAX_WIDTH, len(points) // 4)
    num_samples = 1500  # number of rows whose nearest neighbour is searched among the rows after them
    starts = np.linspace(0, len(points) - longest - 1, num_samples).astype(int)
    x, y, z = points.T.astype(np.float32)

    def find_nearest(start: int) -> int:
        """Return the distance in rows from a row to its nearest neighbour among the next rows, at least _MIN_SIDE."""
        rows = slice(start + _MIN_SIDE, start + longest)
        dx, dy, dz = x[rows] - x[start], y[rows] - y[start], z[rows] - z[start]
        return _MIN_SIDE + int(np.argmin(dx * dx + dy * dy + dz * dz))

    counts = np.bincount([find_nearest(start) for start in starts], minlength=2 * longest)
    neighbours = np.maximum(np.roll(counts, 1), np.roll(counts, -1))
    peaks = np.where(counts >= neighbours, counts, 0)
    highest = np.argsort(-peaks, kind="stable")[:_MAX_LENGTHS]
    return [int(length) for length in highest if peaks[length] >= _MIN_SHARE * len(starts)]


@dataclass(frozen=True, eq=False)
class _GridView:
    """Consecutive rows of one view, with their pixels; the origin of the pixels is arbitrary."""

    rows: np.ndarray  # ``[p]`` in order
    x: np.ndarray  # ``[p]`` columns of the pixels
    y: np.ndarray  # ``[p]`` lines of the pixels
    camera: np.ndarray  # ``[3,4]`` projective camera, from points to pixels
    px: float = np.inf  # median distance of rows from their pixels, pixels


def _find_views(points: np.ndarray, length: int) -> list[_GridView]:
    """Find the views whose lines have ``length`` rows, in the order of their rows.

    Each view grows from a series of complete lines. Series that fit a camera worse than the best one are left out.
    """
    num_first, max_series = 12, 200  # number of series among which the best one is looked for, and in all
    series = _find_lines(points, length)[:max_series]
    seeds = [_solve_lines(points, starts) for starts in series[:num_first]]
    nearest = min((seed.px for seed in seeds if seed is not None), default=None)
    if nearest is None:
        return []
    views = list[_GridView]()
    free = np.ones(len(points), bool)
    for i, starts in enumerate(series):
        if not free[starts[0] : starts[-1]].all():
            continue
        seed = seeds[i] if i < len(seeds) else _solve_lines(points, starts)
        if seed is not None and is_as_near(seed.px, nearest):
            view = _extend_view(points, free, seed, length)
            free[view.rows[0] : view.rows[-1] + 1] = False
            views.append(_drop_rare_columns(view))
    return sorted(views, key=lambda view: int(view.rows[0]))


def _find_lines(points: np.ndarray, length: int) -> list[np.ndarray]:
    """Find series of rows that begin consecutive lines, ``length`` rows apart; the longest series first.

    The first row of a line follows a long step back to the left, and lies near the first row of the line before.
    """
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    count = len(steps) // length * length
    usual = np.median(steps[:count].reshape(-1, length), 1).repeat(length)
    usual = np.pad(usual, (0, len(steps) - count), mode="edge")
    rows = np.flatnonzero(steps > _WRAP * usual) + 1
    max_jumps = 100  # long steps per line; with more, rows are in no order
    if len(rows) * length > max_jumps * len(points):
        return []
    return _collect_series(rows, _link_lines(rows, points[rows], _BELOW * steps[rows - 1], length))


def _link_lines(rows: np.ndarray, points: np.ndarray, limits: np.ndarray, length: int) -> np.ndarray:
    """Return for each of ``rows [r]``, which may begin lines, the index ``[r]`` of the line before; -1 if none is.

    The line before begins ``length`` rows earlier. Its first point is the nearest of ``points [r,3]``, within
    ``limits [r]``.
    """
    before, least = np.full(len(rows), -1), limits
    for back in range(1, len(rows)):
        apart = rows[back:] - rows[:-back]
        if apart.min() > length:
            break
        ids = np.flatnonzero(apart == length)
        distances = np.linalg.norm(points[ids + back] - points[ids], axis=1)
        closer = distances < least[ids + back]
        ids, distances = ids[closer], distances[closer]
        before[ids + back], least[ids + back] = ids, distances
    return before


def _collect_series(rows: np.ndarray, before: np.ndarray) -> list[np.ndarray]:
    """Collect series of lines that follow each other, the longest series first; no two series share a line.

    ``rows [r]`` begin the lines, and ``before [r]`` is the index of the line before, or -1. A series is the rows that
    begin its lines.
    """
    num_before = np.zeros(len(rows), np.int64)  # number of lines before each line in its series
    for i, previous in enumerate(before.tolist()):
        num_before[i] = num_before[previous] + 1 if previous >= 0 else 0
    series, used = [], np.zeros(len(rows), bool)
    for last in np.argsort(-num_before, kind="stable").tolist():
        if num_before[last] < _MIN_LINES:
            break
        chain = [last]
        while before[chain[-1]] >= 0 and not used[chain[-1]]:
            chain.append(int(before[chain[-1]]))
        if not used[chain].any():
            series.append(rows[chain[::-1]])
        used[chain] = True
    return series


def _solve_lines(points: np.ndarray, starts: np.ndarray) -> _GridView | None:
    """Solve for the camera of lines of one length that begin at ``starts``; None if the rows do not fit a camera."""
    rows = np.arange(starts[0], starts[-1])
    y, x = np.divmod(rows - starts[0], starts[1] - starts[0])
    view = _solve_camera(points, _GridView(rows, x, y, np.empty(0)))
    return view if view.px <= _MAX_PX else None


def _drop_rare_columns(view: _GridView) -> _GridView:
    """Leave out outer columns that few lines have, and number the other columns from 0."""
    first = int(view.x.min())
    counts = np.bincount(view.x - first)
    least_share = 0.05  # columns in a smaller share of the lines than the fullest column are left out
    common = first + np.flatnonzero(counts >= least_share * counts.max())
    inside = (view.x >= common[0]) & (view.x <= common[-1])
    return _shift_columns(replace(view, rows=view.rows[inside], x=view.x[inside], y=view.y[inside]), -int(common[0]))


def _shift_columns(view: _GridView, columns: int) -> _GridView:
    """Add a number to the columns of a view's pixels, and shift its camera alike."""
    camera = view.camera.copy()
    camera[0] += columns * camera[2]
    return replace(view, x=view.x + columns, camera=camera)


def _extend_view(points: np.ndarray, free: np.ndarray, view: _GridView, width: int) -> _GridView:
    """Extend a view over rows before and after it, as long as its camera shows these in the order of pixels.

    ``free [n]`` marks the rows of no other view, and ``width`` is the length of a line in rows.
    """
    first, last = view.rows[[0, -1]]
    before, after = np.flatnonzero(~free[:first]), np.flatnonzero(~free[last:])
    low, high = int(before[-1]) + 1 if len(before) else 0, int(last + after[0]) if len(after) else len(free)
    max_lost = 16  # after more consecutive rows without a pixel, another view begins
    while True:
        top, lines = int(view.y.min()), int(np.ptp(view.y)) + 1
        reach = max(_MIN_AHEAD, int(_AHEAD * lines))
        first, last = max(low, view.rows[0] - reach * width), min(high, view.rows[-1] + 1 + reach * width)
        shift = np.array([[1.0, 0, 0], [0, 1, reach - top], [0, 0, 1]])
        viewmat = np.concatenate([view.camera, [[0, 0, 0, 1]]])
        followed = np.ascontiguousarray(points[first:last], np.float32)
        pixels = follow_rows(followed, viewmat[None], shift[None], width, lines + 2 * reach)
        rows = np.flatnonzero(pixels >= 0)
        stretches = np.split(rows, np.flatnonzero(np.diff(rows) > max_lost) + 1)
        rows = max(stretches, key=len)
        y, x = np.divmod(pixels[rows], width)
        grown = _solve_camera(points, _GridView(first + rows, x, y + top - reach, view.camera)) if len(rows) else view
        if grown.px > _MAX_PX or len(grown.rows) <= len(view.rows):
            return view
        view = grown


def follow_rows(
    points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray, width: int, height: int, *, mixed: bool = False
) -> np.ndarray:
    """Find pixels ``[n]`` of rows at ``points [n,3]`` float32 so that most rows are in the order of pixels.

    Rows out of order get -1. The order is view by view and line by line. If ``mixed``, it is line by line, and the
    views of a pixel follow each other.
    """
    count, views = len(points), len(viewmats)
    shapes = ((count, np.int64), (count, np.int64), (count, np.int32), (count * views, np.int32))
    ids, *scratch = (np.empty(size, dtype) for size, dtype in (*shapes, (views, np.int64), (views, np.int32)))
    follow_pixels(points, viewmats, Ks, ids, *scratch, width, height, int(mixed))
    return ids


def _solve_camera(points: np.ndarray, view: _GridView) -> _GridView:
    """Return a view with the camera that is solved for from its rows and pixels, and the distance between these."""
    sample = np.linspace(0, len(view.rows) - 1, min(_SOLVED_FROM, len(view.rows))).astype(int)
    pixels = np.stack([view.x[sample], view.y[sample]], 1) + 0.5
    camera, px = projective_camera(points[view.rows[sample]], pixels)
    depths = matmul(points[view.rows[sample]], camera[2, :3]) + camera[2, 3]
    return replace(view, camera=camera * np.copysign(1.0, np.median(depths)), px=px)


def _make_layout(rows: np.ndarray, views: list[_GridView], count: int) -> Layout:
    """Lay out views on grids of one size, so that all have about the same principal point.

    The layout has ``count`` rows. The rows of a view are indices of ``rows [m]``, the finite ones of these.
    """
    lefts, width = _choose_shifts([(view.x, _principal_coordinate(view, 0)) for view in views])
    tops, height = _choose_shifts([(view.y, _principal_coordinate(view, 1)) for view in views])
    pixels = tuple((view.y + top) * width + view.x + left for view, top, left in zip(views, tops, lefts, strict=True))
    ids = np.full(count, -1)
    for number, (view, view_pixels) in enumerate(zip(views, pixels, strict=True)):
        ids[rows[view.rows]] = number * height * width + view_pixels
    return Layout(len(views), width, height, ids=ids)


def _choose_shifts(views: Sequence[tuple[np.ndarray, float]]) -> tuple[list[int], int]:
    """Choose the shift of each view along an axis, and the size of the grid along this axis; all in pixels.

    ``views`` are pairs: the pixels of a view along the axis, and the coordinate of its principal point.
    """
    firsts, middles = np.array([pixels.min() for pixels, _ in views]), np.array([middle for _, middle in views])
    sizes = np.array([pixels.max() for pixels, _ in views]) - firsts + 1
    starts = firsts - middles
    corners = np.rint(starts - np.median(starts[sizes == sizes.max()])).astype(int)  # relative to the largest view
    inside = corners.clip(0, sizes.max() - sizes)
    tolerance = 2  # difference of principal points, pixels, up to which views stay within the largest view
    corners = np.where(np.abs(corners - inside) <= tolerance, inside, corners)
    corners -= corners.min()
    return (corners - firsts).tolist(), int((corners + sizes).max())


def _principal_coordinate(view: _GridView, axis: int) -> float:
    """Return the coordinate along ``axis`` of the principal point of a view's projective camera, in pixels.

    It follows from the camera's matrix (Hartley and Zisserman 2004, section 6.2).
    """
    forward = view.camera[2, :3]
    return float((view.camera[axis, :3] * forward).sum() / (forward * forward).sum())
