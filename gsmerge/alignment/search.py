"""Search the pixels of rows over sizes of the grid, conventions and frames of the poses, and orders, cheap first."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, groupby
from typing import Any

import numpy as np

from gsmerge.alignment.cameras import describe_reading, max_pixels, move_cameras, other_conventions
from gsmerge.alignment.judge import Fit, Recovery, accept_reading, choose_fit
from gsmerge.alignment.layouts import (
    ESTIMATED,
    MAY_BE_UNALIGNED,
    GridFit,
    Layout,
    check_photo_size,
    dropped_layout,
    other_grids,
    photo_grid,
    square_grids,
    subsample,
    view_orders,
    with_photo_size,
)
from gsmerge.alignment.readings import is_seen, possible_layouts, read_grid
from gsmerge.alignment.score import AlignmentInput, scale_by, score_layout
from gsmerge.errors import SceneError
from gsmerge.geometry import IDENTITY, Similarity, mean_pose_frame
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.formats.read import GaussianFile
from gsmerge.io.photo_files import NO_IMAGES, Photos, PhotoTransform, Size, as_floats, photo_size
from gsmerge.runtime.memory import free_pages
from gsmerge.types import Cameras

_MANY_PIXELS = 2  # times as many pixels as rows: likely photos of another size than the grid's
_MAX_TRIED = 6  # grids that only the number of rows speaks for and that are tried with all frames
_MOVED_SAMPLES = 2000  # Gaussians of a view that its moved pose is solved from


@dataclass(frozen=True)
class AlignmentResult:
    """Result of :func:`align`: the pixel of every row, or for rows without pixels the cameras that see them."""

    # ``[n]`` int64, the pixel ``(part·H + y)·W + x`` of each row, -1: none; None where the rows belong to no pixels.
    # A part is a view, or one layer of a view with several Gaussians per pixel
    pixel_ids: np.ndarray | None
    cameras: Cameras  # all c views, in the frame of the Gaussians, at the size of the grid
    images: np.ndarray  # ``[c,h,w,3]`` photos of that size, sRGB in [0, 1], float32; [0,...] without any
    camera_file: CameraFile | None  # as it was read in the end; None where there are no cameras
    notes: tuple[str, ...] = ()  # what was adapted, one sentence each
    transform: PhotoTransform | None = None  # what was done to the photos
    recovery: Recovery | None = None  # which reading of the rows won, and by how much; None without pixels
    moves: Sequence[dict[str, Any]] = ()  # how far each camera was moved to its Gaussians; empty where none was
    given: np.ndarray | None = None  # ``[c,4,4]`` poses to which each view's Gaussians are yet to be moved with it
    problem: str | None = None  # why the rows belong to no pixels; None where they do

    @property
    def layout(self) -> Layout | None:
        """Pixel of each row, part by part; None for rows without pixels."""
        return None if self.recovery is None else self.recovery.best.layout

    @property
    def views(self) -> tuple[int, ...]:
        """Camera of each part; for rows without pixels, all cameras."""
        return tuple(range(len(self.cameras))) if self.layout is None else self.layout.views


@dataclass(frozen=True)
class _Source:
    """The Gaussians, the cameras, the photos and the known facts about the rows."""

    ply: GaussianFile
    camera_file: CameraFile
    photos: Photos
    order: str
    scale: float | None
    depths: Callable[[], np.ndarray | None]
    seen: dict[Size, bool] = field(default_factory=dict)  # what is known of :meth:`could_show`

    @cached_property
    def images(self) -> np.ndarray:
        """Photos at their own size, ``[c,h,w,3]`` float32."""
        return as_floats(self.photos)

    @cached_property
    def dropped(self) -> tuple[Layout, Cameras] | None:
        """Grid of the rows, if they lack pixels, and cameras for it; None where they are no such grid."""
        from gsmerge.alignment.dropped_rows import find_dropped_grid  # few files come here

        grid = find_dropped_grid(self.ply.gaussians.means, self.ply.valid)
        return None if grid is None else (grid[0], grid[1].cameras)

    def could_show(self, grid: GridFit) -> bool:
        """Return whether any cameras could show the rows as the pixels of a grid; remembered for each size."""
        if grid.size not in self.seen:
            inputs = self.inputs(grid, photos=False)
            self.seen[grid.size] = is_seen(inputs, possible_layouts(inputs))
        return self.seen[grid.size]

    def inputs(self, grid: GridFit, *, photos: bool = True) -> AlignmentInput:
        """Bring rows, cameras and photos to the size of a grid; without photos if only positions matter."""
        images = NO_IMAGES
        if photos:
            images = self.images if grid.transform is None else as_floats(grid.transform.photos(self.photos))
        return AlignmentInput(
            gaussians=self.ply.gaussians,
            valid=self.ply.valid,
            cameras=grid.cameras,
            images=images,
            labellings=view_orders(self.camera_file.names),
            depths=self.depths,
            dropped=lambda: self.dropped,
            order=self.order,
            scale=self.scale,
        )

    def fit(self, grids: Iterable[GridFit], *, photos: bool = True, exact_frames: bool = False) -> list[Fit]:
        """Read the rows in each of the grids; leave out grids whose pixels do not match the rows."""
        fits = []
        for grid in grids:
            inputs = self.inputs(grid, photos=photos)
            recovery = accept_reading(inputs, read_grid(inputs, exact_frames=exact_frames))
            fits += [] if recovery is None else [Fit(grid, recovery)]
        return fits

    def choose(self, rounds: Iterable[Sequence[Fit]]) -> Fit | None:
        """Choose a fit from the first round that has any; None if no round has one."""
        chosen = (choose_fit(fits, self.inputs) for fits in rounds)
        return next((fit for fit in chosen if fit is not None), None)


def align(
    ply: GaussianFile,
    camera_file: CameraFile,
    photos: Photos = (),
    *,
    order: str = "auto",
    scale: float | None = None,
    depths: Callable[[], np.ndarray | None] = lambda: None,
    frames: Callable[[], Sequence[Similarity]] = tuple,
) -> AlignmentResult:
    """Find the pixel of every row; for rows without pixels, choose the camera poses that see them.

    Also searches the size of the grid, the frame and convention of the poses, and the transform of the photos.

    Args:
        ply: The file's rows.
        camera_file: Its cameras.
        photos: c uint8 photos of one size, or none.
        order: The order of the rows where it is known, see :class:`gsmerge.settings.reading.ReadHints`.
        scale: Size of the Gaussians' world in units of the cameras', where it is given.
        depths: Reads ``[c,h,w]`` depth maps next to the cameras; None where there are none.
        frames: Reads the frames that a file names in which the cameras may see rows without pixels.

    Raises:
        SceneError: If sizes do not agree, several conventions fit, the Gaussians are not those of the cameras' views,
            or other cameras would make pixels of the rows.
    """
    camera_file = with_photo_size(camera_file, photo_size(photos))
    source = _Source(ply, camera_file, photos, order, scale, depths)
    try:
        grid = photo_grid(camera_file, photo_size(photos))
    except SceneError:
        fit = source.choose(_fit_other_sizes(source))
        cropped = _cropped_grid(source) if fit is None else fit.grid
        if cropped is None:
            raise
        grid = cropped
    else:
        fit = _fit_estimated(source, grid) or source.choose(_fit_rounds(source, grid))
    return _choose_cameras(source, grid, frames) if fit is None else _make_result(source, fit)


def _fit_estimated(source: _Source, grid: GridFit) -> Fit | None:
    """Fit the pixels that rows have shown cameras by; None where cameras were not estimated so."""
    pixel_ids = source.camera_file.pixel_ids
    if pixel_ids is None:
        return None
    inputs = source.inputs(grid)
    layout = dropped_layout(pixel_ids, len(grid.cameras), *grid.size)
    recovery = accept_reading(inputs, [score_layout(inputs, layout, IDENTITY)])
    return None if recovery is None else Fit(grid, recovery)


def _cropped_grid(source: _Source) -> GridFit | None:
    """Return photos resized or cropped to the cameras' size that show the colours of rows; None if none do."""
    from gsmerge.alignment.unaligned import check_cameras

    best, least = None, 0.0
    for grid in other_grids(source.ply.info, source.camera_file, photo_size(source.photos)):
        if grid.rank == 0:
            inputs = source.inputs(grid)
            check = check_cameras(inputs.gaussians, inputs.valid, inputs.cameras, inputs.images)
            if check.ok and not math.isnan(check.color_ratio) and check.score > least:
                best, least = grid, check.score
    return best


