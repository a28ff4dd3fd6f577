"""Find the cameras that show the Gaussians of a file in place, and the pixel of each row if rows are pixels in order.

If each pixel has a row, in order, the rows determine the pose of each view. This order is accepted if one similarity
moves the file's cameras to these poses. If some pixels may have no row, the rows are followed through the pixels, in
each frame that exporters use. For rows in another order no pixels are found, and cameras are chosen by the colours of
the photos.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import Note, SceneError, attempt
from gsmerge.frozen import dataclass, replace
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.formats.read_gaussians import GaussianFile
from gsmerge.io.image_names import natural_key
from gsmerge.io.photo_files import NO_IMAGES, PhotoArrays, PhotoTransform, as_floats, photo_size
from gsmerge.method.geometry.transforms import IDENTITY, Similarity, median
from gsmerge.reading.alignment.conventions import move_cameras, other_conventions
from gsmerge.reading.alignment.dropped_rows import estimate_cameras, follow_rows
from gsmerge.reading.alignment.explain import refuse_other_cameras
from gsmerge.reading.alignment.frames import exporter_frames, fit_frame, scale_by, solve_pose
from gsmerge.reading.alignment.grids import Grid, list_grids, with_poses, with_sizes
from gsmerge.reading.alignment.layouts import ESTIMATED, Layout
from gsmerge.reading.alignment.score import (
    AS_NEAR,
    AS_NEAR_PX,
    SHUFFLED_MARGIN,
    Alignment,
    AlignmentInput,
    check_pairs,
    max_correctable_px,
    pixel_errors,
)
from gsmerge.reading.alignment.unaligned import CameraCheck, choose_cameras
from gsmerge.reading.alignment.upright import solve_upright, upright_rotation
from gsmerge.runtime.memory import free_pages
from gsmerge.types import Cameras

_EVIDENCE = "Gaussians' places in their pixels"  # what shows that a frame is right, in words
_PLAIN_PX = 0.5  # pixels; if rows that are all pixels in order have a smaller error, no other cameras are tried
_MOST_PLACES = 1 << 27  # largest number of rows times views for which rows are followed; each takes four bytes


@dataclass(frozen=True, eq=False)
class RowSource:
    """The Gaussians, the cameras and the photos of a scene, and hints about the rows; see :func:`find_pixels`."""

    ply: GaussianFile
    camera_file: CameraFile
    photos: PhotoArrays
    order: str  # hint on the order of the rows; "auto": unknown
    scale: float | None  # hint on the length of one unit of the cameras' world in the Gaussians' world

    @cached_property
    def images(self) -> np.ndarray:
        """Photos at their own size, ``[c,h,w,3]`` float32."""
        return as_floats(self.photos)

    @cached_property
    def own_cameras(self) -> CameraFile | None:
        """Cameras that are estimated from the rows alone; None if the rows do not form a grid."""
        return estimate_cameras(Path(self.ply.info.path), self.ply.gaussians.means, self.ply.valid)

    def inputs(self, grid: Grid, *, photos: bool = True) -> AlignmentInput:
        """Return rows, cameras and photos at the size of a grid; without photos if ``photos`` is False."""
        images = NO_IMAGES
        if photos and not grid.previews:
            images = self.images if grid.transform is None else as_floats(grid.transform.photos(self.photos))
        return AlignmentInput(self.ply.gaussians, self.ply.valid, grid.cameras, images, self.scale)


@dataclass(frozen=True)
class Recovery:
    """Rows that are the pixels of a grid, with the grid's cameras moved into the frame of the Gaussians."""

    grid: Grid  # the grid, in the frame of the Gaussians
    layout: Layout  # the pixel of each row
    alignment: Alignment  # how near the rows are to their pixels

    @property
    def frame(self) -> Similarity:
        """Similarity from the frame of the cameras to the frame of the Gaussians."""
        return self.grid.frame

    @property
    def description(self) -> str:
        """Description, in words, of the rows' order and of the frame."""
        words = ", ".join(filter(None, (self.layout.description, self.frame.description)))
        return f"{words}: median {self.alignment.middle_px:.2f} px from the pixels"


