"""Search the size of the grid, the frame and the convention of the poses, and the photos' size, cheap first.

``layouts`` lists possible orders, ``ordered_rows`` and ``incomplete`` search files that lack pixels, ``score``
measures, ``recovery`` decides for one grid, ``cameras`` reads or moves poses, ``unaligned`` chooses those of rows
without pixels, ``explain`` says why there are none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np

from gsmerge.alignment.cameras import ESTIMATED, MovedCameras, Poses, max_pixels, move_cameras, other_conventions
from gsmerge.alignment.explain import explain_count
from gsmerge.alignment.layouts import (
    MAY_BE_UNALIGNED,
    GridFit,
    Layout,
    other_grids,
    photo_grid,
    small_photos_error,
    subsample,
    view_orders,
)
from gsmerge.alignment.photos_alone import WITH_PHOTOS
from gsmerge.alignment.recovery import SMALLEST_PX, Recovery, is_seen, possible_layouts, recover
from gsmerge.alignment.score import MARGIN, AlignmentInput, color_error, scale_by, score_layout
from gsmerge.alignment.unaligned import check_cameras, choose_cameras
from gsmerge.errors import SceneError
from gsmerge.geometry import IDENTITY, Similarity
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.formats.ply import PlyScene
from gsmerge.io.photo_files import Photos, PhotoTransform, Size, as_floats, photo_size
from gsmerge.runtime.memory import free_pages
from gsmerge.types import Cameras

_LARGE = 2  # times as many pixels as rows: likely photos of another size than the grid's
_ALIKE, _ALIKE_PX = 1.15, 0.02  # two fits of one grid between which only the photos' colours can decide
_MAX_TRIED = 6  # grids that only the number of rows speaks for and that are tried with all frames
_MOVED_SAMPLES = 2000  # Gaussians of a view that its moved pose is solved from


@dataclass(frozen=True)
class AlignmentResult:
    """The pixel of every row, or the cameras that see rows without pixels, with a description of the search."""

    # ``[n]`` int64, the pixel ``(block·H + y)·W + x`` of each row, -1: none; None where the rows belong to no pixels.
    # A block is a view, or one layer of a view with several Gaussians per pixel
    pixel_ids: np.ndarray | None
    cameras: Cameras  # all c views, in the frame of the Gaussians, at the size of the grid
    images: np.ndarray | None  # ``[c,h,w,3]`` photos of that size, sRGB in [0, 1], float32
    camera_file: CameraFile | None  # as it was read in the end; None where there are no cameras
    notes: tuple[str, ...] = ()  # what was adapted, one sentence each
    transform: PhotoTransform | None = None  # what was done to the photos
    recovery: Recovery | None = None  # which reading of the rows won, and by how much; None without pixels
    moves: Sequence[dict[str, Any]] = ()  # how far each camera was moved to its Gaussians; empty where none was
    problem: str | None = None  # why the rows belong to no pixels; None where they do

    @property
    def layout(self) -> Layout | None:
        """Layout of the rows, block by block; None without pixels."""
        return None if self.recovery is None else self.recovery.best.layout

    @property
    def views(self) -> tuple[int, ...]:
        """Camera of each block; all cameras without pixels."""
        return tuple(range(len(self.cameras))) if self.layout is None else self.layout.views


@dataclass(frozen=True)
class _Source:
    """The Gaussians, the cameras, the photos and the known facts about the rows."""

    ply: PlyScene
    camera_file: CameraFile
    photos: Photos | None
    order: str
    scale: float | None
    depths: Callable[[], np.ndarray | None]
    seen: dict[Size, bool] = field(default_factory=dict)  # what is known of :meth:`may_be`

    @cached_property
    def images(self) -> np.ndarray | None:
        """Photos at their own size, ``[c,h,w,3]`` float32."""
        return None if self.photos is None else as_floats(self.photos)

    def may_be(self, grid: GridFit) -> bool:
        """Return whether any cameras could show the rows as the pixels of a grid; remembered for each size."""
        if grid.size not in self.seen:
            inputs = self.inputs(grid, photos=False)
            self.seen[grid.size] = is_seen(inputs, possible_layouts(inputs))
        return self.seen[grid.size]

    def inputs(self, grid: GridFit, *, photos: bool = True) -> AlignmentInput:
        """Put rows, cameras and photos at the size of a grid together; without photos where only positions matter."""
        images = None
        if photos and self.photos is not None:
            images = self.images if grid.transform is None else as_floats(grid.transform.photos(self.photos))
        return AlignmentInput(
            gaussians=self.ply.gaussians,
            valid=self.ply.valid,
            cameras=grid.cameras,
            images=images,
            labellings=view_orders(self.camera_file.names),
            depths=self.depths,
            order=self.order,
            scale=self.scale,
        )


@dataclass(frozen=True)
class _Fit:
    """A grid of which rows are the pixels, under poses in one convention."""

    grid: GridFit
    camera_file: CameraFile
    inputs: AlignmentInput
    recovery: Recovery
    moved: MovedCameras | None = None

    @property
    def px(self) -> float:
        """Median distance of the Gaussians from their pixels, in the worst view."""
        return self.recovery.best.worst_px


def align(
    ply: PlyScene,
    camera_file: CameraFile,
    photos: Photos | None = None,
    *,
    order: str = "auto",
    scale: float | None = None,
    depths: Callable[[], np.ndarray | None] = lambda: None,
    frames: Callable[[], Sequence[Similarity]] = tuple,
) -> AlignmentResult:
    """Find the pixel of every row; for rows that belong to none, the poses from which the cameras see them.

    The size of the grid, the frame and the convention of the poses, and the transform of the photos are searched
    too.

    Args:
        ply: The file's rows.
        camera_file: Its cameras.
        photos: c uint8 photos of one size.
        order: The order of the rows where it is known, see :class:`gsmerge.io.ReadHints`.
        scale: Size of the Gaussians' world in units of the cameras', where it is given.
        depths: Reads ``[c,h,w]`` depth maps next to the cameras; None where there are none.
        frames: Reads the frames that a file names in which the cameras may see rows without pixels.

    Raises:
        SceneError: If sizes do not agree, several conventions fit, the Gaussians are not those of the cameras' views,
            or other cameras would make pixels of the rows.
    """
    source = _Source(ply, camera_file, photos, order, scale, depths)
    sizes = _fits_of_other_sizes(source)
    try:
        grid = photo_grid(camera_file, photo_size(photos))
    except SceneError:
        fit = next(filter(None, sizes), None)
        if fit is None:
            raise
        return _make_result(source, fit)
    fit = next(filter(None, _fits(source, grid, sizes)), None)
    if fit is not None:
        return _make_result(source, fit)
    small = small_photos_error(ply.info, camera_file, photo_size(photos)) if order not in MAY_BE_UNALIGNED else None
    if small is not None:
        raise small
    inputs = source.inputs(grid)
    why = explain_count(ply.info, inputs, camera_file)
    if scale is not None:
        inputs = replace(inputs, cameras=scale_by(scale).move(inputs.cameras))
    cameras, camera_file, notes = choose_cameras(inputs, camera_file, frames(), why)
    return AlignmentResult(
        None, cameras, inputs.images, camera_file, (*grid.notes, *notes), grid.transform, problem=why.problem
    )


def _fits(source: _Source, grid: GridFit, sizes: Iterator[_Fit | None]) -> Iterator[_Fit | None]:
    """Try the photos' size and all others, with poses as stored, moved, and in other conventions, the likely first."""
    large = len(grid.cameras) * math.prod(grid.size) > _LARGE * len(source.ply.gaussians)
    if large:
        yield next(sizes, None)
    inputs = source.inputs(grid)
    yield _fit(grid, source.camera_file, inputs)
    if source.order not in MAY_BE_UNALIGNED:
        yield _fit_moved(grid, source.camera_file, inputs)
    if not large:
        yield next(sizes, None)
    if source.order != "none":
        yield _choose_convention(_fit_posed(grid, other, inputs) for other in _conventions(source.camera_file))
    yield from sizes