def _choose_cameras(source: _Source, grid: GridFit, frames: Callable[[], Sequence[Similarity]]) -> AlignmentResult:
    """Choose cameras that see rows without pixels; SceneError if none do, or if the rows should have pixels."""
    from gsmerge.alignment.explain import explain_count
    from gsmerge.alignment.unaligned import choose_cameras
    from gsmerge.alignment.upright import upright_rotation

    info, camera_file = source.ply.info, source.camera_file
    if source.order not in MAY_BE_UNALIGNED:
        check_photo_size(info, camera_file, photo_size(source.photos))
    inputs = source.inputs(grid)
    rotation = upright_rotation(inputs)
    if rotation is not None:
        return _align_upright(source, grid, rotation)
    why = explain_count(info, inputs, camera_file)
    if source.scale is not None:
        inputs = replace(inputs, cameras=scale_by(source.scale).move(inputs.cameras))
    cameras, camera_file, notes = choose_cameras(inputs, camera_file, frames(), why)
    return AlignmentResult(
        None, cameras, inputs.images, camera_file, (*grid.notes, *notes), grid.transform, problem=why.problem
    )


def _align_upright(source: _Source, grid: GridFit, rotation: Similarity) -> AlignmentResult:
    """Find pixels or cameras of rows that an exporter centred, rescaled and turned; SceneError if that fails."""
    from gsmerge.alignment.upright import solve_upright, upright_error

    for candidate in (grid, *square_grids(grid)) if len(source.photos) else ():
        inputs = source.inputs(candidate)
        frame = solve_upright(inputs, rotation)
        if frame is not None:
            break
    else:
        raise upright_error(source.ply.info, len(source.photos))
    moved = replace(inputs, cameras=frame.move(inputs.cameras), scale=None)
    recovery = accept_reading(moved, read_grid(moved))
    if recovery is not None:
        return _make_result(source, Fit(candidate, replace(recovery, best=replace(recovery.best, frame=frame))))
    return AlignmentResult(
        None,
        moved.cameras,
        inputs.images,
        replace(source.camera_file, viewmats=moved.cameras.viewmats),
        (*candidate.notes, f"the cameras are {frame.description}, as the photos' colours show"),
        candidate.transform,
        problem="expected one Gaussian per pixel, found Gaussians that were merged",
    )


