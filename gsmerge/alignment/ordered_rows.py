"""Find the pixels of rows in a file that lacks some, unknown which, but keeps an order.

View by view: where one view ends and the next begins, the projected rows start again from the top, and within a
view the pixels only go forward. Pixel by pixel: the views of one pixel are side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.alignment.layouts import Layout
from gsmerge.alignment.score import scale_by
from gsmerge.geometry import Similarity, project_points
from gsmerge.kernels.elementary import exp, log
from gsmerge.kernels.view_paths import cheapest_views
from gsmerge.types import Cameras

MIN_RUN = 500  # rows of a view; fewer cannot be distinguished from noise
WINDOW = 40  # rows averaged on either side of a restart
RESTART = 0.25  # of the image's height: how far back a restart goes at least
SHORT = 1500  # rows that say which view a run is of
SCALES = np.geomspace(1 / 30, 30, 69)  # of the cameras' positions, tried in turn
SPAN = 1.25  # factor by which the first guess of the scale may be off
MAX_SCALES = 400  # that are tried
TRIED_RUNS, STRETCH = 4, 2000  # runs, and rows of each in a row, that a scale is tried on
_SMALL = 1e-6  # weight of a point that says nothing
_MAX_UNEVENNESS = 10.0  # of one run, so that no single one decides
FAR_PX, FAR = 10.0, 0.1  # pixels, and share of the shorter side, beyond which no finer scale helps
MAX_BACK = 0.01  # share of the steps that may go back; of rows in no such order a quarter or more do
MIN_CHANGES = 0.3  # share of the steps that change the view: fewer are views one after the other
PROBES, PROBE = 5, 4000  # pieces of a file that are tried first, and the rows of each
NEAR_PX = 0.25  # from a pixel's centre, each way: a quarter of any projections lie there
GATHERED = 6.0  # standard deviations above that chance at which a scale is believed
MAX_SCALED_VIEWS = 16  # of more, each shows too few of the rows to tell a scale from chance
_SCALE_STEP, _SCALES_AT_ONCE = 1e-3, 64  # step of the scale's logarithm; scales at a time
_FEW_SHOWN, _MANY_SHOWN, _LIKELY = 1600, 9600, 512  # projections in all views, at all scales and at the likely ones
MAX_PATH_VIEWS = 127  # that an int8 can count
MAX_CELLS = 300_000_000  # rows times views that are worth the memory


@dataclass(frozen=True)
class ProjectedRows:
    """n finite rows of a file, and the cameras of the c views that they may belong to.

    Searches take these and return a layout that is not scored yet, or None if the rows do not look like it.
    """

    points: np.ndarray  # ``[n,3]`` float64 means
    ids: np.ndarray  # ``[n]`` rows of the file
    cameras: Cameras  # at the size of the grid, in the frame of the Gaussians

    def __len__(self) -> int:
        return len(self.points)

    def with_frame(self, frame: Similarity) -> ProjectedRows:
        """Return the same rows with the cameras moved into another frame."""
        return replace(self, cameras=frame.move(self.cameras))

    def project(self, rows: np.ndarray | slice, view: int) -> tuple[np.ndarray, np.ndarray]:
        """Project rows to image coordinates x ``[r]`` and y ``[r]``, pixels; NaN behind the camera."""
        with np.errstate(all="ignore"):
            xy, depth = project_points(self.points[rows], self.cameras.viewmats[view], self.cameras.Ks[view])
        xy[depth <= 0] = np.nan
        return xy[:, 0], xy[:, 1]

    def pixels(self, rows: np.ndarray | slice, view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the pixels ``y·W + x`` that rows project into, ``[r]`` int32, -1 outside; also the projections."""
        u, v = self.project(rows, view)
        inside = (u >= 0) & (v >= 0) & (u < self.cameras.width) & (v < self.cameras.height)
        pixels = np.full(len(u), -1, np.int32)
        pixels[inside] = v[inside].astype(np.int32) * self.cameras.width + u[inside].astype(np.int32)
        return pixels, u, v

    def layout(
        self, order: str, parts: Sequence[tuple[int, np.ndarray, np.ndarray]], *, missing: int, note: str = ""
    ) -> Layout:
        """Make a layout from parts of (view, rows, pixels of the rows); ``missing``: number of pixels without a row."""
        words = "in no order" if order == "unordered" else order
        return Layout(
            description=f"{missing:,} pixels of {len(parts)} views dropped, {words}{note}",
            kind="pruned",
            order=order,
            width=self.cameras.width,
            height=self.cameras.height,
            views=tuple(view for view, _, _ in parts),
            rows=tuple(self.ids[rows] for _, rows, _ in parts),
            pixels=tuple(pixels for _, _, pixels in parts),
        )