@dataclass(frozen=True, eq=False)
class AlignmentResult:
    """Result of :func:`find_pixels`: the pixel of every row if rows have pixels, and the cameras that see the rows."""

    # ``[n]`` int64, the pixel ``(view·H + y)·W + x`` of each row, -1 for a row without a pixel; None if no row has a
    # pixel
    pixel_ids: np.ndarray | None
    cameras: Cameras  # all c views, in the frame of the Gaussians, at the size of the grid
    images: np.ndarray  # ``[c,h,w,3]`` photos of that size, sRGB in [0, 1], float32; [0,...] without any
    camera_file: CameraFile | None  # in the chosen convention and frame; None without cameras
    notes: tuple[str, ...] = ()  # notes on what was adapted, one sentence each
    transform: PhotoTransform | None = None  # applied to the photos
    recovery: Recovery | None = None  # where the pixels of the rows lie; None without pixels
    moves: Sequence[dict[str, Any]] = ()  # how far each camera was moved to its Gaussians; empty if none was moved
    # ``[c,4,4]`` poses as read, if photos confirm them, so that the views' Gaussians have to move instead; otherwise
    # None
    confirmed_viewmats: np.ndarray | None = None
    problem: str | None = None  # why the rows have no pixels; None if they have
    # Number of views that the rows form on their own, if the rows are pixels, but not of ``cameras``; else 0
    own_views: int = 0
    sight: CameraCheck | None = None  # what the cameras see; None if rows have pixels, or if it was not measured


def find_pixels(
    ply: GaussianFile,
    camera_file: CameraFile,
    photos: PhotoArrays = (),
    *,
    order: str = "auto",
    scale: float | None = None,
    frames: Callable[[], Sequence[Similarity]] = tuple,
) -> AlignmentResult:
    """Find the pixel of every row if rows are pixels in order; for other rows, choose the cameras that see them.

    The function also finds the size of the grid, the frame and convention of the poses, and the transform of the
    photos.

    Args:
        ply: The file's rows.
        camera_file: The file's cameras.
        photos: c uint8 photos of one size, or none.
        order: The order of the rows if it is known, see :class:`gsmerge.settings.reading.ReadHints`.
        scale: Length of one unit of the cameras' world in the world of the Gaussians, if it is given.
        frames: Reads the frames that a file gives for the cameras. Only called for rows without pixels.

    Raises:
        SceneError: If photos and cameras do not agree in size, if no cameras see the Gaussians, or if the rows are the
            pixels of other cameras.
    """
    camera_file = with_sizes(camera_file, photo_size(photos))
    source = RowSource(ply, camera_file, photos, order, scale)
    grids = list_grids(camera_file, photo_size(photos), len(ply.gaussians))
    for grid in grids:
        recovery = _recover_pixels(source, grid)
        if recovery is not None:
            return _make_alignment(source, recovery)
    result = attempt(_align_without_pixels, source, grids[0], frames)
    if isinstance(result, SceneError):
        raise grids[0].mismatch or result
    return result


