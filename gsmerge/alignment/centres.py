"""Find cameras under which Gaussians lie on the centres of pixels, and the pixel of each Gaussian.

Models that make a Gaussian of each pixel put it on the ray of the pixel's centre, or near to it. So the right cameras
show it there in one of their views. Under wrong ones a point lies anywhere in its pixels: of k views that show it, the
nearest centre is at most r pixels off with a probability of 1 - (1 - pi r^2)^k.
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

_SAMPLE_POINTS, _LEAST_POINTS = 20_000, 60  # that cameras are tried with, about; fewer may lie near centres by chance
# Of them are compared first, and how much farther they may be off: four standard errors of their median, each
# 0.72 / sqrt(2000)
_FIRST_POINTS, _ROUGHLY = 2000, 1.07
_PART = 1 << 16  # points that are projected at once
_MIN_SEEN = 0.95  # share of the points that some view must show, as it does all that are its pixels
# Times the median distance, and pixels: about a centre lie more points than by chance, in each view, by so many
# standard errors of their number
_WIDE, _WIDEST_PX, _ERRORS = 2.0, 0.4, 4.0
_NEARER = 0.9  # times the median distance by chance, at most: lines of a grid that is seen from elsewhere make patterns
_MIN_RIGHT = 0.9  # share of the points that must be nearest to centres in views whose own points are near
_FIRST_ROWS = 20_000  # that must follow the pixels before all are tried
_MIN_PLACED = 0.99  # share of the rows that must come to pixels
_MOST_PLACES = 1 << 27  # rows times views that are followed, four bytes each


@dataclass(frozen=True)
class CentreCheck:
    """How near points are to the centres of pixels, each in the view where it is nearest, and what chance gives."""

    px: float  # median distance, pixels; inf where the views do not show most points
    chance_px: float  # the same of points that lie anywhere in the pixels of as many views
    # share of the points that are nearest to a centre in views that show more about centres than by chance: at a wrong
    # scale about the place of one camera, that camera does alone
    share_right: float

    @property
    def ok(self) -> bool:
        """Whether points lie so much nearer to centres than by chance that these are their cameras."""
        return self.share_right >= _MIN_RIGHT and self.px <= _NEARER * self.chance_px

    @property
    def tells_pixels(self) -> bool:
        """Whether points lie on centres, so that the nearest one is that of their own pixel."""
        return self.ok and self.px <= self.limit_px

    @property
    def limit_px(self) -> float:
        """Largest distance, pixels, of points that count as lying on a centre, where chance puts 3 % of others."""
        return self.chance_px / SHUFFLED_MARGIN


def sample_points(means: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return some of the points ``[n,3]`` float32 that are ``valid [n]``, evenly spread over the rows, each once."""
    rows = np.flatnonzero(valid)
    return np.unique(means[rows[:: max(1, len(rows) // _SAMPLE_POINTS)]], axis=0)


def check_centres(points: np.ndarray, cameras: Cameras) -> CentreCheck:
    """Measure how near points ``[n,3]`` float32 are to the centres of pixels of cameras."""
    for step in (max(1, len(points) // _FIRST_POINTS), 1):  # a few tell most wrong cameras
        check, views = _compare_with_chance(points[::step], cameras)
        if not check.px <= _ROUGHLY * _NEARER * check.chance_px:
            return check
    radius = min(_WIDE * check.px, _WIDEST_PX)
    share, right = math.pi * radius**2, np.zeros(len(cameras), bool)
    for view in np.unique(views).tolist():
        _, distances, _ = _find_nearest(points, cameras[view : view + 1])
        near, count = np.count_nonzero(distances <= radius), np.count_nonzero(distances < math.inf)
        right[view] = near - share * count > _ERRORS * math.sqrt(share * (1 - share) * count)
    return replace(check, share_right=float(right[views].mean()))


def _compare_with_chance(points: np.ndarray, cameras: Cameras) -> tuple[CentreCheck, np.ndarray]:
    """Compare distances of points from centres with those by chance; also return the view of each that is shown."""
    ids, distances, seen = _find_nearest(points, cameras)
    shown = seen > 0
    if len(points) < _LEAST_POINTS or shown.sum() < _MIN_SEEN * len(points):
        return CentreCheck(math.inf, 0.0, 0.0), ids[:0]
    exponents = 1 / seen[shown]
    chance = np.sqrt((1 - power(np.full_like(exponents, 0.5), exponents)) / np.pi)
    return CentreCheck(median(distances), median(chance), 0.0), ids[shown] // (cameras.width * cameras.height)


def find_rows(means: np.ndarray, valid: np.ndarray, cameras: Cameras, check: CentreCheck) -> np.ndarray | None:
    """Find the pixel ``(view·H + y)·W + x`` of each row ``[n]`` by its mean ``[n,3]``, -1 for few without.

    ``valid [n]`` bool. Rows may lack pixels; they are in any order where their ``check`` tells pixels, otherwise in the
    order of the pixels. None for other rows, as where several share a pixel.
    """
    rows = np.flatnonzero(valid)
    points, views = np.ascontiguousarray(means[rows], np.float32), len(cameras)
    ids = _find_centres(points, cameras, check.limit_px) if check.tells_pixels else None
    for mixed in (False, True)[:views] if ids is None else ():
        ids = _follow(points, cameras, mixed=mixed) if ids is None else ids
    if ids is None or (ids >= 0).sum() < _MIN_PLACED * len(rows):
        return None
    out = np.full(len(means), -1, np.int64)
    out[rows] = ids
    return out


def _follow(points: np.ndarray, cameras: Cameras, *, mixed: bool) -> np.ndarray | None:
    """Find the pixels ``[n]`` of rows in the order of pixels, -1 for few without; None for rows in another order."""
    ids, size = None, (cameras.width, cameras.height)
    for part in (points[:_FIRST_ROWS], points):
        if len(part) * len(cameras) > _MOST_PLACES:
            return None
        ids = follow_rows(part, *_matrices(cameras), *size, mixed=mixed)
        if (ids >= 0).sum() < _MIN_PLACED * len(part):
            return None
    return ids


def follow_rows(
    points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray, width: int, height: int, *, mixed: bool = False
) -> np.ndarray:
    """Find pixels ``[n]`` of rows at ``points [n,3]`` float32, as many as come in the order of pixels; -1 for others.

    The order is view by view and line by line, or if ``mixed`` line by line with the views of a pixel side by side.
    """
    count, views = len(points), len(viewmats)
    kinds = ((count, np.int64), (count, np.int64), (count, np.int32), (count * views, np.int32))
    ids, *scratch = (np.empty(size, kind) for size, kind in (*kinds, (views, np.int64), (views, np.int32)))
    follow_pixels(points, viewmats, Ks, ids, *scratch, width, height, int(mixed))
    return ids


def _find_centres(points: np.ndarray, cameras: Cameras, limit_px: float) -> np.ndarray:
    """Find the pixel ``[n]`` on whose centre each point ``[n,3]`` lies, to ``limit_px`` pixels; -1 without.

    Of points that are nearest to the same centre, the nearest stays, and others take the next one in another view.
    """
    ids, distances, _ = _find_nearest(points, cameras)
    out = np.full(len(points), -1, np.int64)
    owners = np.full(len(cameras) * cameras.height * cameras.width, -1)

    def place(rows: np.ndarray, ids: np.ndarray, distances: np.ndarray) -> np.ndarray:
        """Give each free pixel to the nearest of its rows; return the rows that have none."""
        free = (distances <= limit_px) & (owners[ids] < 0)
        order = np.flatnonzero(free)[np.argsort(-distances[free], kind="stable")]  # of one pixel the last one stays
        owners[ids[order]] = rows[order]
        first = free & (owners[ids] == rows)
        out[rows[first]] = ids[first]
        return rows[~first]

    left = place(np.arange(len(points)), ids, distances)
    for view in range(len(cameras)) if len(left) else ():
        ids, distances, _ = _find_nearest(points[left], cameras[view : view + 1])
        left = place(left, ids.clip(0) + view * cameras.height * cameras.width, distances)
    return out


def _find_nearest(points: np.ndarray, cameras: Cameras) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the nearest pixel ``[n]`` of each point, its distance, pixels, and how many pictures show the point."""
    count = len(points)
    ids, squares, seen = np.empty(count, np.int64), np.empty(count), np.empty(count, np.int32)
    points, matrices = np.ascontiguousarray(points, np.float32), _matrices(cameras)

    def project(first: int) -> None:
        part = slice(first, first + _PART)
        nearest_centres(points[part], *matrices, ids[part], squares[part], seen[part], cameras.width, cameras.height)

    parallel_map(project, range(0, count, _PART))
    return ids, np.sqrt(squares), seen


def _matrices(cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(cameras.viewmats, np.float64), np.ascontiguousarray(cameras.Ks, np.float64)