def read_view_major(rows: ProjectedRows) -> Layout | None:
    """Find the pixel of every row in a file that stores view after view; None if the views' rows cannot be found."""
    runs = _find_runs(rows)
    if runs is None:
        return None
    width, height = rows.cameras.width, rows.cameras.height
    parts = []
    for view, ids in runs:
        u, v = rows.project(ids, view)
        pixels = assign_pixels(u, v, width, height)
        if not _distance(u, v, pixels, width) <= max(FAR_PX, FAR * min(width, height)):
            return None
        parts.append((view, ids, pixels))
    return rows.layout("view-major", parts, missing=len(runs) * width * height - len(rows))


def _distance(u: np.ndarray, v: np.ndarray, pixels: np.ndarray, width: int) -> float:
    """Measure the median distance of projected rows from their pixels; behind the camera it is ``width``."""
    y, x = np.divmod(pixels, width)
    away = np.hypot(u - x - 0.5, v - y - 0.5)
    return float(np.median(np.where(np.isfinite(away), away, width)))


def _find_runs(rows: ProjectedRows) -> list[tuple[int, np.ndarray]] | None:
    """Find (view, rows) of each run, views increasing; None if the rows do not look like runs."""
    count, views, largest = len(rows), len(rows.cameras), rows.cameras.width * rows.cameras.height
    start, view = 0, -1
    parts: list[np.ndarray] = []
    costs: list[np.ndarray] = []
    while start < count:
        window = np.arange(start, min(count, start + SHORT))
        cost = np.array([_unevenness(*rows.project(window, view)) for view in range(views)])
        if len(parts) == views or not np.isfinite(cost).any():
            return None
        later = cost[view + 1 :]
        view = view + 1 + int(np.argmin(later)) if np.isfinite(later).any() else int(np.argmin(cost))
        end = _run_end(rows, start, min(count, start + largest), view)
        if end - start < MIN_RUN:
            return None
        parts.append(np.arange(start, end, dtype=np.int64))
        costs.append(cost)
        start = end
    chosen = _increasing(np.array(costs))
    return None if chosen is None else list(zip(chosen, parts, strict=True))


def _increasing(costs: np.ndarray) -> list[int] | None:
    """Choose a column for each row of ``costs [b,v]``, in rising order, with the smallest sum; None if all are inf."""
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
    """Measure how far the typical step between rows is from one pixel to the right, pixels."""
    du, dv = np.diff(u), np.diff(v)
    good = np.isfinite(du) & np.isfinite(dv)
    if good.sum() < max(8, 0.5 * len(du)):
        return np.inf
    return float(abs(np.median(du[good]) - 1) + np.median(np.abs(du[good] - 1)) + np.median(np.abs(dv[good])))


def _run_end(rows: ProjectedRows, start: int, stop: int, view: int) -> int:
    """Find the row after the last one of the run: the first clear restart, at its steepest step."""
    height = rows.cameras.height
    _, v = rows.project(np.arange(start, stop), view)
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
    """Assign strictly rising pixels to the rows of one view, projected to ``u [n]``, ``v [n]``; NaN if unknown.

    Rows are cut into scanlines where u falls back. The picture row of a scanline is the median of v, and never falls.
    Given that row, ``pixel - rank`` never falls either: isotonic regression finds it, and averages the jitter between
    gaps.
    """
    count, finite = len(u), np.isfinite(u) & np.isfinite(v)
    u, v = np.where(finite, u, 0.0), np.where(finite, v, 0.0)
    du = np.diff(u)
    noise = float(np.median(np.abs(du[finite[1:] & finite[:-1]] - 1))) if (finite[1:] & finite[:-1]).any() else 0.0
    cut = (du < -max(2.0, 4 * noise + 1)) & finite[1:] & finite[:-1]
    scanline = np.concatenate([[0], np.cumsum(cut)])
    counts = np.bincount(scanline[finite], minlength=scanline[-1] + 1)
    medians, nonempty = np.zeros(len(counts)), np.flatnonzero(counts)
    if len(nonempty):
        ordered = v[finite][np.lexsort((v[finite], scanline[finite]))]
        first = np.cumsum(counts)[nonempty] - counts[nonempty]
        lower, upper = first + (counts[nonempty] - 1) // 2, first + counts[nonempty] // 2
        medians[nonempty] = (ordered[lower] + ordered[upper]) / 2
    rows = _never_falling(medians, np.maximum(counts, _SMALL))
    row = np.clip(np.floor(rows), 0, height - 1)[scanline]
    rank = np.arange(count)
    sure = finite & (np.abs(v - row - 0.5) < 2 + 4 * noise) & (u > -2 - 4 * noise) & (u < width + 2 + 4 * noise)
    key = row * width + np.clip(u, 0, width) - 0.5 - rank
    pixels = _never_falling(key, np.where(sure, 1.0, _SMALL))
    return np.asarray(np.clip(np.rint(pixels), 0, width * height - count), np.int64) + rank


