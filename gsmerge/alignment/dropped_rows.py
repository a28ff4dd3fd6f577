"""Find the grid of rows that lack some pixels, from the rows alone: view after view, and line after line in each.

Lines have one length, or about one where pixels are missing here and there, after which the step back to the left
repeats. A projective camera that shows a few of them in their pixels shows the lines before and after in theirs, up to
where the rows of a view end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gsmerge.alignment.calibration import Calibration, calibrate
from gsmerge.alignment.layouts import Layout, dropped_layout, subsample
from gsmerge.alignment.resection import projective_camera
from gsmerge.alignment.score import find_correspondences, is_as_near
from gsmerge.kernels.elementary import arccos, cos, sin
from gsmerge.kernels.matrices import matmul
from gsmerge.types import Cameras

_MIN_SIDE, _MAX_WIDTH = 16, 2048  # pixels of a line
_LOOKED_AT = 1500  # rows whose nearest neighbour is searched among those that follow
_ALIKE, _LENGTHS = 0.02, 2  # share of them that have it as far, and such distances that are tried
_SIMILAR, _SLACK = 0.3, 0.08  # share that have it about as far, and by how much that may differ
_SEEDS, _TRIED = 12, 200  # series of lines: looked at first, and solved
_AGAIN = 3  # rounds of placing all rows of a view that lack pixels here and there
_MARGIN = 0.2  # of the length of lines that lack pixels: columns that those of a seed may lack on both sides
_ROUGH, _ROUNDS = 0.03, 12  # of a line: median error of rows that are spread evenly over it; rounds from there
_SLANT, _SLANTS = 4.0, 32  # columns by which lines may slant in all, and how many slants each way are tried
_FULL = 0.75  # share of the lines that lack more pixels than those whose rows are spread evenly at first
_OBLONG = 0.05  # by which pixels may be oblong, where rows do not show it clearly
_CLOSER = 0.99  # times the distance: another round is worth it
_COMMON, _RARE = 0.5, 0.05  # of the lines that a column has, in a few whole ones and in a view
_OUTSIDE = 1e6  # pixels
_WRAP, _BELOW = 8.0, 0.25  # times the usual step: back to the left; share of it at most, to the pixel below
_MOST_JUMPS = 100  # in a line; more are rows in no order
_MIN_LINES = 6  # whole lines in a row
_SOLVED_FROM = 800  # rows of a view that its camera is solved from
_MAX_PX = 1.0  # median distance of rows from their pixels
_GAP, _RISE = 4.0, 2.0  # pixels that a piece of a line may lack at once, and of a step to another line, at most
_CROOKED = 0.8  # mean distance of rows from their line, pixels
_SPARSE = 1.8  # pixels of a piece for each of its rows, at most
_AROUND = 3  # rows before and after
_RUN = 8  # rows from pixel to pixel that are no chance
_SAME = 2  # pixels by which the principal point may be off
_AHEAD, _MIN_AHEAD = 0.3, 2  # lines that a camera is trusted beyond those it is solved from, as a share, and at least
_MAX_MIXED = 16  # views whose rows lie side by side
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
    searches = (partial(_find_views, points, *length) for length in _find_lengths(points))
    for search in (*searches, partial(_find_mixed, points)):
        views = search()
        if sum(len(view.x) for view in views) >= _MIN_PLACED * len(rows):
            layout = _make_layout(rows, views)
            pairs = find_correspondences(means, valid, subsample(layout, _SOLVED_FROM))
            calibration = calibrate(pairs, layout.width, layout.height)
            if calibration is not None:
                return layout, calibration
    return None


def follow_rows(means: np.ndarray, valid: np.ndarray, cameras: Cameras) -> Layout | None:
    """Find the pixels of rows ``means [n,3]`` that lack some, in their ``cameras``; None if rows do not follow them.

    ``valid [n]`` bool. Rows come view after view, or pixel after pixel with the views side by side.
    """
    rows, count, width, height = np.flatnonzero(valid), len(cameras), cameras.width, cameras.height
    points = means[rows].astype(np.float64)
    projections = list(matmul(cameras.Ks, cameras.viewmats[:, :3]))
    ids, place = np.full(len(means), -1), 0
    for view, camera in enumerate(projections):
        placed, x, y = _walk(points[place:], camera, (-1, 0), width, height - 1)
        if not len(placed):
            break
        ids[rows[place + placed]] = (view * height + y) * width + x
        place += int(placed[-1]) + 1
    few = points[: _MIN_LINES * width * count]
    if (ids >= 0).sum() < _MIN_PLACED * len(rows) and 1 < count <= _MAX_MIXED:
        reach = width * height * count
        if len(_walk_mixed(few, projections, -1, width, reach)[0]) >= _MIN_PLACED * len(few):
            ids[:] = -1
            placed, keys = _walk_mixed(points, projections, -1, width, reach)
            ids[rows[placed]] = keys % count * (height * width) + keys // count
    placed_all = (ids >= 0).sum() >= _MIN_PLACED * len(rows) > 0
    return dropped_layout(ids, count, width, height) if placed_all else None


def _find_lengths(points: np.ndarray) -> list[tuple[int, int]]:
    """Find after how many rows most often the nearest neighbour of a row follows, and by how many that differs.

    Those of lines that are whole come first, then those of lines that each lack some pixels.
    """
    most = min(_MAX_WIDTH, len(points) // 4)
    starts = np.linspace(0, len(points) - most - 1, _LOOKED_AT).astype(int)
    near = np.ascontiguousarray(points.T, np.float32)  # axes first: NumPy adds up short rows slowly
    lags = [
        _MIN_SIDE + int(np.argmin(((near[:, start + _MIN_SIDE : start + most] - near[:, [start]]) ** 2).sum(0)))
        for start in starts
    ]
    counts = np.bincount(lags, minlength=2 * most)
    beside = np.maximum(np.roll(counts, 1), np.roll(counts, -1))
    peaks = np.where(counts >= beside, counts, 0)
    exact = [int(lag) for lag in np.argsort(-peaks, kind="stable")[:_LENGTHS] if peaks[lag] >= _ALIKE * len(lags)]
    sums = np.cumsum(counts)
    around = np.arange(most)
    slack = np.rint(_SLACK * around).astype(int)
    similar = sums[around + slack] - sums[np.maximum(around - slack - 1, 0)]
    middle = int(np.rint(np.flatnonzero(similar == similar.max()).mean()))
    lengths = [(lag, 0) for lag in exact]
    return [*lengths, (middle, int(slack[middle]))] if similar.max() >= _SIMILAR * len(lags) else lengths


@dataclass(frozen=True)
class _View:
    """Consecutive rows of one view, with their pixels; lines are counted from any of them."""

    rows: np.ndarray  # ``[p]`` in order
    x: np.ndarray
    y: np.ndarray
    camera: np.ndarray  # ``[3,4]`` projective
    px: float = np.inf  # median distance of rows from their pixels


def _find_views(points: np.ndarray, length: int, slack: int) -> list[_View]:
    """Find the views whose lines have ``length`` rows, up to ``slack`` more or less."""
    series = _find_lines(points, length, slack)[:_TRIED]
    first = [_solve_lines(points, starts) for starts in series[:_SEEDS]]
    nearest = min((seed.px for seed in first if seed is not None), default=None)
    if nearest is None:
        return []
    views = list[_View]()
    free = np.ones(len(points), bool)
    for i, starts in enumerate(series):
        if not free[starts[0] : starts[-1]].all():
            continue
        seed = first[i] if i < len(first) else _solve_lines(points, starts)
        if seed is not None and is_as_near(seed.px, nearest):
            margin = int(_MARGIN * length) if slack else 0  # of columns that the seed may lack
            width = int(seed.x.max()) + 1 + 2 * margin
            view = _grow(points, free, _shift(seed, margin), width)
            for _ in range(_AGAIN if slack else 0):  # columns of the seed were counted without the lines around
                view = _grow(points, free, _place_again(points, view, width), width)
            free[view.rows[0] : view.rows[-1] + 1] = False
            views.append(_common_columns(view, _RARE))
    return sorted(views, key=lambda view: int(view.rows[0]))


def _find_lines(points: np.ndarray, length: int, slack: int) -> list[np.ndarray]:
    """Find series of rows with which lines begin, one below the other and about ``length`` apart; the longest first.

    Where a line begins a long step leads back near to where the line before began.
    """
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    count = len(steps) // length * length
    usual = np.median(steps[:count].reshape(-1, length), 1).repeat(length)
    usual = np.pad(usual, (0, len(steps) - count), mode="edge")
    rows = np.flatnonzero(steps > _WRAP * usual) + 1
    if len(rows) * length > _MOST_JUMPS * len(points):
        return []
    jumps, near = steps[rows - 1], points[rows]
    before, distance = np.full(len(rows), -1), _BELOW * jumps
    for back in range(1, len(rows)):
        apart = rows[back:] - rows[:-back]
        if apart.min() > length + slack:
            break
        ids = np.flatnonzero(np.abs(apart - length) <= slack)
        there = np.linalg.norm(near[ids + back] - near[ids], axis=1)
        closer = there < distance[ids + back]
        ids, there = ids[closer], there[closer]
        before[ids + back], distance[ids + back] = ids, there
    lines = np.zeros(len(rows), np.int64)
    for i, previous in enumerate(before.tolist()):
        lines[i] = lines[previous] + 1 if previous >= 0 else 0
    series, used = [], np.zeros(len(rows), bool)
    for last in np.argsort(-lines, kind="stable").tolist():
        if lines[last] < _MIN_LINES:
            break
        chain = [last]
        while before[chain[-1]] >= 0 and not used[chain[-1]]:
            chain.append(int(before[chain[-1]]))
        if not used[chain].any():
            series.append(rows[chain[::-1]])
        used[chain] = True
    return series


def _solve_lines(points: np.ndarray, starts: np.ndarray) -> _View | None:
    """Solve for the pixels of the lines that begin at ``starts`` and their camera; None if they are no lines."""
    rows = np.arange(starts[0], starts[-1])
    lengths = np.diff(starts)
    y = np.repeat(np.arange(len(lengths)), lengths)
    longest = int(lengths.max())
    x = np.rint((rows - np.repeat(starts[:-1], lengths)) * (longest / np.repeat(lengths, lengths))).astype(np.int64)
    view = _View(rows, x, y, np.empty(0))
    full = np.repeat(lengths >= np.quantile(lengths, _FULL), lengths)
    if lengths.min() == longest:
        view = _solve(points, view)
        return view if view.px <= _MAX_PX else None
    rough = _solve(points, _View(rows[full], x[full], y[full], np.empty(0)))
    if rough.px > _ROUGH * longest:
        return None
    view = replace(view, camera=rough.camera)
    lines = pieces = starts[:-1] - starts[0]
    for turn in range(_ROUNDS):
        u, _ = _project(points[rows], view.camera)
        if turn == 0:
            u /= _column_step(u, lines, lengths, _oblongness(view.camera))
        else:  # gaps are known well enough now
            pieces = np.union1d(lines, np.flatnonzero(np.abs(np.diff(u) - 1) > 0.5) + 1)
        u, whole = _whole_columns(u, y, pieces)
        tries = [replace(view, x=x) for x in (whole, _smooth_columns(u, lines, lengths))]
        nearer = min((_solve(points, each) for each in tries), key=lambda each: each.px)
        if not nearer.px <= min(_CLOSER * view.px, _ROUGH * longest):
            break
        view = nearer
    return _common_columns(view, _COMMON) if view.px <= _MAX_PX else None


def _column_step(u: np.ndarray, starts: np.ndarray, lengths: np.ndarray, square: float) -> float:
    """Return how far apart neighbouring columns lie in ``u [n]``, if most pixels have their neighbour.

    ``square``: the same if pixels are square, which is near the truth and counts where Gaussians lie anywhere in their
    pixels.
    """
    steps = np.diff(u)
    near = steps[np.abs(steps - square) < square / 2]
    columns, _ = _count_columns(u / (near.mean() if len(near) else square), starts)
    across = columns - np.repeat(np.add.reduceat(columns, starts) / lengths, lengths)
    step = float((across * u).sum() / max(1.0, (across * across).sum()))
    return step if abs(step / square - 1) < _OBLONG else square


def _oblongness(camera: np.ndarray) -> float:
    """Return the ratio of the focal lengths of a projective camera (Hartley and Zisserman 2004, section 6.2)."""
    forward = camera[2, :3] / np.linalg.norm(camera[2, :3])
    x, y = (np.linalg.norm(axis - (axis * forward).sum() * forward) for axis in camera[:2, :3])
    return float(x / y)


def _whole_columns(u: np.ndarray, y: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Round the columns ``u [n]`` of rows in lines ``y [n]``, that are known up to a shift and a slant.

    Those of a piece, which begin at ``starts``, are rounded together. First returns ``u`` without shift and slant.
    Columns are counted from anywhere.
    """
    columns, places = _count_columns(u, starts)
    slants = np.linspace(-_SLANT, _SLANT, 2 * _SLANTS + 1) / max(1, y[-1])
    lengths = np.diff(np.append(starts, len(u)))
    turns = 2 * np.pi * (places - slants[:, None] * y[starts])
    real, imaginary = (cos(turns) * lengths).sum(1), (sin(turns) * lengths).sum(1)
    size = np.sqrt(real * real + imaginary * imaginary)
    best = size.argmax()
    turn = np.sign(imaginary[best]) * arccos((real[best] / max(size[best], 1e-300)).clip(-1, 1))
    away = slants[best] * y + turn / (2 * np.pi)
    return u - away, columns + np.repeat(np.rint(places - away[starts]).astype(np.int64), lengths)


