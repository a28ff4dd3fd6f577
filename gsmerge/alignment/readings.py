"""Read the rows of one grid: in every layout that their number allows, in every frame of the cameras, cheap first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from gsmerge.alignment.layouts import (
    MAY_BE_UNALIGNED,
    Layout,
    depth_layouts,
    every_nth,
    exact_layouts,
    move_layout,
    plain_layout,
    subsample,
)
from gsmerge.alignment.resection import projective_error
from gsmerge.alignment.score import (
    QUICK_SAMPLES,
    SAMPLES,
    SHUFFLED_MARGIN,
    SMALLEST_PX,
    AlignmentInput,
    Correspondences,
    Reading,
    beats_shuffled,
    candidate_similarities,
    fits_all_cameras,
    pixel_errors,
    pixel_limit,
    sample_layout,
    score_layout,
    score_shuffled,
)
from gsmerge.geometry import IDENTITY
from gsmerge.types import Cameras

ENOUGH, FEW = 24, 0.05  # finite rows that decide between readings; fewer will do where they are no such small share
_PER_VIEW = 500  # finite rows for each camera, from which it is searched which pixels lack one
_SIMPLER = 1.15  # a simpler frame wins unless it is worse than this factor ...
_SIMPLER_PX = 0.02  # ... and this many pixels
_PLAIN_PX = 0.5  # a file whose rows are the grid as they are is not searched if it is this near to its pixels
# pixels from which no camera sees the rows of a layout: times the limit, and share of the shorter side
_SEEN_LIMITS, _SEEN_SHARE = 2.0, 0.03
_SAME_FOCAL, _OFF = 0.1, 1  # by which focal lengths may differ, relative, and principal points, pixels
_EFFORTS = (0, 1, 2)  # of the search for a frame, see candidate_similarities
_SEEN_SAMPLES = 200  # Gaussians of a view that it is judged by
_LIKELY_VIEWS = 16  # cameras that a part may be of, by a few of its Gaussians


def read_grid(inputs: AlignmentInput, *, exact_frames: bool = False) -> list[Reading]:
    """Read the rows as the pixels of a grid, with growing effort until a reading fits; empty if none does.

    ``exact_frames``: try only cameras in the frame of their file, and files without missing pixels, which is quick.
    """
    readings: list[Reading] = []
    for round_readings in _rounds(inputs, exact_frames=exact_frames):
        readings += round_readings
        if any(reading.ok for reading in readings):
            return readings
    return []


def _rounds(inputs: AlignmentInput, *, exact_frames: bool) -> Iterator[list[Reading]]:
    """Yield rounds of readings that cost about as much, the cheap first."""
    finite = int(inputs.valid.sum())
    if inputs.order == "none" or (finite < ENOUGH and finite < FEW * len(inputs.gaussians)):
        return
    inputs = _without_same_labellings(inputs)
    yield _read_plain(inputs)
    layouts = possible_layouts(inputs)
    yield from _read_layouts(inputs, layouts, (0,) if exact_frames or not is_seen(inputs, layouts) else _EFFORTS)
    num_pixels = len(inputs.cameras) * inputs.cameras.width * inputs.cameras.height
    lacks_pixels = _PER_VIEW * len(inputs.cameras) <= finite and len(inputs.gaussians) < num_pixels
    if not exact_frames and lacks_pixels and inputs.order not in MAY_BE_UNALIGNED:
        yield _follow_rows(inputs)
        yield from _read_layouts(inputs, _dropped_layouts(inputs), _EFFORTS)


def _read_plain(inputs: AlignmentInput) -> list[Reading]:
    """Read the rows in order with the stored cameras, which fits most files; empty in doubt, for a longer search."""
    cameras, count = inputs.cameras, len(inputs.gaussians)
    expected = len(cameras) * cameras.width * cameras.height
    if inputs.order not in ("auto", "view-major") or inputs.scale is not None or count != expected:
        return []
    layouts = plain_layout(len(cameras), cameras.width, cameras.height).with_views_in(inputs.labellings)
    best, *others = (score_layout(inputs, layout, IDENTITY) for layout in layouts)
    far = SHUFFLED_MARGIN * max(best.worst_px, SMALLEST_PX)
    alone = best.worst_px <= _PLAIN_PX and all(other.worst_px >= far for other in others)
    return [best] if alone and beats_shuffled(best, score_shuffled(inputs, best)[0]) else []


def is_seen(inputs: AlignmentInput, layouts: Sequence[Layout]) -> bool:
    """Return whether some camera, in any frame, could show the rows of one of the layouts in their pixels."""
    return any(_is_seen(inputs, layout) for layout in layouts)


def _is_seen(inputs: AlignmentInput, layout: Layout) -> bool:
    limit = max(_SEEN_LIMITS * pixel_limit(layout.width, layout.height), _SEEN_SHARE * min(layout.width, layout.height))
    count = len(layout.views)
    for i in sorted({0, count // 2, count - 1}):
        part = replace(layout, views=(0,), rows=layout.rows[i : i + 1], pixels=layout.pixels[i : i + 1])
        pairs = inputs.pairs(subsample(part, _SEEN_SAMPLES))
        if projective_error(pairs.points, pairs.pixels) <= limit:
            return True
    return False


def _without_same_labellings(inputs: AlignmentInput) -> AlignmentInput:
    """Drop orders that only exchange views with equal poses and photos, since they are all right."""
    cameras, images, (first, *labellings) = inputs.cameras, inputs.images, inputs.labellings
    parts = cameras.viewmats[:, :3], cameras.Ks, images

    def same(other: Sequence[int]) -> bool:
        moved = [(a, b) for a, b in zip(first, other, strict=True) if a != b]
        return all(np.array_equal(part[a : a + 1], part[b : b + 1]) for part in parts for a, b in moved)

    return replace(inputs, labellings=[first, *(first if same(other) else other for other in labellings)])


def possible_layouts(inputs: AlignmentInput) -> list[Layout]:
    """List the layouts that fit the number of rows, or the depth maps next to the cameras."""
    cameras, count = inputs.cameras, len(inputs.gaussians)
    layouts = list(exact_layouts(count, len(cameras), cameras.width, cameras.height))
    if count < len(cameras) * cameras.width * cameras.height and inputs.order in ("auto", "view-major"):
        depths = inputs.depths()
        if depths is not None and depths.shape == (len(cameras), cameras.height, cameras.width):
            layouts += depth_layouts(count, depths)
    return [layout for layout in layouts if inputs.order in ("auto", layout.order)]


def _follow_rows(inputs: AlignmentInput) -> list[Reading]:
    """Read rows that lack pixels in the frames that need no solving."""
    from gsmerge.alignment.dropped_rows import follow_rows  # of the few files that lack rows

    means, readings = inputs.gaussians.means, []
    for frame in candidate_similarities(None, inputs.cameras, scale=inputs.scale, effort=0):
        layout = follow_rows(means, inputs.valid, frame.move(inputs.cameras))
        if layout is not None and inputs.order in ("auto", layout.order):
            readings.append(score_layout(inputs, layout, frame))
    return readings


def _dropped_layouts(inputs: AlignmentInput) -> list[Layout]:
    """List the places, in the grid of the cameras, of the grid that rows which lack pixels are found to be."""
    cameras = inputs.cameras
    grid = inputs.dropped()
    if grid is None:
        return []
    layout, own = grid
    if inputs.order not in ("auto", layout.order):
        return []
    if sum(map(len, layout.rows)) == len(layout.views) * layout.width * layout.height:
        return []  # which no more than a border lacks
    margins = cameras.width - layout.width, cameras.height - layout.height
    focal = np.median(own.Ks[:, (0, 1), (0, 1)], 0) / np.median(cameras.Ks[:, (0, 1), (0, 1)], 0)
    if min(margins) < 0 or len(layout.views) > len(cameras) or not (np.abs(focal - 1) <= _SAME_FOCAL).all():
        return []
    chosen = next((ids for ids in every_nth(len(cameras)) if len(ids) == len(layout.views)), layout.views)
    layout = replace(layout, views=chosen)
    shifts = np.rint(np.median(cameras.Ks[:, :2, 2], 0) - np.median(own.Ks[:, :2, 2], 0)).astype(int)
    lefts, tops = (
        sorted({place for place in (margin // 2, *range(shift - _OFF, shift + _OFF + 1)) if 0 <= place <= margin})
        for margin, shift in zip(margins, shifts.tolist(), strict=True)
    )
    return [move_layout(layout, cameras.width, cameras.height, left, top) for left in lefts for top in tops]


def _read_layouts(inputs: AlignmentInput, layouts: Sequence[Layout], efforts: Sequence[int]) -> Iterator[list[Reading]]:
    """Yield the readings of all layouts, with one effort after the other."""
    for effort in efforts:
        yield [reading for layout in layouts for reading in _read_layout(inputs, layout, effort)]


def _read_layout(inputs: AlignmentInput, layout: Layout, effort: int) -> list[Reading]:
    """Score a layout in its best frame for each likely order of the views; any order with effort 2."""
    layouts = {labelled.views: labelled for labelled in layout.with_views_in(inputs.labellings)}
    lacks_views = len(set(layout.views)) < len(inputs.cameras)
    nearest = _nearest_views(inputs, layout) if (lacks_views or effort == 2) and inputs.scale is None else None
    if nearest is not None:
        layouts.setdefault(nearest, replace(layout, views=nearest))
    return [best_frame(inputs, labelled, QUICK_SAMPLES, effort) for labelled in layouts.values()]


def best_frame(inputs: AlignmentInput, layout: Layout, samples: int, effort: int) -> Reading:
    """Score a layout in the camera frame that fits it best; among frames about as good the simplest counts."""
    pairs = inputs.pairs(sample_layout(layout, samples))
    frames = candidate_similarities(pairs, inputs.cameras, scale=inputs.scale, effort=effort)
    readings = [score_layout(inputs, layout, frame, pairs) for frame in frames]
    lowest = min(reading.worst_px for reading in readings)
    best = next(reading for reading in readings if reading.worst_px <= max(_SIMPLER * lowest, lowest + _SIMPLER_PX))
    solved = best.ok and best.frame is not IDENTITY and inputs.scale is None
    ok = fits_all_cameras(best.frame, pairs, inputs.cameras) if solved else best.ok
    return replace(best, ok=ok, quick=samples < SAMPLES)


def _nearest_views(inputs: AlignmentInput, layout: Layout) -> tuple[int, ...] | None:
    """Find for each part the camera into whose pixels it projects best; None where two choose the same.

    A few Gaussians choose some cameras, more Gaussians the best of these.
    """
    pairs, cameras = inputs.pairs(subsample(layout, 300)), inputs.cameras
    every, nearest = np.arange(len(cameras)), []
    for part in range(len(layout.views)):
        part_pairs = pairs.select(pairs.parts == part)
        if not (count := len(part_pairs.rows)):
            return None
        few = part_pairs.select(np.arange(0, count, -(-count // ENOUGH)))
        views = every[np.argsort(_errors_in(few, every, cameras), kind="stable")[:_LIKELY_VIEWS]]
        nearest.append(int(views[np.argmin(_errors_in(part_pairs, views, cameras))]))
    return tuple(nearest) if len(set(nearest)) * layout.per_pixel == len(nearest) else None


def _errors_in(pairs: Correspondences, views: np.ndarray, cameras: Cameras) -> np.ndarray:
    """Measure the median distance ``[v]`` of the Gaussians of one part from their pixels in each of ``views [v]``."""
    times, ids = (len(views), 1), np.repeat(views, len(pairs.rows))
    tiled = replace(pairs, points=np.tile(pairs.points, times), pixels=np.tile(pairs.pixels, times), views=ids)
    return np.asarray(np.median(pixel_errors(tiled, cameras).reshape(len(views), -1), axis=1))
