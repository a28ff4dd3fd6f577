"""Score readings of files that lack unknown pixels, or have their rows in no order.

Rows in no order can be read where Gaussians were made on the rays of their pixels' centres: a Gaussian then
projects to the very centre of a pixel in its own view, and anywhere in a pixel of the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from gsmerge.alignment.layouts import Layout
from gsmerge.alignment.ordered_rows import (
    FAR,
    FAR_PX,
    MIN_RUN,
    ProjectedRows,
    concentrated_scale,
    finer_scale,
    read_view_fastest,
    read_view_major,
    rough_scale,
)
from gsmerge.alignment.score import (
    AlignmentInput,
    Reading,
    candidate_similarities,
    sample_layout,
    scale_by,
    score_layout,
)
from gsmerge.geometry import Similarity, sh0_to_rgb
from gsmerge.runtime.threads import parallel_map

TOLERANCES = (0.05, 0.02, 0.01, 0.005, 0.002)  # pixels from a centre that count as being there
MIN_SHARE = 0.9  # of the rows at the centre of a pixel of some view, and of those that come to a pixel in the end
MAX_CHANCE = 0.2  # of that share: as many at a second view's centre, or at the corners of pixels, are chance
_SAMPLES = 20_000  # rows that the file is judged by
_FEW, _MIN_FEW = 10, 0.5  # every how many of them are tried first, and share at centres without which none are
_CHUNK = 1 << 15  # rows at a time
_SMALLEST_PX, _SMALLEST_COLOR = 1e-4, 0.005  # units of the distances, at least

# pixels from a centre within which a view may be a row's own; median distance from the centre in the own view, pixels,
# and of the base colour from the photo there, inf without photos
Spread = tuple[float, float, float]
# (rows, view, pixels) -> [r] distances of the rows' base colours from the photo there, 0 to 1
ColorOf = Callable[[np.ndarray, int, np.ndarray], np.ndarray]
_ROUNDS = 3  # of a layout and the scale that follows from it
_CERTAIN_PX = 0.3  # median distance that a search does not reach in a wrong frame
_AS_GOOD = 1.05  # of that distance: no worse, where the scale is solved from more rows
_BETTER = 2.0  # times nearer to the pixels: another scale, where the same fits as well


def read_incomplete(inputs: AlignmentInput) -> Iterator[Reading]:
    """Yield readings of rows that lack pixels, in order of likelihood."""
    return (reading for reading in _read_orders(inputs) if reading is not None)


def _read_orders(inputs: AlignmentInput) -> Iterator[Reading | None]:
    """Yield the reading in each order; None where it is impossible."""
    cameras = inputs.cameras
    missing = len(cameras) * cameras.width * cameras.height - len(inputs.gaussians)
    if missing < 0:
        return
    ids = np.flatnonzero(inputs.valid)
    rows = ProjectedRows(inputs.gaussians.means[ids].astype(np.float64), ids, cameras)
    # frames that need no solving: without a layout no pixel is known
    frames = list(candidate_similarities(None, cameras, scale=inputs.scale, effort=0))
    if missing and inputs.order in ("auto", "view-major"):
        yield _read_view_major(inputs, rows, frames[0])
    if missing and inputs.order in ("auto", "view-fastest"):
        yield _read(inputs, rows, read_view_fastest, frames[0])
    if inputs.order in ("auto", "unordered"):
        search = partial(read_unordered, color_of=_photo_colors(inputs, ids))
        readings = (_read(inputs, rows, search, frame) for frame in frames)
        yield next((reading for reading in readings if reading is not None), None)
    if missing and inputs.order in ("auto", "view-fastest") and inputs.scale is None:
        yield _read_view_fastest_scaled(inputs, rows)


def _read(
    inputs: AlignmentInput, rows: ProjectedRows, search: Callable[[ProjectedRows], Layout | None], frame: Similarity
) -> Reading | None:
    """Find the pixels of the rows by ``search`` in one frame and score the layout; None if the search finds none."""
    layout = search(rows.with_frame(frame))
    return None if layout is None else score_layout(inputs, layout, frame)


def _read_view_major(inputs: AlignmentInput, rows: ProjectedRows, frame: Similarity) -> Reading | None:
    """Read the rows view after view in a frame, or at another scale if the frame does not fit well."""
    same = _read(inputs, rows, read_view_major, frame)
    if same is not None and same.worst_px >= _CERTAIN_PX:
        num_pixels = len(same.layout.views) * rows.cameras.width * rows.cameras.height
        if 2 * sum(map(len, same.layout.rows)) < num_pixels:  # with so many pixels to choose from, any row is near one
            same = replace(same, ok=False)
    if inputs.scale is not None or (same is not None and same.worst_px < _CERTAIN_PX):
        return same
    other = _read_scaled(inputs, rows)
    if other is None or same is None:
        return other or same
    return other if other.ok and (other.worst_px * _BETTER < same.worst_px or not same.ok) else same


def _read_scaled(inputs: AlignmentInput, rows: ProjectedRows) -> Reading | None:
    """Search for the scale and the pixels of rows in view-major order, from the steps between rows."""
    scale = rough_scale(rows)
    best = None if scale is None else _read(inputs, rows, read_view_major, scale_by(scale))
    far = max(FAR_PX, FAR * min(rows.cameras.width, rows.cameras.height))
    if scale is None or best is None or best.worst_px > far:
        return None
    every = replace(rows, points=inputs.gaussians.means.astype(np.float64))
    return _solve_scale(inputs, rows, read_view_major, best, scale_by(finer_scale(every, best.layout, scale)))


def _read_view_fastest_scaled(inputs: AlignmentInput, rows: ProjectedRows) -> Reading | None:
    """Read the rows pixel by pixel, at the scale of the cameras at which they gather at pixel centres."""
    scale = concentrated_scale(rows)
    best = None if scale is None else _read(inputs, rows, read_view_fastest, scale_by(scale))
    return None if scale is None or best is None else _solve_scale(inputs, rows, read_view_fastest, best, best.frame)


def _solve_scale(
    inputs: AlignmentInput,
    rows: ProjectedRows,
    search: Callable[[ProjectedRows], Layout | None],
    best: Reading,
    frame: Similarity,
) -> Reading:
    """Solve scale and pixels in turn from a first reading, until neither changes."""
    for _ in range(_ROUNDS):
        reading = _read(inputs, rows, search, frame)
        if reading is None or reading.worst_px > _AS_GOOD * best.worst_px:
            break
        best = reading
        frames = candidate_similarities(inputs.pairs(sample_layout(best.layout)), inputs.cameras, effort=1)
        frame = next((finer for finer in frames if finer.scale != 1), frame)
    return replace(best, ok=best.ok and best.worst_px < _CERTAIN_PX)


def _photo_colors(inputs: AlignmentInput, ids: np.ndarray) -> ColorOf | None:
    """Return a function that measures the colour distance of rows from the photos; None without photos."""
    if not len(inputs.images):
        return None
    base = sh0_to_rgb(inputs.gaussians.sh0[ids, 0])
    photos = inputs.images.reshape(len(inputs.cameras), -1, 3)
    return lambda rows, view, pixels: np.abs(base[rows].clip(0, 1) - photos[view, pixels]).mean(1)


def read_unordered(rows: ProjectedRows, *, color_of: ColorOf | None = None) -> Layout | None:
    """Find the pixel of every row in a file without an order; None unless nearly all rows lie at pixel centres.

    Each row goes to the view in which it is nearest to a pixel centre. If several views are about as near, the colours
    of the photos count as well. If several rows go to one pixel, the best one keeps it, and the others go to their
    second choice.
    """
    count, num_views = len(rows), len(rows.cameras)
    num_pixels = rows.cameras.width * rows.cameras.height
    spread = _measure_spread(rows, color_of)
    if spread is None:
        return None
    chunks = [np.arange(a, min(a + _CHUNK, count)) for a in range(0, count, _CHUNK)]
    choices = parallel_map(lambda row_ids: _choices(rows, row_ids, spread, color_of), chunks)
    slots, cost = np.concatenate([c[0] for c in choices]), np.concatenate([c[1] for c in choices])
    owner = _assign(slots, cost, num_views * num_pixels)
    used = np.flatnonzero(owner >= 0)
    if len(used) < MIN_SHARE * count:
        return None
    slots_of_views = np.split(used, np.searchsorted(used, np.arange(1, num_views) * num_pixels))
    parts = [(view, owner[part], part - view * num_pixels) for view, part in enumerate(slots_of_views) if len(part)]
    lost = count - len(used)
    note = f", {lost:,} Gaussians without a pixel" if lost else ""
    return rows.layout("unordered", parts, missing=num_views * num_pixels - len(used), note=note)


def _measure_spread(rows: ProjectedRows, color_of: ColorOf | None) -> Spread | None:
    """Measure how near sampled rows are to pixel centres; None if that may be chance.

    Chance is measured at pixel corners, and in the second nearest view, which cameras side by side have in common.
    """
    if len(rows) < MIN_RUN:
        return None
    sample = np.unique(np.linspace(0, len(rows) - 1, _SAMPLES).astype(np.int64))
    few, _ = _distances(rows, sample[::_FEW])
    if (few.min(1) < TOLERANCES[0]).mean() < _MIN_FEW:
        return None
    centre, pixels = _distances(rows, sample)
    corner, _ = _distances(rows, sample, shift=0.5)
    ranked = np.sort(centre, axis=1)
    second = ranked[:, 1] if len(rows.cameras) > 1 else np.full(len(sample), np.inf)
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
        nearest = centre[sure].argmin(1)
        ids = [sure[nearest == view] for view in range(len(rows.cameras))]
        colors = [color_of(sample[part], view, pixels[part, view]) for view, part in enumerate(ids)]
        color = float(np.median(np.concatenate(colors)))
    px = float(np.median(ranked[near, 0]))
    return tolerance, max(px, _SMALLEST_PX), max(color, _SMALLEST_COLOR)


def _distances(rows: ProjectedRows, row_ids: np.ndarray, *, shift: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Measure distances ``[r,c]`` from the nearest pixel centre in each view, inf outside; also return the pixels."""
    distances = np.full((len(row_ids), len(rows.cameras)), np.inf, np.float32)
    pixels = np.zeros((len(row_ids), len(rows.cameras)), np.int32)
    for view in range(len(rows.cameras)):
        pixels[:, view], u, v = rows.pixels(row_ids, view)
        inside = pixels[:, view] >= 0
        du, dv = (x + shift - np.floor(x + shift) - 0.5 for x in (u[inside], v[inside]))
        distances[inside, view] = np.sqrt(du * du + dv * dv)
    return distances, pixels


