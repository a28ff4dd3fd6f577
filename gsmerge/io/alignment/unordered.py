"""Pixels of rows in no order, where Gaussians were made on the rays of their pixels' centres.

A Gaussian then projects to the very centre of a pixel in its own view, and anywhere in a pixel of the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gsmerge.io.alignment.layouts import Layout
from gsmerge.io.alignment.projected_rows import MIN_BLOCK, ProjectedRows
from gsmerge.runtime.threads import parallel_map

TOLERANCES = (0.05, 0.02, 0.01, 0.005, 0.002)  # pixels from a centre that count as being there
MIN_SHARE = 0.9  # of the rows at the centre of a pixel of some view, and of those that come to a pixel in the end
MAX_CHANCE = 0.2  # of that share: as many at a second view's centre, or at the corners of pixels, are chance
_SAMPLES = 20_000  # rows that the file is judged by
_CHUNK = 1 << 15  # rows at a time
_SMALLEST_PX, _SMALLEST_COLOR = 1e-4, 0.005  # units of the distances, at least

# (rows, view, pixels) -> [r] distances of the rows' base colours from the photo there, 0 to 1
ColorOf = Callable[[np.ndarray, int, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class _Spread:
    """How far rows are from their own pixels."""

    tolerance: float  # pixels from a centre within which a view may be a row's own
    px: float  # median distance from the centre in the own view, pixels
    color: float  # median distance of the base colour from the photo in the own view; inf without photos


def unordered_layout(rows: ProjectedRows, *, color_of: ColorOf | None = None) -> Layout | None:
    """Which pixel of which view every row is; None unless nearly all are at centres, and many more than by chance.

    Each row goes to the view in which it is nearest to a pixel's centre; between several that are near, the colours of
    the photos count as well. A pixel keeps the row that fits it best, the others go to their second choice.
    """
    count, num_pixels = len(rows), rows.width * rows.height
    spread = _measure_spread(rows, color_of)
    if spread is None:
        return None
    chunks = [np.arange(a, min(a + _CHUNK, count)) for a in range(0, count, _CHUNK)]
    choices = parallel_map(lambda some: _choices(rows, some, spread, color_of), chunks)
    slots, cost = np.concatenate([c[0] for c in choices]), np.concatenate([c[1] for c in choices])
    owner = _assign(slots, cost, rows.num_views * num_pixels)
    used = np.flatnonzero(owner >= 0)
    if len(used) < MIN_SHARE * count:
        return None
    slots_of_views = np.split(used, np.searchsorted(used, np.arange(1, rows.num_views) * num_pixels))
    parts = [(view, owner[own], own - view * num_pixels) for view, own in enumerate(slots_of_views) if len(own)]
    lost = count - len(used)
    note = f", {lost:,} rows without a pixel" if lost else ""
    return rows.layout("unordered", parts, missing=rows.num_views * num_pixels - len(used), note=note)


def _measure_spread(rows: ProjectedRows, color_of: ColorOf | None) -> _Spread | None:
    """How near rows are to the centres of pixels, on a sample; None where it may be chance.

    Chance is what the same rows show at the corners of pixels, where only views that are not their own have any, and
    what they show in the second nearest view: cameras side by side share rows of pixels, so it is more than the area.
    """
    if len(rows) < MIN_BLOCK:
        return None
    some = np.unique(np.linspace(0, len(rows) - 1, _SAMPLES).astype(np.int64))
    centre, pixels = _distances(rows, some)
    corner, _ = _distances(rows, some, shift=0.5)
    ranked = np.sort(centre, axis=1)
    second = ranked[:, 1] if rows.num_views > 1 else np.full(len(some), np.inf)
    for tolerance in TOLERANCES:
        near, by_chance = ranked[:, 0] < tolerance, max(np.mean(second < tolerance), np.mean(corner.min(1) < tolerance))
        if near.mean() < MIN_SHARE:
            return None
        if by_chance <= MAX_CHANCE * near.mean():
            break
    else:
        return None
    color = np.inf
    if color_of is not None:
        sure = np.flatnonzero(near & (second >= tolerance))
        own = centre[sure].argmin(1)
        ids = [sure[own == view] for view in range(rows.num_views)]
        colors = [color_of(some[part], view, pixels[part, view]) for view, part in enumerate(ids)]
        color = float(np.median(np.concatenate(colors)))
    px = float(np.median(ranked[near, 0]))
    return _Spread(tolerance, max(px, _SMALLEST_PX), max(color, _SMALLEST_COLOR))


def _distances(rows: ProjectedRows, some: np.ndarray, *, shift: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """``[r,c]`` distances from the nearest pixel's centre in each view, inf outside; and that pixel ``y·W + x``."""
    distances = np.full((len(some), rows.num_views), np.inf, np.float32)
    pixels = np.zeros((len(some), rows.num_views), np.int32)
    for view in range(rows.num_views):
        pixels[:, view], u, v = rows.pixels(some, view)
        inside = pixels[:, view] >= 0
        du, dv = (x + shift - np.floor(x + shift) - 0.5 for x in (u[inside], v[inside]))
        distances[inside, view] = np.sqrt(du * du + dv * dv)
    return distances, pixels


def _choices(
    rows: ProjectedRows, some: np.ndarray, spread: _Spread, color_of: ColorOf | None
) -> tuple[np.ndarray, np.ndarray]:
    """``[r,2]`` slots ``view·H·W + pixel`` that are best and second best for some rows, -1: none; and costs."""
    distances, pixels = _distances(rows, some)
    near = distances < spread.tolerance
    torn = near.sum(1) > 1
    cost = distances / np.float32(spread.px)
    cost[torn[:, None] & ~near] = np.inf
    if color_of is not None:
        for view in range(rows.num_views):
            ids = np.flatnonzero(torn & near[:, view])
            cost[ids, view] += color_of(some[ids], view, pixels[ids, view]) / spread.color
    every, slots, costs = np.arange(len(some)), [], []
    for _ in range(2):
        view = cost.argmin(1)
        lowest = cost[every, view]
        slot = view * (rows.width * rows.height) + pixels[every, view].astype(np.int64)
        slots.append(np.where(np.isfinite(lowest), slot, -1))
        costs.append(lowest)
        cost[every, view] = np.inf
    return np.stack(slots, 1), np.stack(costs, 1)


def _assign(slots: np.ndarray, cost: np.ndarray, size: int) -> np.ndarray:
    """``[size]`` the row that each slot keeps, -1 for none: the cheapest; second choices only take what is free."""
    owner = np.full(size, -1, np.int64)
    waiting = np.arange(len(slots))
    for choice in range(2):
        slot = slots[waiting, choice]
        asking = waiting[(slot >= 0) & (owner[slot] < 0)]
        asking = asking[np.argsort(-cost[asking, choice], kind="stable")]
        owner[slots[asking, choice]] = asking  # of several the last one stays: the cheapest
        placed = np.zeros(len(slots), bool)
        placed[owner[owner >= 0]] = True
        waiting = np.flatnonzero(~placed)
    return owner