def _fit_rounds(source: _Source, grid: GridFit) -> Iterator[list[Fit]]:
    """Yield rounds of fits that compete, the likely ones first.

    Grids are of the photos' size and of others; poses are as stored, moved, and in other conventions.
    """
    if source.order == "none":
        return
    other_sizes = _fit_other_sizes(source)
    large = len(grid.cameras) * math.prod(grid.size) > _MANY_PIXELS * len(source.ply.gaussians)
    if large:
        yield next(other_sizes, [])
    fits = source.fit([grid])
    if fits and fits[0].is_doubtful:
        fits = [min((*fits, *next(other_sizes, [])), key=lambda fit: fit.px)]
    yield fits
    if source.order not in MAY_BE_UNALIGNED:
        yield _fit_moved(source, grid)
    if not large:
        yield next(other_sizes, [])
    from gsmerge.alignment.unaligned import check_cameras  # few files come here

    rows = source.ply.gaussians, source.ply.valid
    grids = (_with_poses(grid, other) for other in _conventions(source.camera_file))
    yield source.fit(other for other in grids if check_cameras(*rows, other.cameras, NO_IMAGES).ok)
    moved = _in_mean_pose(grid)
    if source.scale is None and check_cameras(*rows, moved.cameras, source.inputs(grid).images).ok:
        yield source.fit([moved])
    yield from other_sizes


def _fit_other_sizes(source: _Source) -> Iterator[list[Fit]]:
    """Yield fits of grids that differ in size from the photos, then the same in other conventions of the poses."""
    if source.order != "none":
        yield _fit_sizes(source, source.camera_file)
    if source.order not in MAY_BE_UNALIGNED:
        camera_files = _conventions(source.camera_file)
        fits = (source.choose([_fit_sizes(source, camera_file, exact_frames=True)]) for camera_file in camera_files)
        yield list(filter(None, fits))


def _conventions(camera_file: CameraFile) -> Iterator[CameraFile]:
    """Yield the cameras with poses read in each other convention."""
    for poses in other_conventions(camera_file.viewmats, camera_file.convention):
        yield replace(camera_file, viewmats=poses.viewmats, convention=poses.convention)


def _with_poses(grid: GridFit, camera_file: CameraFile) -> GridFit:
    """Return a grid whose cameras have other poses."""
    return replace(grid, camera_file=camera_file, cameras=replace(grid.cameras, viewmats=camera_file.viewmats))


def _in_mean_pose(grid: GridFit) -> GridFit:
    """Return a grid whose cameras are moved into their mean pose."""
    frame = mean_pose_frame(grid.camera_file.viewmats)
    moved = _with_poses(grid, replace(grid.camera_file, viewmats=frame.move_viewmats(grid.camera_file.viewmats)))
    return replace(moved, notes=(*grid.notes, f"the cameras are {frame.description}"))


