"""Find the grid of rows that lack some pixels, from the rows alone: view after view, and line after line in each.

Lines that are whole have one length, after which the step back to the left repeats. A projective camera that shows a
few of them in their pixels shows the lines before and after in theirs, up to where the rows of a view end.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gsmerge.alignment.calibration import Calibration, calibrate
from gsmerge.alignment.layouts import Layout, subsample
from gsmerge.alignment.resection import projective_camera
from gsmerge.alignment.score import find_correspondences
from gsmerge.kernels.matrices import matmul

_MIN_SIDE, _MAX_WIDTH = 16, 2048  # pixels of a line
_LOOKED_AT = 1500  # rows whose nearest neighbour is searched among those that follow
_MIN_ALIKE, _WIDTHS = 0.02, 4  # share of them that have it after one number of rows, and such numbers that are tried
_WRAP, _BELOW = 8.0, 0.25  # times the usual step: back to the left; share of it at most, to the pixel below
_MIN_LINES = 6  # whole lines in a row
_SOLVED_FROM = 800  # rows of a view that its camera is solved from
_MAX_PX = 0.6  # median distance of rows from their pixels
_NEXT_PX = 0.75  # that a step to the next pixel is off, at most
_RUN = 3  # rows from pixel to pixel that are no chance
_SAME_LINES = 2  # by which the principal point may be off
_AHEAD, _MIN_AHEAD = 0.3, 2  # lines that a camera is trusted beyond those it is solved from, as a share, and at least
_MIN_PLACED = 0.9  # share of the rows that come to a pixel


def find_dropped_grid(means: np.ndarray, valid: np.ndarray) -> tuple[Layout, Calibration] | None:
    """Find the pixels of rows ``means [n,3]`` that lack some, and the cameras of their views; None for other rows.

    ``valid [n]`` bool. The grid has the lines and columns that some rows have.
    """
    rows = np.flatnonzero(valid)
    if len(rows) < _MIN_LINES * _MIN_SIDE:
        return None
    points = means[rows].astype(np.float64)
    points -= np.median(points, 0)
    for width in _find_widths(points):
        views = _find_views(points, width)
        if sum(len(view.x) for view in views) >= _MIN_PLACED * len(rows):
            layout = _make_layout(rows, views, width)
            calibration = calibrate(find_correspondences(means, valid, subsample(layout, 1000)), width, layout.height)
            if calibration is not None:
                return layout, calibration
    return None


def _find_widths(points: np.ndarray) -> list[int]:
    """Find the numbers of rows after which most often the nearest neighbour of a row follows, the likely ones first."""
    most = min(_MAX_WIDTH, len(points) // 4)
    starts = np.linspace(0, len(points) - most - 1, _LOOKED_AT).astype(int)
    near = points.astype(np.float32)
    lags = [
        _MIN_SIDE + int(np.argmin(((near[start + _MIN_SIDE : start + most] - near[start]) ** 2).sum(1)))
        for start in starts
    ]
    counts = np.bincount(lags, minlength=most + 2)
    peaks = np.flatnonzero((counts[1:-1] >= counts[:-2]) & (counts[1:-1] >= counts[2:])) + 1
    peaks = peaks[counts[peaks] >= _MIN_ALIKE * len(starts)]
    return [int(lag) for lag in peaks[np.argsort(-counts[peaks], kind="stable")][:_WIDTHS]]


@dataclass(frozen=True)
class _View:
    """Consecutive rows of one view, with their pixels; lines are counted from any of them."""

    rows: np.ndarray  # ``[p]`` in order
    x: np.ndarray
    y: np.ndarray
    camera: np.ndarray  # ``[3,4]`` projective


def _find_views(points: np.ndarray, width: int) -> list[_View]:
    views: list[_View] = []
    free = np.ones(len(points), bool)
    for first, lines in _whole_lines(points, width):
        rows = np.arange(first, first + lines * width)
        if not free[rows].all():
            continue
        view = _grow(points, free, _View(rows, (rows - first) % width, (rows - first) // width, np.empty(0)), width)
        if view is not None:
            views.append(view)
            free[view.rows[0] : view.rows[-1] + 1] = False
    return sorted(views, key=lambda view: int(view.rows[0]))


def _whole_lines(points: np.ndarray, width: int) -> Iterator[tuple[int, int]]:
    """Yield the first rows and the numbers of consecutive whole lines, the most lines first."""
    count = len(points) // width * width
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    below = np.linalg.norm(points[width:] - points[:-width], axis=1)
    usual = np.repeat(np.median(steps[: count - width].reshape(-1, width), 1), width)
    begins = np.zeros(count, bool)  # a line begins, and so does one ``width`` rows before
    jump = steps[width - 1 : count - 1]
    begins[width:] = (jump > _WRAP * usual) & (below[: count - width] < _BELOW * jump)
    columns = np.zeros((width, count // width + 1), bool)
    columns[:, :-1] = begins.reshape(-1, width).T
    edges = np.flatnonzero(np.diff(columns.reshape(-1), prepend=False)).reshape(-1, 2)
    lines = edges[:, 1] - edges[:, 0]
    for i in np.argsort(-lines, kind="stable"):
        if lines[i] < _MIN_LINES:
            return
        column, line = divmod(int(edges[i, 0]), columns.shape[1])
        yield (line - 1) * width + column, int(lines[i])


def _grow(points: np.ndarray, free: np.ndarray, seed: _View, width: int) -> _View | None:
    """Grow a view from whole lines over the rows before and after them; None if these are no lines of one camera."""
    view = _solve(points, seed)
    if view is None:
        return None
    low, high = _free_range(free, seed.rows)
    while True:
        lines = int(view.y.max() - view.y.min()) + 1
        reach = max(_MIN_AHEAD, int(_AHEAD * lines))
        after = _walk(points[view.rows[-1] + 1 : high], view.camera, (view.x[-1], view.y[-1]), width, reach)
        turned = np.array([[-1, 0, width], [0, -1, 0], [0, 0, 1.0]])  # the lines backwards, from the last to the first
        ahead = points[low : view.rows[0]][::-1]
        before = _walk(ahead, matmul(turned, view.camera), (width - 1 - view.x[0], -1 - view.y[0]), width, reach)
        if not len(after[0]) + len(before[0]):
            return view
        rows = np.concatenate([view.rows[0] - 1 - before[0][::-1], view.rows, view.rows[-1] + 1 + after[0]])
        x = np.concatenate([width - 1 - before[1][::-1], view.x, after[1]])
        y = np.concatenate([-1 - before[2][::-1], view.y, after[2]])
        grown = _solve(points, _View(rows, x, y, view.camera))
        if grown is None:
            return view
        view = grown


def _free_range(free: np.ndarray, rows: np.ndarray) -> tuple[int, int]:
    """Return the first row and the end of the free rows around some."""
    before, after = np.flatnonzero(~free[: rows[0]]), np.flatnonzero(~free[rows[-1] :])
    return int(before[-1]) + 1 if len(before) else 0, int(rows[-1] + after[0]) if len(after) else len(free)


def _solve(points: np.ndarray, view: _View) -> _View | None:
    """Solve for the camera of a view; None if its rows do not lie at their pixels."""
    chosen = np.linspace(0, len(view.rows) - 1, min(_SOLVED_FROM, len(view.rows))).astype(int)
    pixels = np.stack([view.x[chosen], view.y[chosen]], 1) + 0.5
    camera, px = projective_camera(points[view.rows[chosen]], pixels)
    return _View(view.rows, view.x, view.y, camera) if px <= _MAX_PX else None


def _walk(
    points: np.ndarray, camera: np.ndarray, last: tuple[int, int], width: int, reach: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Place rows that follow the pixel ``last`` one after the other, up to ``reach`` lines on.

    Rows from pixel to pixel without a gap come to one line together. Returns rows ``[p]`` and their ``x``, ``y``; ends
    where as many rows as a line has do not follow the ones before.
    """
    points = points[: (reach + 1) * width]
    if not len(points):
        return (np.empty(0, np.int64),) * 3
    with np.errstate(all="ignore"):
        places = matmul(points, camera[:, :3].T) + camera[:, 3]
        u, v = (np.nan_to_num(places[:, i] / places[:, 2] - 0.5, nan=-1e6).clip(-1e6, 1e6) for i in (0, 1))
    gaps = (np.abs(np.diff(u) - 1) > _NEXT_PX) | (np.abs(np.diff(v)) > _NEXT_PX)
    starts = np.flatnonzero(np.concatenate([[True], gaps]))
    lengths = np.diff(np.append(starts, len(u)))
    offsets = np.arange(len(u)) - np.repeat(starts, lengths)
    x, y = (np.rint(np.add.reduceat(values, starts) / lengths).astype(np.int64) for values in (u - offsets, v))
    after, lost, end = last[1] * width + last[0], 0, 0
    follows = np.zeros(len(starts), bool)
    inside = (x >= 0) & (x + lengths <= width) & (y <= last[1] + reach)
    firsts = y * width + x
    for i, (first, length) in enumerate(zip(firsts.tolist(), lengths.tolist(), strict=True)):
        if inside[i] and first > after:
            follows[i], after = True, first + length - 1
        if follows[i] and length >= _RUN:
            lost, end = 0, i + 1
        else:
            lost += length
            if lost > width:
                break
    follows[end:] = False
    placed = np.flatnonzero(np.repeat(follows, lengths))
    return placed, (np.repeat(x, lengths) + offsets)[placed], np.repeat(y, lengths)[placed]


def _make_layout(rows: np.ndarray, views: list[_View], width: int) -> Layout:
    """Lay out views on one grid; where their lines begin is the same for the same principal points."""
    lines = np.array([np.ptp(view.y) + 1 for view in views])
    firsts = np.array([view.y.min() - _principal_y(view.camera) for view in views])
    most = int(lines.max())
    tops = np.rint(firsts - np.median(firsts[lines == most])).astype(int)
    within = tops.clip(0, most - lines)
    tops = np.where(np.abs(tops - within) <= _SAME_LINES, within, tops)
    tops -= tops.min()
    height = int((tops + lines).max())
    pixels = tuple((view.y - view.y.min() + top) * width + view.x for view, top in zip(views, tops, strict=True))
    parts = tuple(range(len(views)))
    return Layout(
        "pixels dropped, view-major",
        "pruned",
        "view-major",
        width,
        height,
        parts,
        tuple(rows[view.rows] for view in views),
        pixels,
    )


def _principal_y(camera: np.ndarray) -> float:
    """Return the line of the principal point of a projective camera (Hartley and Zisserman 2004, section 6.2)."""
    axis = camera[2, :3]
    return float(camera[1, :3] @ axis / (axis @ axis))