def _fits_of_other_sizes(source: _Source) -> Iterator[_Fit | None]:
    """Try other sizes than the photos'; next, other conventions of the poses as well."""
    if source.order != "none":
        yield _fit_size(source, source.camera_file)
    if source.order not in MAY_BE_UNALIGNED:
        others = _conventions(source.camera_file)
        yield _choose_convention(_fit_size(source, other, exact_frames=True) for other in others)


def _conventions(camera_file: CameraFile) -> Iterator[CameraFile]:
    """Yield the cameras with their poses read in each other convention."""
    for poses in other_conventions(camera_file.viewmats, camera_file.convention):
        yield replace(camera_file, viewmats=poses.viewmats, convention=poses.convention)


def _fit(grid: GridFit, camera_file: CameraFile, inputs: AlignmentInput, *, exact_frames: bool = False) -> _Fit | None:
    """Recover the pixels of the rows in a grid; None if they are not its pixels."""
    recovery = recover(inputs, exact_frames=exact_frames)
    return None if recovery is None else _Fit(grid, camera_file, inputs, recovery)


def _fit_posed(grid: GridFit, camera_file: CameraFile, inputs: AlignmentInput) -> _Fit | None:
    """Fit a grid under poses in another convention, if the cameras see the Gaussians then."""
    inputs = replace(inputs, cameras=replace(inputs.cameras, viewmats=camera_file.viewmats))
    seen = check_cameras(inputs.gaussians, inputs.valid, inputs.cameras, None).ok
    return _fit(grid, camera_file, inputs) if seen else None


