"""Pixels of rows in no order, where Gaussians were made on the rays of their pixels' centres.

A Gaussian then projects to the very centre of a pixel in its own view, and anywhere in a pixel of the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gsmerge.io.alignment.layouts import Layout
from gsmerge.io.alignment.pruned import Project, projector
from gsmerge.runtime.threads import parallel_map

TOLERANCES = (0.05, 0.02, 0.01, 0.005, 0.002)  # pixels from a centre that count as being there
MIN_SHARE = 0.9  # of the rows at the centre of a pixel of some view, and of those that come to a pixel in the end
MAX_CHANCE = 0.2  # of that share: as many at a second view's centre, or at the corners of pixels, are chance
_SAMPLES = 20_000  # rows that the file is judged by
_MIN_ROWS = 500
_CHUNK = 1 << 15  # rows at a time
_SMALLEST_PX, _SMALLEST_COLOR = 1e-4, 0.005  # what distances are measured in, at least

ColorOf = Callable[[np.ndarray, int, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class _Spread:
    """How far rows are from what is theirs.

    Args:
        tolerance: Pixels from a centre within which a view may be a row's own.
        px: Median distance from the centre in the own view, pixels.
        color: Median distance of the base colour from the photo in the own view; inf without photos.
    """

    tolerance: float
    px: float
    color: float


def unordered_layout(
    points: np.ndarray,
    viewmats: np.ndarray,
    Ks: np.ndarray,
    width: int,
    height: int,
    *,
    color_of: ColorOf | None = None,
) -> Layout | None:
    """Which pixel of which view every row is, for cameras in the frame of the Gaussians.

    Each row goes to the view in which it is nearest to a pixel's centre; between several that are near, the colours
    of the photos count as well. A pixel keeps the row that fits it best, the others go to their second choice.

    Args:
        points: ``[n,3]`` float64, all finite.
        viewmats: ``[c,4,4]``.
        Ks: ``[c,3,3]``.
        width: Of the grid, pixels.
        height: The same.
        color_of: ``(rows, view, pixels) -> [r]`` distances of the rows' base colours from the photo there.

    Returns:
        A layout; None unless nearly all rows are at centres, and many more than by chance.
    """
    project, views = projector(points, viewmats, Ks), len(viewmats)
    spread = _spread(project, len(points), views, width, height, color_of)
    if spread is None:
        return None
    chunks = [np.arange(a, min(a + _CHUNK, len(points))) for a in range(0, len(points), _CHUNK)]
    choices = parallel_map(lambda rows: _choices(project, rows, views, width, height, spread, color_of), chunks)
    slots, cost = np.concatenate([c[0] for c in choices]), np.concatenate([c[1] for c in choices])
    owner = _settled(slots, cost, views * width * height)
    taken = np.flatnonzero(owner >= 0)
    if len(taken) < MIN_SHARE * len(points):
        return None
    parts = np.split(taken, np.searchsorted(taken, np.arange(1, views) * width * height))
    used = tuple(view for view in range(views) if len(parts[view]))
    lost = len(points) - len(taken)
    return Layout(
        words=f"{views * width * height - len(taken):,} pixels of {len(used)} views dropped, in no order"
        + (f", {lost:,} rows without a pixel" if lost else ""),
        kind="pruned",
        order="unordered",
        width=width,
        height=height,
        views=used,
        rows=tuple(owner[parts[view]] for view in used),
        pixels=tuple(parts[view] - view * width * height for view in used),
    )


def _spread(
    project: Project, count: int, views: int, width: int, height: int, color_of: ColorOf | None
) -> _Spread | None:
    """How near rows are to the centres of pixels, on a sample; None where it may be chance.

    Chance is what the same rows show at the corners of pixels, where only views that are not their own have any, and
    what they show in the second nearest view: cameras side by side share rows of pixels, so it is more than the area.
    """
    if count < _MIN_ROWS:
        return None
    rows = np.unique(np.linspace(0, count - 1, _SAMPLES).astype(np.int64))
    centre, pixels = _distances(project, rows, views, width, height)
    corner, _ = _distances(project, rows, views, width, height, shift=0.5)
    ranked = np.sort(centre, axis=1)
    second = ranked[:, 1] if views > 1 else np.full(len(rows), np.inf)
    for tolerance in TOLERANCES:
        near, by_chance = ranked[:, 0] < tolerance, max(np.mean(second < tolerance), np.mean(corner.min(1) < tolerance))
        if near.mean() < MIN_SHARE:
            return None
        if by_chance <= MAX_CHANCE * near.mean():
            break
    else:
        return None
    sure = np.flatnonzero(near & (second >= tolerance))
    own = centre[sure].argmin(1)
    colors = [np.inf]
    if color_of is not None:
        colors = [*np.concatenate([color_of(rows[sure[own == v]], v, pixels[sure[own == v], v]) for v in range(views)])]
    px = float(np.median(ranked[near, 0]))
    return _Spread(tolerance, max(px, _SMALLEST_PX), max(float(np.median(colors)), _SMALLEST_COLOR))


def _distances(
    project: Project, rows: np.ndarray, views: int, width: int, height: int, *, shift: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """``[r,c]`` distances from the nearest pixel's centre in each view, inf outside; and that pixel ``y·W + x``."""
    distances = np.full((len(rows), views), np.inf, np.float32)
    pixels = np.zeros((len(rows), views), np.int32)
    for view in range(views):
        u, v = project(rows, view)
        with np.errstate(invalid="ignore"):
            inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        u, v = u[inside], v[inside]
        pixels[inside, view] = v.astype(np.int32) * width + u.astype(np.int32)
        du, dv = (x + shift - np.floor(x + shift) - 0.5 for x in (u, v))
        distances[inside, view] = np.sqrt(du * du + dv * dv)
    return distances, pixels


def _choices(
    project: Project, rows: np.ndarray, views: int, width: int, height: int, spread: _Spread, color_of: ColorOf | None
) -> tuple[np.ndarray, np.ndarray]:
    """``[r,2]`` slots ``view·H·W + pixel`` that the rows want first and second, -1 for none; and what each costs."""
    distances, pixels = _distances(project, rows, views, width, height)
    near = distances < spread.tolerance
    torn = near.sum(1) > 1
    cost = distances / np.float32(spread.px)
    cost[torn[:, None] & ~near] = np.inf
    if color_of is not None:
        for view in range(views):
            some = np.flatnonzero(torn & near[:, view])
            cost[some, view] += color_of(rows[some], view, pixels[some, view]) / spread.color
    every, slots, costs = np.arange(len(rows)), [], []
    for _ in range(2):
        view = cost.argmin(1)
        found = cost[every, view]
        slots.append(np.where(np.isfinite(found), view * (width * height) + pixels[every, view].astype(np.int64), -1))
        costs.append(found)
        cost[every, view] = np.inf
    return np.stack(slots, 1), np.stack(costs, 1)


def _settled(slots: np.ndarray, cost: np.ndarray, size: int) -> np.ndarray:
    """``[size]`` the row that each slot keeps, -1 for none: the cheapest; second choices only take what is free."""
    owner = np.full(size, -1, np.int64)
    waiting = np.arange(len(slots))
    for choice in range(2):
        wanted = slots[waiting, choice]
        asking = waiting[(wanted >= 0) & (owner[wanted] < 0)]
        asking = asking[np.argsort(-cost[asking, choice], kind="stable")]
        owner[slots[asking, choice]] = asking  # of several the last one stays: the cheapest
        placed = np.zeros(len(slots), bool)
        placed[owner[owner >= 0]] = True
        waiting = np.flatnonzero(~placed)
    return owner
