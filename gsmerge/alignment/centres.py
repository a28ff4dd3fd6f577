"""Find cameras under which Gaussians lie on the centres of pixels, and the pixel of each Gaussian.

Models that make a Gaussian of each pixel put it on or near the ray of the pixel's centre. So the right cameras project
it to a pixel centre in at least one view. Wrong cameras project it to any place in a pixel. If k views show it, its
nearest centre is then at most r pixels away with a probability of 1 - (1 - pi r^2)^k.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.alignment.score import SHUFFLED_MARGIN
from gsmerge.geometry import median
from gsmerge.kernels.elementary import power
from gsmerge.kernels.reproject import follow_pixels, nearest_centres
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras

# Approximate number of points that test cameras, and least number. Fewer points may all lie near centres by chance
_SAMPLE_POINTS, _LEAST_POINTS = 20_000, 60
# A first check uses fewer points. Its limit is wider by four standard errors of their median, which are
# 0.72 / sqrt(2000) each
_FIRST_POINTS, _ROUGHLY = 2000, 1.07
_ROWS_AT_ONCE = 1 << 16  # points that a task projects
_MIN_SEEN = 0.95  # share of the points that must be in some view; the right cameras show all
# A view is right if significantly more points than by chance lie within a radius of its centres. The radius is the
# first number times the median distance, and at most the second number of pixels. The excess is significant if it is
# larger than the third number of standard errors
_WIDE, _WIDEST_PX, _ERRORS = 2.0, 0.4, 4.0
# Largest median distance, divided by the median distance by chance. It is well below 1, because grids seen from wrong
# cameras form patterns
_NEARER = 0.9
_MIN_RIGHT = 0.9  # share of the points whose nearest centre must be in a right view
_FIRST_ROWS = 20_000  # rows that must follow the order of the pixels before all rows are tried
_MIN_PLACED = 0.99  # share of the rows that must have a pixel
_MOST_PLACES = 1 << 27  # largest product of rows and views that are followed; each takes four bytes


@dataclass(frozen=True)
class CentreCheck:
    """Distance of points from the nearest pixel centre in any view, compared with chance."""

    px: float  # median distance, pixels; inf if the views do not show most points
    chance_px: float  # median distance of points that lie anywhere in the pixels of as many views
    # Share of the points whose nearest centre is in a right view. A view is right if significantly many points lie
    # around its centres. At a wrong scale about the position of one camera, only that camera is right
    share_right: float

    @property
    def ok(self) -> bool:
        """True if points lie so much nearer to centres than by chance that these are their cameras."""
        return self.share_right >= _MIN_RIGHT and self.px <= _NEARER * self.chance_px

    @property
    def tells_pixels(self) -> bool:
        """True if points lie so near to centres that the nearest centre belongs to their own pixel."""
        return self.ok and self.px <= self.limit_px

    @property
    def limit_px(self) -> float:
        """Largest distance, pixels, at which a point counts as lying on a centre; 3 % of other points do by chance."""
        return self.chance_px / SHUFFLED_MARGIN


def sample_points(means: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Sample the points ``[n,3]`` float32 of ``valid [n]`` rows at equal steps; duplicates are removed."""
    rows = np.flatnonzero(valid)
    return np.unique(means[rows[:: max(1, len(rows) // _SAMPLE_POINTS)]], axis=0)


def check_centres(points: np.ndarray, cameras: Cameras) -> CentreCheck:
    """Measure how near points ``[n,3]`` float32 are to the centres of pixels of cameras."""
    for step in (max(1, len(points) // _FIRST_POINTS), 1):  # a few points rule out most wrong cameras
        check, views = _compare_with_chance(points[::step], cameras)
        if not check.px <= _ROUGHLY * _NEARER * check.chance_px:
            return check
    radius = min(_WIDE * check.px, _WIDEST_PX)
    share, right = math.pi * radius**2, np.zeros(len(cameras), bool)
    for view in np.unique(views).tolist():
        _, distances, _ = _find_nearest(points, cameras[view : view + 1])
        num_near, count = np.count_nonzero(distances <= radius), np.count_nonzero(distances < math.inf)
        right[view] = num_near - share * count > _ERRORS * math.sqrt(share * (1 - share) * count)
    return replace(check, share_right=float(right[views].mean()))


def _compare_with_chance(points: np.ndarray, cameras: Cameras) -> tuple[CentreCheck, np.ndarray]:
    """Compare the distances of points from pixel centres with chance.

    Also returns the view with the nearest centre, for each point that is shown in any view.
    """
    ids, distances, num_views = _find_nearest(points, cameras)
    shown = num_views > 0
    if len(points) < _LEAST_POINTS or shown.sum() < _MIN_SEEN * len(points):
        return CentreCheck(math.inf, 0.0, 0.0), ids[:0]
    exponents = 1 / num_views[shown]
    chance = np.sqrt((1 - power(np.full_like(exponents, 0.5), exponents)) / np.pi)
    return CentreCheck(median(distances), median(chance), 0.0), ids[shown] // (cameras.width * cameras.height)


def find_rows(means: np.ndarray, valid: np.ndarray, cameras: Cameras, check: CentreCheck) -> np.ndarray | None:
    """Find the pixel ``(view·H + y)·W + x`` of each row ``[n]`` from its mean ``[n,3]``.

    ``valid [n]`` bool. Some pixels may have no row, and a few rows may have no pixel, -1. If ``check`` tells pixels,
    rows may be in any order, otherwise they must be in the order of the pixels. None if too many rows have no pixel,
    for example because several rows share a pixel.
    """
    rows = np.flatnonzero(valid)
    points = np.ascontiguousarray(means[rows], np.float32)
    ids: np.ndarray | None
    if check.tells_pixels:
        ids = _find_centres(points, cameras, check.limit_px)
    else:
        ids = _follow(points, cameras, mixed=False)
        if ids is None and len(cameras) > 1:
            ids = _follow(points, cameras, mixed=True)
    if ids is None or (ids >= 0).sum() < _MIN_PLACED * len(rows):
        return None
    out = np.full(len(means), -1, np.int64)
    out[rows] = ids
    return out


def _follow(points: np.ndarray, cameras: Cameras, *, mixed: bool) -> np.ndarray | None:
    """Find the pixels ``[n]`` of rows in the order of pixels; None for rows in another order.

    A few rows may have no pixel, -1. For ``mixed`` see :func:`follow_rows`.
    """
    ids, size = None, (cameras.width, cameras.height)
    for tried in (points[:_FIRST_ROWS], points):  # the first rows rule out most other orders
        if len(tried) * len(cameras) > _MOST_PLACES:
            return None
        ids = follow_rows(tried, *_matrices(cameras), *size, mixed=mixed)
        if (ids >= 0).sum() < _MIN_PLACED * len(tried):
            return None
    return ids


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


def _find_centres(points: np.ndarray, cameras: Cameras, limit_px: float) -> np.ndarray:
    """Find the pixel ``[n]`` of each point ``[n,3]``, whose centre is within ``limit_px`` pixels; -1 without.

    If several points are nearest to the same centre, the nearest point gets the pixel. The other points get their
    nearest free pixel in another view.
    """
    ids, distances, _ = _find_nearest(points, cameras)
    out = np.full(len(points), -1, np.int64)
    owners = np.full(len(cameras) * cameras.height * cameras.width, -1)

    def place(rows: np.ndarray, ids: np.ndarray, distances: np.ndarray) -> np.ndarray:
        """Give each free pixel to the nearest of its rows; return the rows without a pixel."""
        free = (distances <= limit_px) & (owners[ids] < 0)
        order = np.flatnonzero(free)[np.argsort(-distances[free], kind="stable")]  # the last row of a pixel gets it
        owners[ids[order]] = rows[order]
        is_placed = free & (owners[ids] == rows)
        out[rows[is_placed]] = ids[is_placed]
        return rows[~is_placed]

    unplaced = place(np.arange(len(points)), ids, distances)
    for view in range(len(cameras)) if len(unplaced) else ():
        ids, distances, _ = _find_nearest(points[unplaced], cameras[view : view + 1])
        unplaced = place(unplaced, ids.clip(0) + view * cameras.height * cameras.width, distances)
    return out


def _find_nearest(points: np.ndarray, cameras: Cameras) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the pixel ``[n]`` with the nearest centre to each point ``[n,3]`` in all views.

    Also returns the distances ``[n]`` from these centres, pixels, and the number ``[n]`` of views that show each point.
    """
    count = len(points)
    ids, squares, num_views = np.empty(count, np.int64), np.empty(count), np.empty(count, np.int32)
    points, matrices = np.ascontiguousarray(points, np.float32), _matrices(cameras)

    def project(first: int) -> None:
        rows = slice(first, first + _ROWS_AT_ONCE)
        size = cameras.width, cameras.height
        nearest_centres(points[rows], *matrices, ids[rows], squares[rows], num_views[rows], *size)

    parallel_map(project, range(0, count, _ROWS_AT_ONCE))
    return ids, np.sqrt(squares), num_views


def _matrices(cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(cameras.viewmats, np.float64), np.ascontiguousarray(cameras.Ks, np.float64)