def _never_falling(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Compute the nearest non-decreasing sequence in the sense of weighted least squares."""
    from scipy.optimize import isotonic_regression  # loads slowly, and is seldom needed

    return np.asarray(isotonic_regression(values, weights=weights).x)


def rough_scale(rows: ProjectedRows) -> float | None:
    """Find the scale of the camera positions at which rows step by single pixels; no pixel need be known.

    None if no scale gives such steps in any view.
    """
    views = len(rows.cameras)
    middles = (np.arange(views) + 0.5) / views * len(rows)
    windows = [
        np.arange(middle - SHORT // 4, middle + SHORT // 4).clip(0, len(rows) - 1).astype(np.int64)
        for middle in middles
    ]

    def cost(scale: float) -> float:
        there = rows.with_frame(scale_by(scale))
        uneven = (_unevenness(*there.project(window, view)) for view, window in enumerate(windows))
        return float(np.mean([min(pixels, _MAX_UNEVENNESS) for pixels in uneven]))

    best = float(min(SCALES, key=cost))
    if cost(best) >= _MAX_UNEVENNESS:
        return None
    for width_of_search in (1.08, 1.02, 1.005):
        best = float(min(best * np.geomspace(1 / width_of_search, width_of_search, 9), key=cost))
    return best


def finer_scale(rows: ProjectedRows, layout: Layout, rough: float) -> float:
    """Refine the scale, within a quarter of ``rough``, so that rows lie nearest to their assigned pixels.

    Small moves do not change the assignment, so scales are tried in steps that move most rows by at most a quarter of a
    pixel.
    """
    chosen = np.unique(np.linspace(0, len(layout.views) - 1, TRIED_RUNS).astype(int))
    starts = [max(0, (len(layout.rows[b]) - STRETCH) // 2) for b in chosen]
    parts = [(layout.views[b], layout.rows[b][a : a + STRETCH]) for b, a in zip(chosen, starts, strict=True)]

    def projected(scale: float) -> list[tuple[np.ndarray, np.ndarray]]:
        there = rows.with_frame(scale_by(scale))
        return [there.project(ids, view) for view, ids in parts]

    def distance(u: np.ndarray, v: np.ndarray) -> float:
        return _distance(u, v, assign_pixels(u, v, layout.width, layout.height), layout.width)

    def cost(scale: float) -> float:
        return float(np.mean([distance(u, v) for u, v in projected(scale)]))

    here, there = projected(rough), projected(rough * 1.001)
    moved = np.concatenate([np.hypot(b[0] - a[0], b[1] - a[1]) for a, b in zip(here, there, strict=True)]) / 0.001
    speed = float(np.nanquantile(moved, 0.9)) if np.isfinite(moved).any() else 0.0
    if speed <= 0:
        return rough
    step = max(0.25 / speed, 2 * log(SPAN) / MAX_SCALES)
    best = rough
    for reach in (max(step, log(SPAN)), step, step / 8):
        near = best * exp(np.linspace(-reach, reach, 2 * max(1, int(np.ceil(reach / step))) + 1))
        best = float(min(near, key=cost))
        step = min(step, reach) / 8
    return best


def concentrated_scale(rows: ProjectedRows) -> float | None:
    """Find the scale of the camera positions at which rows, in any order, project to pixel centres.

    None if no scale within a factor of 30 concentrates them beyond chance.
    """
    views = len(rows.cameras)
    if not 1 < views <= MAX_SCALED_VIEWS or len(rows) < MIN_RUN * views:
        return None
    limit = log(float(SCALES[-1]))
    grid = exp(np.arange(-limit, limit, _SCALE_STEP))
    few = _gathered(rows, grid, _FEW_SHOWN)
    likely = grid[np.sort(np.argsort(-few, kind="stable")[:_LIKELY])]
    many = _gathered(rows, likely, _MANY_SHOWN)
    if not many.max() >= GATHERED:
        return None
    closer = float(likely[many.argmax()]) * exp(np.linspace(-_SCALE_STEP, _SCALE_STEP, 41))
    return float(closer[_gathered(rows, closer, _MANY_SHOWN).argmax()])


def _gathered(rows: ProjectedRows, scales: np.ndarray, shown: int) -> np.ndarray:
    """Measure how many more projections than by chance are near pixel centres at each scale, standard deviations."""
    cameras, views = rows.cameras, len(rows.cameras)
    points = rows.points[np.linspace(0, len(rows) - 1, shown // views).astype(np.int64)]
    K, E = cameras.Ks.astype(np.float64), cameras.viewmats.astype(np.float64)
    turned = [sum(E[:, i, j, None] * points[:, j] for j in range(3)) for i in range(3)]
    turned = [part.astype(np.float32) for part in turned]
    t, K = E[:, :3, 3, None].astype(np.float32), K.astype(np.float32)

    def gather(s: np.ndarray) -> np.ndarray:
        z = turned[2] + s * t[:, 2]
        inside, near = z > 0, z > 0
        for i, side in enumerate((cameras.width, cameras.height)):
            with np.errstate(all="ignore"):  # rows in a camera's plane
                x = (turned[i] + s * t[:, i]) / z * K[:, i, i, None] + K[:, i, 2, None]
                near &= np.abs(x - np.floor(x) - 0.5) < NEAR_PX
            inside &= (x >= 0) & (x < side)
        count, close = inside.sum((1, 2)), (inside & near).sum((1, 2))
        chance = 4 * NEAR_PX**2
        deviations = (close - chance * count) / np.sqrt(chance * (1 - chance) * np.maximum(count, 1))
        return np.where(4 * views * count > inside[0].size, deviations, 0.0)

    columns = scales.astype(np.float32)[:, None, None]
    return np.concatenate([gather(columns[a : a + _SCALES_AT_ONCE]) for a in range(0, len(scales), _SCALES_AT_ONCE)])


def read_view_fastest(rows: ProjectedRows) -> Layout | None:
    """Find the pixel of every row in a file that stores the views of a pixel together.

    Every row lies in a pixel of every view. In the order of the file the true pixels only go forward, and so do the
    views within a pixel. The path through the views with the smallest steps is chosen. None if it goes back, or hardly
    changes views.
    """
    count, views = len(rows), len(rows.cameras)
    if not 1 < views <= MAX_PATH_VIEWS or count < MIN_RUN * views or count * views > MAX_CELLS:
        return None
    if count > PROBES * PROBE:  # a few pieces quickly show the many files that have no such order
        starts = np.linspace(0, count - PROBE, PROBES).astype(int)
        if not all(_best_path(_pixels_in_views(rows, slice(start, start + PROBE)))[1] for start in starts):
            return None
    pixels = _pixels_in_views(rows, slice(None))
    chosen, goes_forward = _best_path(pixels)
    if not goes_forward:
        return None
    chosen_pixel = pixels[np.arange(count), chosen]
    parts = []
    for view in range(views):
        ids = np.flatnonzero((chosen == view) & (chosen_pixel >= 0))
        first = np.unique(chosen_pixel[ids], return_index=True)[1]  # a step back may come to a pixel twice
        ids = ids[np.sort(first)]
        parts.append((view, ids, chosen_pixel[ids].astype(np.int64)))
    if min(len(ids) for _, ids, _ in parts) < MIN_RUN:
        return None
    return rows.layout("view-fastest", parts, missing=views * rows.cameras.width * rows.cameras.height - count)


def _best_path(pixels: np.ndarray) -> tuple[np.ndarray, bool]:
    """Choose the view ``[n]`` of every row; also return whether the pixels then only go forward."""
    chosen = np.empty(len(pixels), np.int64)
    back = cheapest_views(pixels, np.zeros(pixels.shape, np.int8), chosen)
    return chosen, bool(back <= MAX_BACK * len(pixels) and np.mean(chosen[1:] != chosen[:-1]) >= MIN_CHANGES)


def _pixels_in_views(rows: ProjectedRows, part: slice) -> np.ndarray:
    """Find the pixel ``[r,c]`` int32 of a selection of rows in each view; -1 outside."""
    return np.stack([rows.pixels(part, view)[0] for view in range(len(rows.cameras))], 1)