def _choices(
    rows: ProjectedRows, row_ids: np.ndarray, spread: Spread, color_of: ColorOf | None
) -> tuple[np.ndarray, np.ndarray]:
    """Choose the best and second best slots ``view·H·W + pixel [r,2]`` of the rows, -1 for none; also return costs."""
    distances, pixels = _distances(rows, row_ids)
    tolerance, px, color = spread
    near = distances < tolerance
    torn = near.sum(1) > 1
    cost = distances / np.float32(px)
    cost[torn[:, None] & ~near] = np.inf
    if color_of is not None:
        for view in range(len(rows.cameras)):
            ids = np.flatnonzero(torn & near[:, view])
            cost[ids, view] += color_of(row_ids[ids], view, pixels[ids, view]) / color
    every, slots, costs = np.arange(len(row_ids)), [], []
    for _ in range(2):
        view = cost.argmin(1)
        lowest = cost[every, view]
        slot = view * (rows.cameras.width * rows.cameras.height) + pixels[every, view].astype(np.int64)
        slots.append(np.where(np.isfinite(lowest), slot, -1))
        costs.append(lowest)
        cost[every, view] = np.inf
    return np.stack(slots, 1), np.stack(costs, 1)


def _assign(slots: np.ndarray, cost: np.ndarray, size: int) -> np.ndarray:
    """Choose the row ``[size]`` that each slot keeps, -1 for none.

    The cheapest row keeps a slot; rows that lose theirs take a free slot by their second choice.
    """
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
