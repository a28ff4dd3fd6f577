"""Match the views of rows with the cameras of a file: which of them each is, and how their world lies.

Rows in the right place show their pixels to some camera, and the pose of each view. One similarity moves the file's
cameras to these poses, in the right convention and order alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import chain

import numpy as np

from gsmerge.alignment.cameras import other_conventions
from gsmerge.alignment.frames import own_poses, solved_frames, usual_frames
from gsmerge.alignment.grids import Grid, read_as
from gsmerge.alignment.judge import GridReading
from gsmerge.alignment.layouts import Layout, every_nth, some_views, subsample, view_orders
from gsmerge.alignment.resection import projective_error
from gsmerge.alignment.score import (
    AS_NEAR_PX,
    QUICK_GAUSSIANS,
    SAMPLE_GAUSSIANS,
    AlignmentInput,
    Correspondences,
    Reading,
    is_as_near,
    is_clearly_nearer,
    pixel_limit,
    sample_layout,
    score_layout,
)
from gsmerge.geometry import IDENTITY, camera_centres
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.formats.read import GaussianFile
from gsmerge.io.photo_files import NO_IMAGES, PhotoArrays, Size, as_floats, photo_size
from gsmerge.types import Cameras

# pixels from which no camera shows the rows of a layout: times the limit, and times the distance of the nearest layout
_SHOWN_LIMITS, _AS_SHOWN = 2.0, 3.0
_MOST_STEPS = 64  # selections of every n-th camera that are tried, which leaves out some only of hundreds of cameras
_SHOWN_GAUSSIANS = 200  # Gaussians of a view that it is judged by

GridLayout = tuple[Grid, Layout]  # a layout of the rows in a grid of its size


@dataclass(frozen=True)
class RowSource:
    """The Gaussians, the cameras, the photos and the known facts about the rows."""

    ply: GaussianFile
    camera_file: CameraFile
    photos: PhotoArrays
    order: str
    scale: float | None
    depths: Callable[[], np.ndarray | None]

    @property
    def size(self) -> Size | None:
        """(width, height) of the photos; None without any."""
        return photo_size(self.photos)

    @cached_property
    def images(self) -> np.ndarray:
        """Photos at their own size, ``[c,h,w,3]`` float32."""
        return as_floats(self.photos)

    def inputs(self, grid: Grid, *, photos: bool = True) -> AlignmentInput:
        """Bring rows, cameras and photos to the size of a grid; without photos if only positions matter."""
        images = NO_IMAGES
        if photos:
            images = self.images if grid.transform is None else as_floats(grid.transform.photos(self.photos))
        return AlignmentInput(self.ply.gaussians, self.ply.valid, grid.cameras, images, self.order, self.scale)

    def may_be(self, order: str) -> bool:
        """Return whether rows may be in an order."""
        return self.order in ("auto", order)

    def orders(self, grid: Grid) -> list[tuple[int, ...]]:
        """List the orders that the views may be in: the file's, and that of the names.

        Orders that only exchange views of equal poses and photos are all right, and left out.
        """
        first, *others = view_orders(self.camera_file.names)
        cameras, photos = grid.cameras, self.photos

        def same(a: int, b: int) -> bool:
            pairs = [(cameras.viewmats[a, :3], cameras.viewmats[b, :3]), (cameras.Ks[a], cameras.Ks[b])]
            pairs += [(photos[a], photos[b])] if len(photos) else []
            return all(np.array_equal(one, other) for one, other in pairs)

        alike = (all(a == b or same(a, b) for a, b in zip(first, other, strict=True)) for other in others)
        return [first, *(first if skip else other for skip, other in zip(alike, others, strict=True))]


def match_views(source: RowSource, places: Sequence[GridLayout]) -> list[GridReading]:
    """Fit views to the file's cameras in the places in which rows show pixels; in other conventions if none fits."""
    errors = [_projective_error(source, *place) for place in places]
    far = _AS_SHOWN * max(min(errors, default=0.0), AS_NEAR_PX)
    shown = [place for place, error in zip(places, errors, strict=True) if error <= far and math.isfinite(error)]
    candidates = [candidate for place in shown for candidate in _fit_views(source, *place)]
    for grid, layout in shown if not candidates else ():
        candidates += [each for other in other_grids(source, grid) for each in _fit_views(source, other, layout)]
    return candidates


def other_grids(source: RowSource, grid: Grid) -> Iterator[Grid]:
    """Return a grid with its poses read in each other convention."""
    poses = other_conventions(source.camera_file.viewmats, source.camera_file.convention)
    return (read_as(grid, each) for each in poses)


def _projective_error(source: RowSource, grid: Grid, layout: Layout) -> float:
    """Measure how far rows are from their pixels under a camera of any pose and lens; inf where none shows them.

    Of the first, the middle and the last view, one that a camera shows counts.
    """
    limit = _SHOWN_LIMITS * pixel_limit(*grid.size)
    inputs = source.inputs(grid, photos=False)
    for view in some_views(layout):
        some = subsample(layout.select(view), _SHOWN_GAUSSIANS)
        pairs = inputs.pairs(some)
        if 2 * len(pairs.rows) < sum(map(len, some.rows)):  # a few lie in their pixels by chance
            continue
        error = projective_error(pairs.points, pairs.pixels)
        if error <= limit:
            return error
    return math.inf