def _fit_moved(grid: GridFit, camera_file: CameraFile, inputs: AlignmentInput) -> _Fit | None:
    """Fit a grid without missing pixels under slightly moved cameras; None where that does not fit.

    None, too, where another convention fits or the photos' colours disagree: views in the wrong order look the same.
    """
    if inputs.scale is not None:
        return None
    layouts = (
        layout for any_views in possible_layouts(inputs) for layout in any_views.with_views_in(inputs.labellings)
    )
    readings = (score_layout(inputs, layout, IDENTITY) for layout in layouts)
    best = min(readings, key=lambda reading: reading.worst_px, default=None)
    if best is None or not best.worst_px <= max_pixels(*grid.size):
        return None
    for other in _conventions(camera_file):
        posed = replace(inputs, cameras=replace(inputs.cameras, viewmats=other.viewmats))
        if score_layout(posed, best.layout, IDENTITY).ok:
            return None
    pairs = inputs.pairs(subsample(best.layout, _MOVED_SAMPLES))
    moved = move_cameras(pairs, inputs.cameras, camera_file.names, str(camera_file.path))
    if moved is None:
        return None
    fit = _fit(grid, camera_file, replace(inputs, cameras=moved.cameras), exact_frames=True)
    return None if fit is None or fit.recovery.confirmed is False else replace(fit, moved=moved)


