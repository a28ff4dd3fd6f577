"""Match the views of a layout with the cameras of a file, and find the frame of the cameras.

In the right layout some projective camera shows the rows of a view in their pixels, and the pose of each view can be
solved for. If convention and order of the file's cameras are right, one similarity moves all of them to these poses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import chain, compress

import numpy as np

from gsmerge.alignment.cameras import other_conventions
from gsmerge.alignment.frames import own_poses, solved_frames, usual_frames
from gsmerge.alignment.grids import Grid, with_poses
from gsmerge.alignment.judge import Candidate
from gsmerge.alignment.layouts import Layout, every_nth, some_views, subsample, view_orders
from gsmerge.alignment.resection import projective_error
from gsmerge.alignment.score import (
    AS_NEAR_PX,
    QUICK_GAUSSIANS,
    SAMPLE_GAUSSIANS,
    AlignmentInput,
    Correspondences,
    ScoredLayout,
    is_as_near,
    is_clearly_nearer,
    pixel_limit,
    sample_layout,
    score_layout,
)
from gsmerge.arrays import distinct
from gsmerge.geometry import IDENTITY, camera_centres
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.formats.read import GaussianFile
from gsmerge.io.photo_files import NO_IMAGES, PhotoArrays, Size, as_floats, photo_size
from gsmerge.types import Cameras

# A layout is dropped if its error under projective cameras exceeds the first number times the limit, or the second
# number times the error of the best layout
_MAX_LIMITS, _MAX_RATIO = 2.0, 3.0
_MAX_SELECTIONS = 64  # selections of every n-th camera that are tried; hundreds of cameras have more
_PROJECTED_GAUSSIANS = 200  # Gaussians of a view that the projective camera is solved from

GridLayout = tuple[Grid, Layout]  # a layout of the rows, and the grid of its size


@dataclass(frozen=True, eq=False)
class RowSource:
    """The Gaussians, the cameras and the photos of a scene, and hints about the rows; see :func:`align`."""

    ply: GaussianFile
    camera_file: CameraFile
    photos: PhotoArrays
    order: str  # hint on the order of the rows; "auto": unknown
    scale: float | None  # hint on the length of one unit of the cameras' world in the Gaussians' world
    depths: Callable[[], np.ndarray | None]  # reads the depth maps ``[c,h,w]`` next to the cameras

    @property
    def size(self) -> Size | None:
        """(width, height) of the photos; None without any."""
        return photo_size(self.photos)

    @cached_property
    def images(self) -> np.ndarray:
        """Photos at their own size, ``[c,h,w,3]`` float32."""
        return as_floats(self.photos)

    def inputs(self, grid: Grid, *, photos: bool = True) -> AlignmentInput:
        """Return rows, cameras and photos at the size of a grid; without ``photos`` if only positions matter."""
        images = NO_IMAGES
        if photos:
            images = self.images if grid.transform is None else as_floats(grid.transform.photos(self.photos))
        return AlignmentInput(self.ply.gaussians, self.ply.valid, grid.cameras, images, self.order, self.scale)

    def may_be(self, order: str) -> bool:
        """Return True if the hint allows an order of the rows."""
        return self.order in ("auto", order)

    def orders(self, grid: Grid) -> list[tuple[int, ...]]:
        """List the orders that the views may be in: the order of the file, and the order of the names.

        If the order of the names only exchanges views with equal poses and photos, the order of the file replaces it.
        """
        file_order, name_order = view_orders(self.camera_file.names)
        cameras, photos = grid.cameras, self.photos

        def are_equal(a: int, b: int) -> bool:
            pairs = [(cameras.viewmats[a, :3], cameras.viewmats[b, :3]), (cameras.Ks[a], cameras.Ks[b])]
            pairs += [(photos[a], photos[b])] if len(photos) else []
            return all(np.array_equal(array, other) for array, other in pairs)

        is_equivalent = all(a == b or are_equal(a, b) for a, b in zip(file_order, name_order, strict=True))
        return [file_order, file_order if is_equivalent else name_order]


def match_views(source: RowSource, grid_layouts: Sequence[GridLayout]) -> list[Candidate]:
    """Match the views of each layout with the file's cameras; list the candidates that fit.

    A layout is left out if no projective camera shows its rows in their pixels. Other pose conventions are tried only
    if no layout fits in the convention of the file.
    """
    errors = [_projective_error(source, grid, layout) for grid, layout in grid_layouts]
    limit = _MAX_RATIO * max(min(errors, default=0.0), AS_NEAR_PX)
    is_possible = [error <= limit and math.isfinite(error) for error in errors]
    possible = list(compress(grid_layouts, is_possible))
    candidates = [candidate for grid, layout in possible for candidate in _match_layout(source, grid, layout)]
    for grid, layout in possible if not candidates else ():
        for other_grid in other_grids(source, grid):
            candidates += _match_layout(source, other_grid, layout)
    return candidates


def other_grids(source: RowSource, grid: Grid) -> Iterator[Grid]:
    """Return a grid with its poses in each other convention."""
    poses = other_conventions(source.camera_file.viewmats, source.camera_file.convention)
    return (with_poses(grid, other_poses) for other_poses in poses)


def _projective_error(source: RowSource, grid: Grid, layout: Layout) -> float:
    """Measure how far rows are from their pixels under the best projective camera, pixels; inf beyond the limit.

    The first, the middle and the last view are tried until one is within the limit.
    """
    limit = _MAX_LIMITS * pixel_limit(*grid.size)
    inputs = source.inputs(grid, photos=False)
    for view in some_views(layout):
        sample = subsample(layout.select(view), _PROJECTED_GAUSSIANS)
        pairs = inputs.pairs(sample)
        if 2 * len(pairs.rows) < sum(map(len, sample.rows)):  # most rows are not finite; the rest may fit by chance
            continue
        error = projective_error(pairs.points, pairs.pixels)
        if error <= limit:
            return error
    return math.inf


def _match_layout(source: RowSource, grid: Grid, layout: Layout) -> list[Candidate]:
    """Match the views of a layout with the file's cameras; list the candidates that fit.

    Views are matched in each likely order of the cameras, and with the cameras nearest to their own poses.
    """
    inputs = source.inputs(grid, photos=False)
    pairs = inputs.pairs(sample_layout(layout, QUICK_GAUSSIANS))
    views = distinct(np.asarray(layout.views))
    view_of_part = np.searchsorted(views, layout.views)
    count, pairs = len(views), replace(pairs, views=view_of_part[pairs.parts])

    @cache
    def solve_poses(Ks: bytes) -> dict[int, np.ndarray]:
        return own_poses(pairs, np.frombuffer(Ks).reshape(-1, 3, 3))

    def own_poses_with(cameras: Sequence[int]) -> dict[int, np.ndarray]:
        return solve_poses(grid.cameras.Ks[list(cameras)].astype(np.float64).tobytes())

    def make_candidate(cameras: Sequence[int]) -> Candidate:
        poses = {cameras[view]: pose for view, pose in own_poses_with(cameras).items()}
        camera_of_view = np.array(cameras)
        matched = replace(layout, views=tuple(camera_of_view[view_of_part].tolist()))
        return Candidate(grid, score_views(inputs, matched, replace(pairs, views=camera_of_view[pairs.views]), poses))

    selections = [ids for ids in every_nth(len(grid.cameras)) if len(ids) == count]
    selections = [*selections[:: max(1, -(-len(selections) // _MAX_SELECTIONS))], tuple(range(count))]
    orders = dict.fromkeys(tuple(order[view] for view in ids) for ids in selections for order in source.orders(grid))
    candidates = [make_candidate(order) for order in orders]
    nearest = _nearest_cameras(own_poses_with(next(iter(orders))), count, grid.cameras)
    if nearest is not None and nearest not in orders and source.scale is None:
        candidate = make_candidate(nearest)
        unrotated = ("same", "scaled", "shifted") if count > 1 else ("same",)  # a moved camera fits any single view
        candidates += [candidate] if candidate.scored.frame.kind in unrotated else []
    return [candidate for candidate in candidates if candidate.scored.alignment.ok]


def _nearest_cameras(own: Mapping[int, np.ndarray], count: int, cameras: Cameras) -> tuple[int, ...] | None:
    """Find the camera nearest to the ``own`` pose ``[4,4]`` of each of ``count`` views.

    Distances are relative to the spread of the cameras, and differences of rotation matrices are added. None if a pose
    is missing, or if two views have the same nearest camera.
    """
    if len(own) < count:
        return None
    viewmats, centres = np.stack([own[view] for view in range(count)]), cameras.centres
    unit = float(np.linalg.norm(centres - centres.mean(0), axis=1).max()) or 1.0
    rotation_errors = np.abs(viewmats[:, None, :3, :3] - cameras.viewmats[:, :3, :3]).max((2, 3))
    distances = np.linalg.norm(camera_centres(viewmats)[:, None] - centres, axis=2) / unit
    nearest = (rotation_errors + distances).argmin(1).tolist()
    return tuple(nearest) if len(set(nearest)) == count else None


def score_views(
    inputs: AlignmentInput, layout: Layout, pairs: Correspondences, own: Mapping[int, np.ndarray]
) -> ScoredLayout:
    """Score a layout in the simplest frame in which the cameras fit about as well as the views' ``own`` poses.

    ``pairs`` are a sample of the rows, and ``own`` are poses ``[4,4]`` by view.
    """
    cameras, viewmats = inputs.cameras, inputs.cameras.viewmats.astype(np.float64)
    for view, pose in own.items():
        viewmats[view] = pose
    own_fit = score_layout(replace(inputs, cameras=replace(cameras, viewmats=viewmats)), layout, IDENTITY, pairs)
    own_alignment = own_fit.alignment
    if not own_alignment.ok and set(own) >= set(layout.views):
        return own_fit  # in no frame can the cameras be nearer than own poses
    frames = chain(
        ((0, frame) for frame in usual_frames(cameras, inputs.scale)), solved_frames(pairs, cameras, own, inputs.scale)
    )
    fitting: list[ScoredLayout] = []
    for effort, frame in frames:
        scored = replace(score_layout(inputs, layout, frame, pairs), effort=effort)
        alignment = scored.alignment
        if effort == 2 and fitting:
            break
        if alignment.ok and is_as_near(alignment.worst_px, own_alignment.worst_px):
            return scored
        is_solved = effort > 0 and inputs.scale is None
        if alignment.ok and not (is_solved and is_clearly_nearer(own_alignment.middle_px, alignment.middle_px)):
            fitting.append(scored)  # a solved frame is left out if it fits far worse than own poses: cameras are wrong
    lowest_px = min((scored.alignment.worst_px for scored in fitting), default=math.inf)
    nearest = (scored for scored in fitting if is_as_near(scored.alignment.worst_px, lowest_px))
    return next(nearest, replace(own_fit, alignment=replace(own_alignment, ok=False)))


def rescore(source: RowSource, candidate: Candidate) -> Candidate:
    """Solve for the frame of a candidate again and score it again, on more Gaussians."""
    inputs, layout = source.inputs(candidate.grid, photos=False), candidate.scored.layout
    pairs = inputs.pairs(sample_layout(layout, SAMPLE_GAUSSIANS))
    own = own_poses(pairs, candidate.grid.cameras.Ks)
    return replace(candidate, scored=score_views(inputs, layout, pairs, own))