def _fit_views(source: RowSource, grid: Grid, layout: Layout) -> list[GridReading]:
    """Fit the views of a layout to the file's cameras, in each likely order and in that of the nearest poses."""
    inputs = source.inputs(grid, photos=False)
    pairs = inputs.pairs(sample_layout(layout, QUICK_GAUSSIANS))
    numbers, parts = np.unique(layout.views, return_inverse=True)  # of the views; the view of each part
    count, pairs = len(numbers), replace(pairs, views=parts[pairs.parts])

    @cache
    def solve(Ks: bytes) -> dict[int, np.ndarray]:
        return own_poses(pairs, np.frombuffer(Ks).reshape(-1, 3, 3))

    def find_own(cameras: Sequence[int]) -> dict[int, np.ndarray]:
        return solve(grid.cameras.Ks[list(cameras)].astype(np.float64).tobytes())

    def read_as(cameras: Sequence[int]) -> GridReading:
        own = {cameras[view]: pose for view, pose in find_own(cameras).items()}
        views = np.array(cameras)
        labelled = replace(layout, views=tuple(views[parts].tolist()))
        return GridReading(grid, read_views(inputs, labelled, replace(pairs, views=views[pairs.views]), own))

    some = [ids for ids in every_nth(len(grid.cameras)) if len(ids) == count]
    some = [*some[:: max(1, -(-len(some) // _MOST_STEPS))], tuple(range(count))]
    orders = dict.fromkeys(tuple(order[view] for view in ids) for ids in some for order in source.orders(grid))
    candidates = [read_as(order) for order in orders]
    nearest = _nearest_cameras(find_own(next(iter(orders))), count, grid.cameras)
    if nearest is not None and nearest not in orders and source.scale is None:
        other = read_as(nearest)
        same_axes = ("same", "scaled", "shifted") if count > 1 else ("same",)  # one view fits any camera
        candidates += [other] if other.reading.frame.kind in same_axes else []
    return [each for each in candidates if each.reading.alignment.ok]


def _nearest_cameras(own: Mapping[int, np.ndarray], count: int, cameras: Cameras) -> tuple[int, ...] | None:
    """Find the cameras nearest to the poses of ``count`` views, in units of their spread; None where two have one."""
    if len(own) < count:
        return None
    viewmats, centres = np.stack([own[view] for view in range(count)]), cameras.centres
    unit = float(np.linalg.norm(centres - centres.mean(0), axis=1).max()) or 1.0
    turned = np.abs(viewmats[:, None, :3, :3] - cameras.viewmats[:, :3, :3]).max((2, 3))
    away = np.linalg.norm(camera_centres(viewmats)[:, None] - centres, axis=2) / unit
    nearest = (turned + away).argmin(1).tolist()
    return tuple(nearest) if len(set(nearest)) == count else None


def read_views(
    inputs: AlignmentInput, layout: Layout, pairs: Correspondences, own: Mapping[int, np.ndarray]
) -> Reading:
    """Score a layout in the simplest frame in which the cameras are about as near as the views' ``own`` poses.

    ``pairs`` are a sample of the rows, and ``own`` poses ``[4,4]`` by view.
    """
    cameras, viewmats = inputs.cameras, inputs.cameras.viewmats.astype(np.float64)
    for view, pose in own.items():
        viewmats[view] = pose
    bound = score_layout(replace(inputs, cameras=replace(cameras, viewmats=viewmats)), layout, IDENTITY, pairs)
    least = bound.alignment
    if not least.ok and set(own) >= set(layout.views):
        return bound  # nothing is nearer than poses of their own
    frames = chain(
        ((0, frame) for frame in usual_frames(cameras, inputs.scale)), solved_frames(pairs, cameras, own, inputs.scale)
    )
    readings: list[Reading] = []
    for effort, frame in frames:
        reading = replace(score_layout(inputs, layout, frame, pairs), effort=effort)
        measured = reading.alignment
        if effort == 2 and readings:
            break
        if measured.ok and is_as_near(measured.worst_px, least.worst_px):
            return reading
        is_solved = effort > 0 and inputs.scale is None
        if measured.ok and not (is_solved and is_clearly_nearer(least.middle_px, measured.middle_px)):
            readings.append(reading)  # otherwise cameras are wrong
    lowest = min((reading.alignment.worst_px for reading in readings), default=math.inf)
    near = (reading for reading in readings if is_as_near(reading.alignment.worst_px, lowest))
    return next(near, replace(bound, alignment=replace(least, ok=False)))


def refine(source: RowSource, candidate: GridReading) -> GridReading:
    """Score a fit again, with its frame solved again, on more Gaussians."""
    inputs = source.inputs(candidate.grid, photos=False)
    pairs = inputs.pairs(sample_layout(candidate.reading.layout, SAMPLE_GAUSSIANS))
    return replace(
        candidate,
        reading=read_views(inputs, candidate.reading.layout, pairs, own_poses(pairs, candidate.grid.cameras.Ks)),
    )