def _fit_size(source: _Source, camera_file: CameraFile, *, exact_frames: bool = False) -> _Fit | None:
    """Find the other size that puts the Gaussians nearest to their pixels; None where grids of two sizes do.

    Sizes that only the number of rows suggests are tried in the cameras' own frame first; with ``exact_frames`` all
    are.
    """
    fits: list[_Fit] = []
    guesses: list[GridFit] = []
    others = other_grids(source.ply.info, camera_file, photo_size(source.photos))
    for _, ranked in groupby(others, key=lambda grid: grid.rank):
        grids = [grid for grid in ranked if not grid.guessed or source.may_be(grid)]
        guesses += [grid for grid in grids if grid.guessed]
        exact = exact_frames or any(grid.guessed for grid in grids)
        fits = _fit_grids(source, camera_file, grids, exact_frames=exact)
        if fits:
            break
    if not (fits or exact_frames):
        fits = _fit_grids(source, camera_file, guesses[:_MAX_TRIED], exact_frames=False)
    if not fits:
        return None
    best = min(fits, key=lambda fit: fit.px)
    exact = best.recovery.best.layout.kind != "pruned"  # what lacks pixels fits into grids of nearly its size as well
    next_px = min((fit.px for fit in fits if fit.grid.size != best.grid.size), default=math.inf)
    if exact and next_px < MARGIN * max(best.px, SMALLEST_PX):
        return None
    near = max(_ALIKE * best.px, best.px + _ALIKE_PX)
    alike = [fit for fit in fits if fit.grid.size == best.grid.size and fit.px <= near]
    alike = [replace(fit, inputs=source.inputs(fit.grid)) for fit in alike]
    errors = [color_error(fit.inputs, fit.recovery.best.layout) for fit in alike] if len(alike) > 1 else [0.0]
    return alike[int(np.argmin(np.nan_to_num(errors, nan=1.0)))]


def _fit_grids(source: _Source, camera_file: CameraFile, grids: Sequence[GridFit], *, exact_frames: bool) -> list[_Fit]:
    """Fit grids of several sizes by the positions alone; those that do not fit are left out."""
    inputs = ((grid, source.inputs(grid, photos=False)) for grid in grids)
    fits = (_fit(grid, camera_file, rows, exact_frames=exact_frames) for grid, rows in inputs)
    return [fit for fit in fits if fit is not None]


def _choose_convention(fits: Iterable[_Fit | None]) -> _Fit | None:
    """Choose the fit in the one convention that fits; None without one, SceneError if several fit about as well."""
    best, *others = sorted(filter(None, fits), key=lambda fit: fit.px) or [None]
    if best is None or not others or others[0].px >= MARGIN * max(best.px, SMALLEST_PX):
        return best
    one, other = (Poses(fit.camera_file.convention, fit.camera_file.viewmats) for fit in (best, others[0]))
    both = f"{one.description} and as {other.description}"
    problem = f"expected poses that fit in one reading, found that they fit as {both}"
    raise SceneError(best.camera_file.path, problem, "convert them to the format's own")


def _make_result(source: _Source, fit: _Fit) -> AlignmentResult:
    """Make the result of rows that are pixels, with the cameras in the frame of the Gaussians."""
    inputs, camera_file, best = fit.inputs, fit.camera_file, fit.recovery.best
    free_pages(vars(inputs.gaussians).values())  # the search has looked at all rows
    frame, layout, count = best.frame, best.layout, len(inputs.cameras)
    notes = [*fit.grid.notes]
    if fit.moved is not None:
        notes.append(fit.moved.note)
    if camera_file.convention != source.camera_file.convention:
        poses = Poses(camera_file.convention, camera_file.viewmats)
        notes.append(f"{poses.describe(source.camera_file.convention)}: read so")
    if camera_file.source in (ESTIMATED, WITH_PHOTOS):
        from_what = "own grid" if camera_file.source == ESTIMATED else "order and the photos' colours"
        notes.append(f"no cameras were given: poses and focal length are estimated from the Gaussians' {from_what}")
    in_order = layout.is_plain and frame is IDENTITY and len(layout.views) == count
    if in_order and layout.views == inputs.labellings[1] != inputs.labellings[0]:
        notes.append("views are in the order of the image names, not of the camera file")
    elif not (in_order and layout.views in inputs.labellings):
        used = len(set(layout.views))
        notes.append(f"read as: {fit.recovery.description}")
        notes += [f"{used} of {count} views are in the file"] * (used < count)
    return AlignmentResult(
        pixel_ids=layout.pixel_ids(len(inputs.gaussians)),
        cameras=inputs.cameras if frame is IDENTITY else frame.move(inputs.cameras),
        images=inputs.images,
        camera_file=camera_file,
        notes=tuple(notes),
        transform=fit.grid.transform,
        recovery=fit.recovery,
        moves=() if fit.moved is None else fit.moved.moves,
    )