def _recover_pixels(source: RowSource, grid: Grid) -> Recovery | None:
    """Find the pixels of the rows in a grid, and the frame of its cameras; None if the rows are not pixels in order."""
    if source.order == "none":
        return None
    count = len(source.ply.gaussians)
    num_pixels = len(grid.cameras) * math.prod(grid.size)
    # layers: whole rows per pixel
    layout = Layout(len(grid.cameras), *grid.size)
    layers = count // num_pixels
    if source.camera_file.pixel_ids is not None:
        layouts = [replace(layout, ids=source.camera_file.pixel_ids)]
    elif count != layers * num_pixels or source.order == "view-fastest":  # some pixels may have no row
        recovery = _follow_order(source, grid, exporter_frames(grid.cameras, source.scale))
        own = None
        if recovery is None:  # the frame in which the cameras fit cameras that are estimated from the rows
            own = source.own_cameras
        if own is not None and len(own) == len(grid.cameras):
            recovery = _follow_order(source, grid, [fit_frame(grid.cameras, own.viewmats, source.scale)])
        return recovery
    elif layers == 1:  # views are in the order of the camera file, or of the names
        names = source.camera_file.names
        by_name = np.array(sorted(range(len(names)), key=lambda view: natural_key(names[view])))
        pixels = np.arange(num_pixels).reshape(len(names), -1)
        layouts = [layout, replace(layout, ids=pixels[by_name].reshape(-1))]
    else:  # several Gaussians of a pixel follow each other, or there are several layers of all pixels
        rows = np.arange(count)
        layouts = [replace(layout, ids=ids) for ids in (rows // layers, rows % num_pixels)]
    # at least min_rows rows have to be finite, or the share min_share of all rows if that is less
    min_rows = 24
    min_share = 0.05
    if int(source.ply.valid.sum()) < min(min_rows, min_share * count):
        return None
    return next(filter(None, (_place_layout(source, grid, layout) for layout in layouts)), None)


def _place_layout(source: RowSource, grid: Grid, layout: Layout) -> Recovery | None:
    """Find cameras under which rows lie in the pixels of a layout; None if no cameras fit.

    The cameras of the grid are tried as stored, and then in another frame or convention. If none fits, each camera is
    moved to its rows.
    """
    inputs = source.inputs(grid, photos=False)
    pairs = inputs.pairs(layout)
    shuffled = replace(pairs, pixels=np.random.default_rng(0).permutation(pairs.pixels))

    def accept(grid: Grid, frame: Similarity, limit: float) -> Recovery | None:
        """Return the result for cameras in a frame; None if rows do not lie in their pixels.

        ``limit`` is the largest median distance of a view's rows from their pixels.
        """
        cameras = frame.move_cameras(grid.cameras)
        alignment = check_pairs(pairs, cameras)
        far_px = SHUFFLED_MARGIN * max(alignment.worst_px, AS_NEAR_PX)
        is_near = pixel_errors(pairs, cameras) <= max_correctable_px(*grid.size)
        min_share = 0.75  # least share of rows near their pixels; below it, one of two layers belongs to other views
        rows_lie_in_pixels = (
            alignment.ok
            and alignment.worst_px <= limit
            and median(pixel_errors(shuffled, cameras)) >= far_px
            and (layout.ids is None or float(is_near.mean()) >= min_share)
        )
        placed = replace(grid, frame=frame, shown_by=_EVIDENCE)
        return Recovery(placed, layout, alignment) if rows_lie_in_pixels else None

    usual = exporter_frames(grid.cameras, source.scale)[0]
    if recovery := accept(grid, usual, _PLAIN_PX):
        return recovery
    solved = [solve_pose(pairs, view, K) for view, K in enumerate(grid.cameras.Ks)]
    poses = np.array([pose for pose in solved if pose is not None])
    if len(poses) == len(grid.cameras):
        solved_px = check_pairs(pairs, replace(grid.cameras, viewmats=poses)).worst_px
        rounding_px = 0.1  # a file's cameras may err more than solved poses by this, since files round numbers
        limit = max(AS_NEAR * solved_px, solved_px + rounding_px)
        conventions = other_conventions(source.camera_file.viewmats, source.camera_file.convention)
        for other in itertools.chain([grid], (with_poses(grid, poses) for poses in conventions)):
            frame = fit_frame(other.cameras, poses, source.scale)
            if recovery := accept(other, IDENTITY, limit) or accept(other, frame, limit):
                return recovery
    # inexact cameras, if they are not too far from their pixels, are moved to show rows in their pixels
    moved_gaussians = 2000  # Gaussians of a view that its moved pose is solved from
    more_pairs = inputs.pairs(layout, moved_gaussians)
    if check_pairs(more_pairs, grid.cameras).worst_px <= max_correctable_px(*grid.size):
        path = str(source.camera_file.path)
        names = source.camera_file.names
        moved = move_cameras(more_pairs, grid.cameras, names, path, source.inputs(grid).images)
        if moved is not None:  # photos may confirm the poses as read
            confirmed, moves = (grid.cameras.viewmats, ()) if moved.confirmed else (None, moved.moves)
            remarks = (*grid.remarks, moved.note)
            grid = replace(grid, cameras=moved.cameras, remarks=remarks, moves=moves, confirmed_viewmats=confirmed)
    return accept(grid, IDENTITY, np.inf)


def _follow_order(source: RowSource, grid: Grid, frames: Sequence[Similarity]) -> Recovery | None:
    """Find the pixels of rows in the order of the pixels, if some pixels have no row; None for rows in another order.

    Each of ``frames`` is tried with both orders: by view, line and column, and by line, column and view. A few rows may
    have no pixel.
    """
    rows = np.flatnonzero(source.ply.valid)
    if len(rows) > len(grid.cameras) * math.prod(grid.size) or len(rows) * len(grid.cameras) > _MOST_PLACES:
        return None  # there are more rows than pixels, or too many to follow
    orders = [order for order in ("view-major", "view-fastest") if source.order in ("auto", order)]
    points = np.ascontiguousarray(source.ply.gaussians.means[rows], np.float32)
    # rows that are followed first, and the share of rows that must have a pixel
    first_rows = 20_000
    min_placed = 0.99
    for frame, order in itertools.product(frames, orders):
        placed = replace(grid, frame=frame, shown_by=_EVIDENCE)
        cameras = placed.placed
        viewmats = np.ascontiguousarray(cameras.viewmats, np.float64)
        Ks = np.ascontiguousarray(cameras.Ks, np.float64)
        for part in (points[:first_rows], points):  # the first rows rule out most other orders
            ids = follow_rows(part, viewmats, Ks, *grid.size, mixed=order == "view-fastest")
            if (ids >= 0).sum() < min_placed * len(part):
                break
        else:
            pixel_ids = np.full(len(source.ply.gaussians), -1)
            pixel_ids[rows] = ids
            layout = Layout(len(grid.cameras), *grid.size, order, pixel_ids)
            pairs = source.inputs(grid, photos=False).pairs(layout)
            return Recovery(placed, layout, check_pairs(pairs, cameras))
    return None


# Rows without pixels, and results


def _align_without_pixels(source: RowSource, grid: Grid, frames: Callable[[], Sequence[Similarity]]) -> AlignmentResult:
    """Choose the cameras that see rows for which no pixels were found.

    Raises SceneError if no cameras see the rows, or if the rows turn out to be pixels of other cameras.
    """
    inputs = source.inputs(grid)
    if source.order != "none":
        refuse_other_cameras(inputs, source.camera_file)
    if source.scale is not None:
        grid = replace(grid, cameras=scale_by(source.scale).move_cameras(grid.cameras))
    # the error of rows that are not the pixels of the cameras states both numbers
    views = len(grid.cameras)
    width, height = grid.size
    count = source.ply.info.count
    expected = f"{views} x {height} x {width} = {views * height * width} (views x height x width)"
    actual = f"{count} in no known order" if count == views * height * width else str(count)
    problem = f"expected one Gaussian per pixel, {expected}, found {actual}"
    remedy = "give the cameras of their views, in the frame of the Gaussians"
    no_pixels = SceneError(source.ply.info.path, problem, remedy)
    sight = None
    notes_on_choice = list[str]()
    rotation = upright_rotation(inputs)
    if rotation is None:
        placed = replace(inputs, cameras=grid.cameras)
        grid, sight, notes_on_choice = choose_cameras(placed, grid, frames(), no_pixels)
    else:
        upright = solve_upright(inputs, rotation, source.ply.info.path)
        grid = replace(grid, frame=upright, shown_by="photos' colours")
    cameras = grid.placed
    camera_file = grid.camera_file
    if grid.frame is not IDENTITY:
        recovery = None if source.order == "none" else _follow_order(source, grid, [grid.frame])
        if recovery is not None:  # the rows alone did not show their scale, but the photos did
            return _make_alignment(source, recovery)
        camera_file = replace(camera_file, viewmats=cameras.viewmats)
    notes = (*grid.list_notes(source.camera_file.convention), *notes_on_choice)
    return AlignmentResult(
        pixel_ids=None,
        cameras=cameras,
        images=inputs.images,
        camera_file=camera_file,
        notes=notes,
        transform=grid.transform,
        problem=no_pixels.problem,
        own_views=0 if source.order == "none" else len(source.own_cameras or ()),
        sight=sight,
    )


def _make_alignment(source: RowSource, recovery: Recovery) -> AlignmentResult:
    """Make the result for rows that are pixels, with cameras and poses in the frame of the Gaussians."""
    grid = recovery.grid
    camera_file = source.camera_file
    inputs = source.inputs(grid)
    notes = grid.list_notes(camera_file.convention)
    confirmed = grid.confirmed_viewmats
    free_pages(vars(inputs.gaussians).values())  # the search has read all rows
    if camera_file.source == ESTIMATED:
        focals_differ = len(set(map(bytes, camera_file.Ks))) > 1
        subject = (
            "poses, and focal lengths that differ between the views," if focals_differ else "poses and focal length"
        )
        text = f"no cameras are used: {subject} are estimated from the Gaussians' own grid"
        notes.append(Note(text, "estimated cameras"))
    return AlignmentResult(
        pixel_ids=recovery.layout.pixel_ids(),
        cameras=grid.placed,
        images=inputs.images,
        camera_file=grid.camera_file,
        notes=tuple(notes),
        transform=grid.transform,
        recovery=recovery,
        moves=grid.moves,
        confirmed_viewmats=None if confirmed is None else grid.frame.move_viewmats(confirmed),
    )