def _common_columns(view: _View, share: float) -> _View:
    """Leave out the rows of columns that less than a share of the lines have; count columns from the first one left."""
    first = int(view.x.min())
    counts = np.bincount(view.x - first)
    common = first + np.flatnonzero(counts >= share * counts.max())
    kept = (view.x >= common[0]) & (view.x <= common[-1])
    return _shift(replace(view, rows=view.rows[kept], x=view.x[kept], y=view.y[kept]), -int(common[0]))


def _shift(view: _View, columns: int) -> _View:
    """Count columns from another one."""
    camera = view.camera.copy()
    camera[0] += columns * camera[2]
    return replace(view, x=view.x + columns, camera=camera)


def _project(points: np.ndarray, camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project points ``[n,3]``; return columns and lines, 0 at the centre of the first pixel."""
    with np.errstate(all="ignore"):
        places = matmul(points, camera[:, :3].T) + camera[:, 3]
        u, v = (np.nan_to_num(places[:, i] / places[:, 2] - 0.5, nan=-_OUTSIDE) for i in (0, 1))
    return u.clip(-_OUTSIDE, _OUTSIDE), v.clip(-_OUTSIDE, _OUTSIDE)


def _count_columns(u: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Count the columns of rows at ``u [n]`` in pieces that begin at ``starts [p]``, by whole steps from 0.

    Also returns the column ``[p]`` at which each piece begins on average.
    """
    lengths = np.diff(np.append(starts, len(u)))
    steps = np.maximum(1, np.rint(np.diff(u, prepend=0)))
    steps[starts] = 0
    sums = np.cumsum(steps)
    columns = (sums - np.repeat(sums[starts], lengths)).astype(np.int64)
    return columns, np.add.reduceat(u - columns, starts) / lengths


def _grow(points: np.ndarray, free: np.ndarray, view: _View, width: int) -> _View:
    """Grow a view over the free rows before and after it."""
    low, high = _free_range(free, view.rows)
    while True:
        lines = int(view.y.max() - view.y.min()) + 1
        reach = max(_MIN_AHEAD, int(_AHEAD * lines))
        after = _walk(points[view.rows[-1] + 1 : high], view.camera, (view.x[-1], view.y[-1]), width, reach)
        ahead = points[low : view.rows[0]][::-1]
        last = width - 1 - view.x[0], -1 - view.y[0]
        before = _walk(ahead, matmul(_backwards(width), view.camera), last, width, reach)
        if not len(after[0]) + len(before[0]):
            return view
        rows = np.concatenate([view.rows[0] - 1 - before[0][::-1], view.rows, view.rows[-1] + 1 + after[0]])
        x = np.concatenate([width - 1 - before[1][::-1], view.x, after[1]])
        y = np.concatenate([-1 - before[2][::-1], view.y, after[2]])
        grown = _solve(points, _View(rows, x, y, view.camera))
        if grown.px > _MAX_PX:
            return view
        view = grown


def _backwards(width: int) -> np.ndarray:
    """Return the matrix ``[3,3]`` that turns pixels so that the last come first."""
    return np.array([[-1, 0, width], [0, -1, 0], [0, 0, 1.0]])


def _place_again(points: np.ndarray, view: _View, width: int) -> _View:
    """Place all rows of a view by its camera."""
    first, lines = int(view.rows[0]), int(np.ptp(view.y)) + 1
    rows, x, y = _walk(points[first : view.rows[-1] + 1], view.camera, (-1, int(view.y[0])), width, lines)
    again = _solve(points, _View(first + rows, x, y, view.camera)) if len(rows) else view
    return again if again.px <= _MAX_PX else view


def _free_range(free: np.ndarray, rows: np.ndarray) -> tuple[int, int]:
    """Return the first row and the end of the free rows around some."""
    before, after = np.flatnonzero(~free[: rows[0]]), np.flatnonzero(~free[rows[-1] :])
    return int(before[-1]) + 1 if len(before) else 0, int(rows[-1] + after[0]) if len(after) else len(free)


def _solve(points: np.ndarray, view: _View) -> _View:
    """Solve for the camera of a view."""
    chosen = np.linspace(0, len(view.rows) - 1, min(_SOLVED_FROM, len(view.rows))).astype(int)
    pixels = np.stack([view.x[chosen], view.y[chosen]], 1) + 0.5
    camera, px = projective_camera(points[view.rows[chosen]], pixels)
    return replace(view, camera=camera, px=px)


def _walk(
    points: np.ndarray, camera: np.ndarray, last: tuple[int, int], width: int, reach: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Place rows that follow the pixel ``last`` one after the other, up to ``reach`` lines on.

    Rows of a piece of a line, which lacks few pixels at once, come to one line together. Returns rows ``[p]`` and their
    ``x``, ``y``; ends where as many rows as a line has do not follow the ones before.
    """
    points = points[: (reach + 1) * width]
    if not len(points):
        return (np.empty(0, np.int64),) * 3
    u, v = _project(points, camera)
    cuts = (np.abs(np.diff(u) - 1) > _GAP) | (np.abs(np.diff(v)) > _RISE)
    starts = np.flatnonzero(np.concatenate([[True], cuts]))
    lengths = np.diff(np.append(starts, len(u)))
    x = _smooth_columns(u, starts, lengths).clip(0, width - 1)
    middles = np.add.reduceat(v, starts) / lengths
    y = np.rint(middles).astype(np.int64)
    straight = np.add.reduceat(np.abs(v - np.repeat(y, lengths)), starts) <= _CROOKED * lengths
    firsts, lasts = x[starts], x[starts + lengths - 1]
    ends = u[starts], u[starts + lengths - 1]
    after, line, lost, end = last[1] * width + last[0], last[1], 0, 0
    follows = np.zeros(len(starts), bool)
    dense = lasts - firsts < _SPARSE * lengths
    inside = straight & dense & (ends[0] >= -1.5) & (ends[1] < width + 0.5) & (y <= last[1] + reach)
    pieces = zip(y.tolist(), firsts.tolist(), lasts.tolist(), lengths.tolist(), strict=True)
    for i, (height, first_x, last_x, length) in enumerate(pieces):
        if inside[i] and height * width + first_x > after:
            follows[i], after = True, height * width + last_x
        if follows[i] and (length >= _RUN or height == line):  # short pieces on other lines may be chance
            line, lost, end = height, 0, i + 1
        else:
            lost += length
            if lost > width:
                break
    follows[end:] = False
    placed = np.flatnonzero(np.repeat(follows, lengths))
    return placed, x[placed], np.repeat(y, lengths)[placed]


def _smooth_columns(u: np.ndarray, starts: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Round the columns ``u [n]`` of rows in pieces of a line that begin at ``starts [p]``.

    Gaussians lie anywhere in their pixels. So the number of pixels that a piece lacks so far is the median over some
    rows before and after, which is exact for numbers that only grow.
    """
    every = np.arange(len(u))
    first, last = np.repeat(starts, lengths), np.repeat(starts + lengths - 1, lengths)
    lacking = u - every
    around = np.stack([lacking[np.clip(every + k, first, last)] for k in range(-_AROUND, _AROUND + 1)])
    return (every + np.rint(np.median(around, 0))).astype(np.int64)


def _find_mixed(points: np.ndarray) -> list[_View]:
    """Find views whose rows lie side by side, pixel by pixel; none where rows have no such order.

    MVSplat's script with its far cut writes such rows, which nothing else aligns where its cameras are not named.
    """
    lags = np.arange(1, _MAX_MIXED + 1)
    starts = np.linspace(0, len(points) - _MAX_MIXED - 1, _LOOKED_AT).astype(int)
    steps = [float(np.median(np.linalg.norm(points[starts + lag] - points[starts], axis=1))) for lag in lags]
    count = int(lags[np.argmin(steps)])
    every = points[: len(points) // count * count : count]
    if count == 1 or len(every) < _MIN_LINES * _MIN_SIDE:
        return []
    for width, slack in _find_lengths(every):
        for begins in _find_lines(every, width, 0)[:_SEEDS] if slack == 0 else []:
            views = _solve_mixed(points, count * begins, count, width)
            if views:
                return _grow_mixed(points, views, width)
    return []


def _solve_mixed(points: np.ndarray, begins: np.ndarray, count: int, width: int) -> list[_View]:
    """Solve for the cameras of ``count`` views, in one of which lines begin at rows; none if these are no lines."""
    before = begins[1:, None] + np.arange(count) - count * np.arange(3)[:, None, None]  # by one pixel, and by another
    steps = np.linalg.norm(np.diff(points[before], axis=0), axis=-1)
    begun = np.median(steps[1], 0) > np.median(steps[0], 0)  # views whose line began a pixel earlier
    first = int((begins[0] + np.arange(count) - count * begun).min())
    number = np.arange(width * (len(begins) - 1))
    y, x = np.divmod(number, width)
    if first < 0:
        return []
    views = [_solve(points, _View(first + view + count * number, x, y, np.empty(0))) for view in range(count)]
    return views if max(view.px for view in views) <= _MAX_PX else []


def _grow_mixed(points: np.ndarray, views: list[_View], width: int) -> list[_View]:
    """Grow views side by side over the rows before and after them."""
    count = len(views)
    while True:
        rows = np.concatenate([view.rows for view in views])
        keys = np.concatenate([(view.y * width + view.x) * count + i for i, view in enumerate(views)])
        order = np.argsort(rows)
        rows, keys = rows[order], keys[order]
        reach = max(_MIN_AHEAD * width * count, int(_AHEAD * (keys[-1] - keys[0])))
        cameras = [view.camera for view in views]
        after = _walk_mixed(points[rows[-1] + 1 :], cameras, int(keys[-1]), width, reach)
        turned = [matmul(_backwards(width), camera) for camera in cameras[::-1]]
        before = _walk_mixed(points[: rows[0]][::-1], turned, -1 - int(keys[0]), width, reach)
        if not len(after[0]) + len(before[0]):
            return views
        rows = np.concatenate([rows[0] - 1 - before[0][::-1], rows, rows[-1] + 1 + after[0]])
        keys = np.concatenate([-1 - before[1][::-1], keys, after[1]])
        grown = []
        for view in range(count):
            own = keys % count == view
            y, x = np.divmod(keys[own] // count, width)
            grown.append(_solve(points, _View(rows[own], x, y, np.empty(0))))
        if max(view.px for view in grown) > _MAX_PX:
            return views
        views = grown


def _walk_mixed(
    points: np.ndarray, cameras: list[np.ndarray], last: int, width: int, reach: int
) -> tuple[np.ndarray, np.ndarray]:
    """Place rows that follow one after the other, each in the view in which the next pixel is the nearest.

    Pixels are counted line by line and with the views side by side; ``last`` is that of the row before, and ``reach``
    how far on rows are placed. Returns rows ``[p]`` and their pixels.
    """
    points, count = points[: reach + 1], len(cameras)
    keys = np.empty((len(points), count), np.int64)
    for view, camera in enumerate(cameras):
        x, y = (np.rint(values).astype(np.int64) for values in _project(points, camera))
        keys[:, view] = np.where((x >= 0) & (x < width), (y * width + x) * count + view, np.iinfo(np.int64).min)
    far, current, lost, end = last + reach, last, 0, 0
    placed: list[tuple[int, int]] = []
    for row, choices in enumerate(keys.tolist()):
        key = min((key for key in choices if current < key <= far), default=None)
        if key is not None and key - current <= _RUN * count:
            lost, end = 0, len(placed) + 1
        else:
            lost += 1
            if lost > width * count:
                break
        if key is not None:
            placed.append((row, key))
            current = key
    rows, keys = np.array(placed[:end], np.int64).reshape(-1, 2).T
    return rows, keys


def _make_layout(rows: np.ndarray, views: list[_View]) -> Layout:
    """Lay out views on one grid, in which they have the same principal point."""
    lefts, width = _place([(view.x, _principal(view, 0)) for view in views])
    tops, height = _place([(view.y, _principal(view, 1)) for view in views])
    pixels = tuple((view.y + top) * width + view.x + left for view, top, left in zip(views, tops, lefts, strict=True))
    ids = np.full(rows[-1] + 1, -1)
    for number, (view, own) in enumerate(zip(views, pixels, strict=True)):
        ids[rows[view.rows]] = number * height * width + own
    return dropped_layout(ids, len(views), width, height)


def _place(views: Sequence[tuple[np.ndarray, float]]) -> tuple[list[int], int]:
    """Choose the shifts of views along an axis, from their pixels and principal points there; also return the size."""
    firsts, middles = np.array([pixels.min() for pixels, _ in views]), np.array([middle for _, middle in views])
    sizes = np.array([pixels.max() for pixels, _ in views]) - firsts + 1
    starts = firsts - middles
    places = np.rint(starts - np.median(starts[sizes == sizes.max()])).astype(int)
    within = places.clip(0, sizes.max() - sizes)
    places = np.where(np.abs(places - within) <= _SAME, within, places)
    places -= places.min()
    return (places - firsts).tolist(), int((places + sizes).max())


def _principal(view: _View, axis: int) -> float:
    """Return a coordinate of the principal point of a projective camera (Hartley and Zisserman 2004, section 6.2)."""
    forward = view.camera[2, :3]
    return float((view.camera[axis, :3] * forward).sum() / (forward * forward).sum())