def _fit_moved(source: _Source, grid: GridFit) -> list[Fit]:
    """Fit a grid without missing pixels by slightly moved cameras; nothing if that does not fit.

    Also nothing if another convention fits or the colours of the photos disagree: views in the wrong order look the
    same.
    """
    inputs = source.inputs(grid)
    layouts = (layout.with_views_in(inputs.labellings) for layout in possible_layouts(inputs))
    readings = (score_layout(inputs, layout, IDENTITY) for layout in chain.from_iterable(layouts))
    best = None if inputs.scale is not None else min(readings, key=lambda reading: reading.worst_px, default=None)
    if best is None or not best.worst_px <= max_pixels(*grid.size):
        return []
    for other in _conventions(source.camera_file):
        other_inputs = replace(inputs, cameras=_with_poses(grid, other).cameras)
        if score_layout(other_inputs, best.layout, IDENTITY).ok:
            return []
    pairs = inputs.pairs(subsample(best.layout, _MOVED_SAMPLES))
    names, path = source.camera_file.names, str(source.camera_file.path)
    moved = move_cameras(pairs, grid.cameras, names, path, inputs.images)
    if moved is None:
        return []
    given = grid.cameras.viewmats if moved.confirmed else None
    moves = () if moved.confirmed else moved.moves
    grid = replace(grid, cameras=moved.cameras, notes=(*grid.notes, moved.note), moves=moves, given=given)
    return [fit for fit in source.fit([grid], exact_frames=True) if fit.recovery.confirmed is not False]


def _fit_sizes(source: _Source, camera_file: CameraFile, *, exact_frames: bool = False) -> list[Fit]:
    """Fit grids that differ in size from the photos, by positions only; return the likeliest group that fits.

    Sizes that follow only from the number of rows are tried in the frame of the cameras first; with ``exact_frames``
    all are.
    """
    guesses: list[GridFit] = []
    candidates = other_grids(source.ply.info, camera_file, photo_size(source.photos))
    for _, ranked in groupby(candidates, key=lambda grid: grid.rank):
        grids = [grid for grid in ranked if not grid.guessed or source.could_show(grid)]
        guesses += [grid for grid in grids if grid.guessed]
        exact = exact_frames or any(grid.guessed for grid in grids)
        fits = source.fit(grids, photos=False, exact_frames=exact)
        if fits:
            return fits
    fits = [] if exact_frames else source.fit(guesses[:_MAX_TRIED], photos=False)
    return [fit for fit in fits if fit.recovery.best.layout.kind != "pruned"]  # the number of rows leaves none out


def _make_result(source: _Source, fit: Fit) -> AlignmentResult:
    """Make the result for rows that are pixels, with cameras in the frame of the Gaussians."""
    inputs, grid, best = source.inputs(fit.grid), fit.grid, fit.recovery.best
    free_pages(vars(inputs.gaussians).values())  # the search has looked at all rows
    frame, layout, count = best.frame, best.layout, len(grid.cameras)
    notes, usual = [*grid.notes], source.camera_file
    if grid.camera_file.convention != usual.convention:
        notes.append(f"{describe_reading(grid.camera_file.convention, usual.convention)}: read so")
    if usual.source == ESTIMATED:
        from_what = "own grid" if usual.pixel_ids is None else "own order"
        separate = len(set(map(bytes, usual.Ks))) > 1
        what = "poses, and focal lengths that differ between the views," if separate else "poses and focal length"
        notes.append(f"no cameras were given: {what} are estimated from the Gaussians' {from_what}")
    in_order = layout.is_plain and frame is IDENTITY and len(layout.views) == count
    if in_order and layout.views == inputs.labellings[1] != inputs.labellings[0]:
        notes.append("views are in the order of the image names, not of the camera file")
    elif not (in_order and layout.views in inputs.labellings):
        used = len(set(layout.views))
        notes.append(f"read as: {fit.recovery.description}")
        notes += [f"{used} of {count} views are in the file"] * (used < count)
    return AlignmentResult(
        pixel_ids=layout.pixel_ids(len(inputs.gaussians)),
        cameras=grid.cameras if frame is IDENTITY else frame.move(grid.cameras),
        images=inputs.images,
        camera_file=grid.camera_file,
        notes=tuple(notes),
        transform=grid.transform,
        recovery=fit.recovery,
        moves=grid.moves,
        given=None if grid.given is None else frame.move_viewmats(grid.given),
    )
