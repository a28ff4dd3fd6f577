"""Find pixels and cameras from rows alone, if rows are sorted by view, line and column; some pixels may have no row.

If borders and far pixels have no rows, lines in the middle of views may still be complete. Between complete lines, the
long step from the right edge back to the left repeats at equal distances. A projective camera is solved from a few
complete lines. Projection by this camera gives the pixels of rows in incomplete lines, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.io.cameras.camera_file import W2C_OPENCV, CameraFile, StoredView, make_camera_file
from gsmerge.method.geometry.transforms import median
from gsmerge.method.kernels.matrices import matmul
from gsmerge.method.kernels.reproject import follow_pixels
from gsmerge.reading.alignment.calibration import calibrate
from gsmerge.reading.alignment.layouts import ESTIMATED, Layout
from gsmerge.reading.alignment.resection import projective_camera
from gsmerge.reading.alignment.score import find_correspondences, is_as_near
from gsmerge.types import Cameras

# fewest and most pixels of a line
_MIN_SIDE = 16
_MAX_WIDTH = 2048
# A length of lines is tried if at least the share _MIN_SHARE of the sampled rows shows it. At most _MAX_LENGTHS lengths
# are tried
_MIN_SHARE = 0.02
_MAX_LENGTHS = 2
# The step from the end of a line back to the left edge is at least _WRAP times the usual step. The step from the first
# point of a line to the first point of the next line is at most _BELOW times the step back to the left edge
_WRAP = 8.0
_BELOW = 0.25
_MIN_LINES = 6  # fewest complete lines in a series
_SOLVED_FROM = 800  # rows of a view that its camera is solved from
_MAX_PX = 1.0  # largest median distance of a view's rows from their pixels
# A camera that was solved from n lines is used for the next _AHEAD * n lines, but for at least _MIN_AHEAD lines
_AHEAD = 0.3
_MIN_AHEAD = 2
_MIN_PLACED = 0.9  # share of the rows that must have a pixel


def estimate_cameras(path: Path, means: np.ndarray, valid: np.ndarray) -> CameraFile | None:
    """Estimate the cameras of rows ``means [n,3]`` that are the pixels of a grid; None for other rows.

    The rows are sorted by view, line and column, or by line, column and view. In both orders some pixels may have no
    row. ``valid [n]`` bool marks the finite rows, and ``path`` is for messages.
    """
    # The step in rows from a pixel to the next pixel of the same view: at this distance in rows, pairs of points are
    # nearest to each other. The step is the number of views if rows are sorted by line, column and view. For other
    # rows, and for few rows, the step is 1
    rows = np.arange(len(means))
    step = 1
    most_views = 64  # largest step that is tried
    min_pixels = 256  # fewest pixels of a view
    longest = min(most_views, len(means) // min_pixels)
    if longest > 0:
        num_samples = 2000  # pairs of rows whose distance is measured for each step
        starts = np.linspace(0, max(0, len(means) - longest - 1), num_samples).astype(int)
        distances = [np.abs(means[starts + apart] - means[starts]).sum(1) for apart in range(1, longest + 1)]
        step = 1 + int(np.argmin([median(values[np.isfinite(values)]) for values in distances]))
    orders = (rows, rows.reshape(-1, step).T.reshape(-1)) if step > 1 and len(rows) % step == 0 else (rows,)
    # a row that is not finite may have a pixel, and is then interpolated, or may have no pixel; both are tried
    interpolated = np.stack([np.interp(rows, rows[valid], values) for values in means[valid].T], 1).astype(np.float32)
    point_sets = [(means, valid)] if valid.all() else [(means, valid), (interpolated, np.ones_like(valid))]
    for order, (points, used) in product(orders, point_sets):
        grid = find_dropped_grid(points[order], used[order])
        if grid is not None:
            layout, cameras = grid
            pixel_ids = np.empty(len(rows), np.int64)
            pixel_ids[order] = np.where(valid[order], layout.pixel_ids(), -1)
            views = [
                StoredView(f"view {view}", pose, K, (cameras.width, cameras.height))
                for view, (pose, K) in enumerate(zip(cameras.viewmats[:, :3], cameras.Ks, strict=True))
            ]
            return replace(make_camera_file(path, ESTIMATED, W2C_OPENCV, views), pixel_ids=pixel_ids)
    return None


def find_dropped_grid(means: np.ndarray, valid: np.ndarray) -> tuple[Layout, Cameras] | None:
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
        if sum(len(view.x) for view in views) < _MIN_PLACED * len(rows):
            continue
        # the views are laid out on grids of one size, so that all have about the same principal point
        lefts, width = _choose_shifts([view.x for view in views], [_principal_coordinate(view, 0) for view in views])
        tops, height = _choose_shifts([view.y for view in views], [_principal_coordinate(view, 1) for view in views])
        ids = np.full(len(means), -1)
        for number, (view, top, left) in enumerate(zip(views, tops, lefts, strict=True)):
            # the numbers of a view's rows count only finite rows
            ids[rows[view.rows]] = number * height * width + ((view.y + top) * width + view.x + left)
        layout = Layout(len(views), width, height, ids=ids)
        cameras = calibrate(find_correspondences(means, valid, layout, _SOLVED_FROM), width, height)
        if cameras is not None:
            return layout, cameras
    return None


def _find_line_lengths(points: np.ndarray) -> list[int]:
    """List the likely lengths of lines: the commonest numbers of rows from a row to its nearest later neighbour."""
    longest = min(_MAX_WIDTH, len(points) // 4)
    num_samples = 1500  # number of rows whose nearest neighbour is searched among the rows after them
    starts = np.linspace(0, len(points) - longest - 1, num_samples).astype(int)
    x, y, z = points.T.astype(np.float32)

    def find_nearest(start: int) -> int:
        """Return the distance in rows from a row to its nearest neighbour at least _MIN_SIDE rows later."""
        rows = slice(start + _MIN_SIDE, start + longest)
        dx = x[rows] - x[start]
        dy = y[rows] - y[start]
        dz = z[rows] - z[start]
        return _MIN_SIDE + int(np.argmin(dx * dx + dy * dy + dz * dz))

    counts = np.bincount([find_nearest(start) for start in starts], minlength=2 * longest)
    neighbours = np.maximum(np.roll(counts, 1), np.roll(counts, -1))
    peaks = np.where(counts >= neighbours, counts, 0)
    highest = np.argsort(-peaks, kind="stable")[:_MAX_LENGTHS]
    return [int(length) for length in highest if peaks[length] >= _MIN_SHARE * len(starts)]


@dataclass(frozen=True, eq=False)
class _GridView:
    """Consecutive rows of one view, with their pixels. Columns and lines may be counted from any number."""

    rows: np.ndarray  # ``[p]`` in order
    x: np.ndarray  # ``[p]`` columns of the pixels
    y: np.ndarray  # ``[p]`` lines of the pixels
    camera: np.ndarray  # ``[3,4]`` projective camera, from points to pixels
    px: float = np.inf  # median distance of rows from their pixels, pixels


def _find_views(points: np.ndarray, length: int) -> list[_GridView]:
    """Find the views whose lines have ``length`` rows, in the order of their rows.

    ``points [n,3]`` are the means of all rows. Each view is extended from a series of complete lines. A series is left
    out if it fits its camera worse than the best series fits its camera.
    """
    # the measure is the best of the first num_first series; at most max_series count
    num_first = 12
    max_series = 200
    series = _find_lines(points, length)[:max_series]
    first_views = [_solve_lines(points, starts) for starts in series[:num_first]]
    best_px = min((view.px for view in first_views if view is not None), default=None)
    if best_px is None:
        return []
    views = list[_GridView]()
    free = np.ones(len(points), bool)
    for i, starts in enumerate(series):
        if not free[starts[0] : starts[-1]].all():
            continue
        small_view = first_views[i] if i < len(first_views) else _solve_lines(points, starts)
        if small_view is not None and is_as_near(small_view.px, best_px):
            view = _extend_view(points, free, small_view, length)
            free[view.rows[0] : view.rows[-1] + 1] = False
            views.append(_drop_rare_columns(view))
    return sorted(views, key=lambda view: int(view.rows[0]))


def _find_lines(points: np.ndarray, length: int) -> list[np.ndarray]:
    """Find series of rows that begin consecutive lines, ``length`` rows apart; the longest series first.

    The first row of a line follows a long step back to the left, and lies near the first row of the line before. No
    line is in two series.
    """
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    in_whole_lines = len(steps) // length * length
    usual_steps = np.median(steps[:in_whole_lines].reshape(-1, length), 1).repeat(length)
    usual_steps = np.pad(usual_steps, (0, len(steps) - in_whole_lines), mode="edge")
    rows = np.flatnonzero(steps > _WRAP * usual_steps) + 1
    max_jumps = 100  # long steps per line; rows with more long steps are in no order
    if len(rows) * length > max_jumps * len(points):
        return []
    # the line before each line, or -1 for none; it begins `length` rows earlier, and is the nearest of these
    firsts = points[rows]
    before = np.full(len(rows), -1)
    least = _BELOW * steps[rows - 1]
    for back in range(1, len(rows)):
        apart = rows[back:] - rows[:-back]
        if apart.min() > length:
            break
        ids = np.flatnonzero(apart == length)
        distances = np.linalg.norm(firsts[ids + back] - firsts[ids], axis=1)
        closer = distances < least[ids + back]
        ids = ids[closer]
        distances = distances[closer]
        before[ids + back] = ids
        least[ids + back] = distances
    # series of consecutive lines
    num_before = np.zeros(len(rows), np.int64)  # number of lines before each line in its series
    for i, previous in enumerate(before.tolist()):
        num_before[i] = num_before[previous] + 1 if previous >= 0 else 0
    series = []
    used = np.zeros(len(rows), bool)
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
    """Leave out outer columns that few lines have, and number the other columns from 0.

    The camera of the result projects to the new pixels.
    """
    first = int(view.x.min())
    counts = np.bincount(view.x - first)
    least_share = 0.05  # columns in a smaller share of the lines than the fullest column are left out
    common = first + np.flatnonzero(counts >= least_share * counts.max())
    inside = (view.x >= common[0]) & (view.x <= common[-1])
    camera = view.camera.copy()
    camera[0] -= int(common[0]) * camera[2]
    return replace(view, rows=view.rows[inside], x=view.x[inside] - int(common[0]), y=view.y[inside], camera=camera)


def _extend_view(points: np.ndarray, free: np.ndarray, view: _GridView, width: int) -> _GridView:
    """Extend a view over rows before and after it, as long as its camera shows these rows in the order of pixels.

    ``free [n]`` is True for rows that no other view has. ``width`` is the length of a line in rows.
    """
    first, last = view.rows[[0, -1]]
    before = np.flatnonzero(~free[:first])
    after = np.flatnonzero(~free[last:])
    # the free rows around the view
    low = int(before[-1]) + 1 if len(before) else 0
    high = int(last + after[0]) if len(after) else len(free)
    max_lost = 16  # after more consecutive rows without a pixel, another view begins
    while True:
        top = int(view.y.min())
        num_lines = int(np.ptp(view.y)) + 1
        ahead = max(_MIN_AHEAD, int(_AHEAD * num_lines))  # lines that are tried on both sides
        first = max(low, view.rows[0] - ahead * width)
        last = min(high, view.rows[-1] + 1 + ahead * width)
        count_from_first_line = np.array([[1.0, 0, 0], [0, 1, ahead - top], [0, 0, 1]])
        viewmat = np.concatenate([view.camera, [[0, 0, 0, 1]]])
        tried = np.ascontiguousarray(points[first:last], np.float32)
        pixels = follow_rows(tried, viewmat[None], count_from_first_line[None], width, num_lines + 2 * ahead)
        rows = np.flatnonzero(pixels >= 0)
        rows = max(np.split(rows, np.flatnonzero(np.diff(rows) > max_lost) + 1), key=len)
        y, x = np.divmod(pixels[rows], width)
        larger = _solve_camera(points, _GridView(first + rows, x, y + top - ahead, view.camera)) if len(rows) else view
        if larger.px > _MAX_PX or len(larger.rows) <= len(view.rows):
            return view
        view = larger


def follow_rows(
    points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray, width: int, height: int, *, mixed: bool = False
) -> np.ndarray:
    """Find pixels ``[n]`` of rows at ``points [n,3]`` float32 so that most rows are in the order of pixels.

    The cameras are ``viewmats [v,4,4]`` and ``Ks [v,3,3]``. Rows out of order get the pixel -1. Pixels are in the order
    of view, line and column, or with ``mixed``, of line, column and view.
    """
    count = len(points)
    views = len(viewmats)
    ids = np.empty(count, np.int64)
    scratch_of_rows = np.empty(count, np.int64), np.empty(count, np.int32), np.empty(count * views, np.int32)
    scratch = *scratch_of_rows, np.empty(views, np.int64), np.empty(views, np.int32), np.empty(views, np.int64)
    follow_pixels(points, viewmats, Ks, ids, *scratch, width, height, int(mixed))
    return ids


def _solve_camera(points: np.ndarray, view: _GridView) -> _GridView:
    """Return a view with the camera that shows its rows nearest to their pixels, and with their median distance."""
    sample = np.linspace(0, len(view.rows) - 1, min(_SOLVED_FROM, len(view.rows))).astype(int)
    pixels = np.stack([view.x[sample], view.y[sample]], 1) + 0.5
    camera, px = projective_camera(points[view.rows[sample]], pixels)
    depths = matmul(points[view.rows[sample]], camera[2, :3]) + camera[2, 3]
    sign = np.copysign(1.0, np.median(depths))  # sign with which the points are in front of the camera
    return replace(view, camera=camera * sign, px=px)


def _choose_shifts(coordinates: Sequence[np.ndarray], middles: Sequence[float]) -> tuple[list[int], int]:
    """Choose the shift of each view along an axis, and the size of the grid along this axis; all in pixels.

    ``coordinates`` are the coordinates of each view's pixels along the axis. ``middles`` are the coordinates of the
    views' principal points.
    """
    firsts = np.array([pixels.min() for pixels in coordinates])
    sizes = np.array([pixels.max() for pixels in coordinates]) - firsts + 1
    starts = firsts - np.array(middles)
    corners = np.rint(starts - np.median(starts[sizes == sizes.max()])).astype(int)  # relative to the largest view
    inside = corners.clip(0, sizes.max() - sizes)
    tolerance = 2  # difference of principal points, pixels, up to which views stay within the largest view
    corners = np.where(np.abs(corners - inside) <= tolerance, inside, corners)
    corners -= corners.min()
    return (corners - firsts).tolist(), int((corners + sizes).max())


def _principal_coordinate(view: _GridView, axis: int) -> float:
    """Return the coordinate along ``axis`` of the principal point of a view's projective camera, in pixels.

    The principal point follows from the camera's matrix (Hartley and Zisserman 2004, section 6.2).
    """
    forward = view.camera[2, :3]
    return float((view.camera[axis, :3] * forward).sum() / (forward * forward).sum())
