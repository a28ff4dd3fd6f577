"""Find the pixel that each row of a file belongs to; :func:`align` is the door, and the modules here are private.

``layouts`` lists possible orders, ``ordered_rows`` and ``incomplete`` search files that lack pixels, ``score``
measures, ``recovery`` decides or explains, ``cameras`` reads, moves or estimates poses, ``unaligned`` chooses those
of rows without pixels, ``focal`` estimates focal lengths, ``rotations`` reads quaternions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any

import numpy as np

from gsmerge.alignment.cameras import ESTIMATED, max_pixels
from gsmerge.alignment.cameras import estimate_cameras as estimate_cameras
from gsmerge.alignment.cameras import move_cameras as move_cameras
from gsmerge.alignment.cameras import other_conventions as other_conventions
from gsmerge.alignment.dropped_depths import guess_depths as guess_depths
from gsmerge.alignment.focal import estimate_focal as estimate_focal
from gsmerge.alignment.layouts import MAY_BE_UNALIGNED as MAY_BE_UNALIGNED
from gsmerge.alignment.layouts import GridFit, other_grids, photo_grid, small_photos_error, subsample
from gsmerge.alignment.layouts import Layout as Layout
from gsmerge.alignment.layouts import fill_from_depths as fill_from_depths
from gsmerge.alignment.photos_alone import WITH_PHOTOS as WITH_PHOTOS
from gsmerge.alignment.photos_alone import estimate_with_photos as estimate_with_photos
from gsmerge.alignment.recovery import Recovery as Recovery
from gsmerge.alignment.recovery import explain_count, is_seen, possible_layouts, recover
from gsmerge.alignment.recovery import explain_misalignment as explain_misalignment
from gsmerge.alignment.recovery import misalignment_error as misalignment_error
from gsmerge.alignment.rotations import choose_rotations as choose_rotations
from gsmerge.alignment.rotations import read_rotations as read_rotations
from gsmerge.alignment.score import MARGIN, AlignmentInput, color_error, scale_by, score_layout
from gsmerge.alignment.score import Alignment as Alignment
from gsmerge.alignment.score import check_alignment as check_alignment
from gsmerge.alignment.score import check_pairs as check_pairs
from gsmerge.alignment.score import sample_pixels as sample_pixels
from gsmerge.alignment.unaligned import check_cameras as check_cameras
from gsmerge.alignment.unaligned import choose_cameras
from gsmerge.alignment.unaligned import choose_poses as choose_poses
from gsmerge.alignment.unaligned import find_padding as find_padding
from gsmerge.errors import SceneError
from gsmerge.geometry import IDENTITY, Similarity
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.formats.read import GaussianFile as PlyScene
from gsmerge.io.image_names import natural_key
from gsmerge.io.photo_files import Photos, PhotoTransform, Size, as_floats, photo_size
from gsmerge.runtime.memory import free_pages
from gsmerge.types import Cameras

_LARGE = 2  # times as many pixels as rows: likely photos of another size than the grid's
_ALIKE, _ALIKE_PX = 1.15, 0.02  # two fits of one grid between which only the photos' colours can decide
_MAX_TRIED = 6  # fits that only the number of rows speaks for and that are tried with all frames
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
    """The Gaussians, the photos and the known facts about the rows."""

    ply: PlyScene
    photos: Photos | None
    order: str
    scale: float | None
    depths: Callable[[], np.ndarray | None]
    seen: dict[tuple[Size, int], bool] = field(default_factory=dict)  # what is known of :meth:`may_be`

    def may_be(self, camera_file: CameraFile, grid: GridFit) -> bool:
        """Return whether any cameras could show the rows as the pixels of a grid; remembered for each size."""
        key = grid.size, len(grid.cameras)
        if key not in self.seen:
            inputs = self.inputs(camera_file, grid, photos=False)
            self.seen[key] = is_seen(inputs, possible_layouts(inputs))
        return self.seen[key]

    def inputs(self, camera_file: CameraFile, grid: GridFit, *, photos: bool = True) -> AlignmentInput:
        """Put rows, cameras and photos at the size of a grid together; without photos where only positions matter."""
        fitted = self.photos if photos else None
        if fitted is not None and grid.transform is not None:
            fitted = grid.transform.photos(fitted)
        names = camera_file.names
        return AlignmentInput(
            gaussians=self.ply.gaussians,
            valid=self.ply.valid,
            cameras=grid.cameras,
            images=None if fitted is None else as_floats(fitted),
            labellings=[list(range(len(names))), sorted(range(len(names)), key=lambda i: natural_key(names[i]))],
            depths=self.depths,
            order=self.order,
            scale=self.scale,
        )


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
    source = _Source(ply, photos, order, scale, depths)
    try:
        grid = photo_grid(camera_file, photo_size(photos))
    except SceneError:
        result = next(filter(None, _other_sizes(source, camera_file)), None)
        if result is None:
            raise
        return result
    inputs = cache(partial(source.inputs, camera_file, grid))
    result = next(filter(None, _readings(source, camera_file, grid, inputs)), None)
    if result is not None:
        return result
    small = small_photos_error(ply.info, camera_file, photo_size(photos)) if order not in MAY_BE_UNALIGNED else None
    if small is not None:
        raise small
    final = inputs()
    why = explain_count(ply.info, final, camera_file)
    if scale is not None:
        final = replace(final, cameras=scale_by(scale).move(final.cameras))
    cameras, camera_file, notes = choose_cameras(final, camera_file, frames(), why)
    return AlignmentResult(
        None, cameras, final.images, camera_file, (*grid.notes, *notes), grid.transform, problem=why.problem
    )


def _readings(
    source: _Source, camera_file: CameraFile, grid: GridFit, make_inputs: Callable[[], AlignmentInput]
) -> Iterator[AlignmentResult | None]:
    """Try the photos' size and all others, with poses as stored, moved, and in other conventions, the likely first."""
    large = len(grid.cameras) * math.prod(grid.size) > _LARGE * len(source.ply.gaussians)
    others = _other_sizes(source, camera_file)
    if large:
        yield next(others, None)
    inputs = make_inputs()
    yield _with_pixels(inputs, recover(inputs), camera_file, grid)
    if source.order not in MAY_BE_UNALIGNED:
        yield _move_cameras(inputs, camera_file, grid)
    if not large:
        yield next(others, None)
    if source.order != "none":
        yield _change_poses(camera_file, partial(_read_poses, inputs, grid))
    yield from others


def _other_sizes(source: _Source, camera_file: CameraFile) -> Iterator[AlignmentResult | None]:
    """Try other sizes than the photos'; next, other conventions of the poses as well."""
    yield _change_size(source, camera_file) if source.order != "none" else None
    if source.order not in MAY_BE_UNALIGNED:
        yield _change_poses(camera_file, partial(_change_size, source, exact_frames=True))


def _change_size(
    source: _Source, camera_file: CameraFile, *notes: str, exact_frames: bool = False
) -> AlignmentResult | None:
    """Find the other size that puts the Gaussians nearest to their pixels; None where grids of two sizes do.

    Sizes that only the number of rows suggests are tried in the cameras' own frame first; with ``exact_frames`` all
    are.
    """
    recoveries: list[tuple[GridFit, Recovery]] = []
    guesses: list[GridFit] = []

    def try_grid(grid: GridFit, *, exact_frames: bool) -> None:
        recovery = recover(source.inputs(camera_file, grid, photos=False), exact_frames=exact_frames)
        if recovery is not None:
            recoveries.append((grid, recovery))

    for grid in other_grids(source.ply.info, camera_file, photo_size(source.photos)):
        if recoveries and grid.rank > recoveries[0][0].rank:
            break
        if grid.guessed and not source.may_be(camera_file, grid):
            continue
        if grid.guessed:
            guesses.append(grid)
        try_grid(grid, exact_frames=grid.guessed or exact_frames)
    for grid in guesses[:_MAX_TRIED] if not (recoveries or exact_frames) else []:
        try_grid(grid, exact_frames=False)
    if not recoveries:
        return None
    size, best = min(((grid.size, recovery.best) for grid, recovery in recoveries), key=lambda one: one[1].worst_px)
    px = best.worst_px
    exact = best.layout.kind != "pruned"  # what lacks pixels fits into grids of nearly its size as well
    others = (recovery.best.worst_px for grid, recovery in recoveries if grid.size != size)
    if exact and any(other < MARGIN * max(px, 1e-3) for other in others):
        return None
    near = max(_ALIKE * px, px + _ALIKE_PX)
    alike = [
        (source.inputs(camera_file, grid), recovery, grid)
        for grid, recovery in recoveries
        if grid.size == size and recovery.best.worst_px <= near
    ]
    errors = [color_error(inputs, recovery.best.layout) for inputs, recovery, _ in alike] if len(alike) > 1 else [0.0]
    inputs, recovery, grid = alike[int(np.argmin(np.nan_to_num(errors, nan=1.0)))]
    return _with_pixels(inputs, recovery, camera_file, grid, *notes)


def _change_poses(
    camera_file: CameraFile, read: Callable[[CameraFile, str], AlignmentResult | None]
) -> AlignmentResult | None:
    """Read poses in the one other convention that fits; None without one, SceneError if several fit about as well."""
    fits = []
    for poses in other_conventions(camera_file.viewmats, camera_file.convention):
        other = replace(camera_file, viewmats=poses.viewmats, convention=poses.convention)
        result = read(other, f"{poses.describe(camera_file.convention)}: read so")
        if result is not None and result.recovery is not None:
            fits.append((result.recovery.best.worst_px, poses.description, result))
    fits.sort(key=lambda one: one[0])
    if len(fits) > 1 and fits[1][0] < MARGIN * max(fits[0][0], 1e-3):
        both = f"{fits[0][1]} and as {fits[1][1]}"
        problem = f"expected poses that fit in one reading, found that they fit as {both}"
        raise SceneError(camera_file.path, problem, "convert them to the format's own")
    return fits[0][2] if fits else None


def _read_poses(inputs: AlignmentInput, grid: GridFit, camera_file: CameraFile, note: str) -> AlignmentResult | None:
    """Recover the pixels under poses in another convention, if the cameras see the Gaussians then."""
    inputs = replace(inputs, cameras=replace(inputs.cameras, viewmats=camera_file.viewmats))
    if not check_cameras(inputs.gaussians, inputs.valid, inputs.cameras, None).ok:
        return None
    return _with_pixels(inputs, recover(inputs), camera_file, grid, note)


def _move_cameras(inputs: AlignmentInput, camera_file: CameraFile, grid: GridFit) -> AlignmentResult | None:
    """Read a file without missing pixels under slightly moved cameras; None where that does not fit.

    None, too, where another convention fits or the photos' colours disagree: views in the wrong order look the same.
    """
    if inputs.scale is not None:
        return None
    scores = [
        score_layout(inputs, replace(layout, views=tuple(labelling[view] for view in layout.views)), IDENTITY)
        for layout in possible_layouts(inputs)
        for labelling in dict.fromkeys(map(tuple, inputs.labellings))
    ]
    best = min(scores, key=lambda score: score.worst_px, default=None)
    if best is None or not best.worst_px <= max_pixels(inputs.cameras.width, inputs.cameras.height):
        return None
    for poses in other_conventions(inputs.cameras.viewmats, camera_file.convention):
        other = replace(inputs, cameras=replace(inputs.cameras, viewmats=poses.viewmats))
        if score_layout(other, best.layout, IDENTITY).ok:
            return None
    pairs = inputs.pairs(subsample(best.layout, _MOVED_SAMPLES))
    moved = move_cameras(pairs, inputs.cameras, camera_file.names, str(camera_file.path))
    if moved is None:
        return None
    inputs = replace(inputs, cameras=moved.cameras)
    recovery = recover(inputs, exact_frames=True)
    if recovery is None or recovery.confirmed is False:
        return None
    return _with_pixels(inputs, recovery, camera_file, grid, moved.note, moves=moved.moves)


def _with_pixels(
    inputs: AlignmentInput,
    recovery: Recovery | None,
    camera_file: CameraFile,
    grid: GridFit,
    *notes: str,
    moves: Sequence[dict[str, Any]] = (),
) -> AlignmentResult | None:
    """Make the result of rows that are pixels, with the cameras in the frame of the Gaussians; None if they are not."""
    if recovery is None:
        return None
    free_pages(vars(inputs.gaussians).values())  # the search has looked at all rows
    frame, layout, count = recovery.best.frame, recovery.best.layout, len(inputs.cameras)
    if camera_file.source in (ESTIMATED, WITH_PHOTOS):
        from_what = "own grid" if camera_file.source == ESTIMATED else "order and the photos' colours"
        text = f"no cameras were given: poses and focal length are estimated from the Gaussians' {from_what}"
        notes = (*notes, text)
    in_order = layout.is_plain and frame is IDENTITY and len(layout.views) == count
    if in_order and layout.views == tuple(inputs.labellings[0]):
        pass
    elif in_order and layout.views == tuple(inputs.labellings[1]):
        notes = (*notes, "views are in the order of the image names, not of the camera file")
    else:
        used = len(set(layout.views))
        notes = (*notes, f"read as: {recovery.description}")
        notes += (f"{used} of {count} views are in the file",) * (used < count)
    return AlignmentResult(
        pixel_ids=layout.pixel_ids(len(inputs.gaussians)),
        cameras=inputs.cameras if frame is IDENTITY else frame.move(inputs.cameras),
        images=inputs.images,
        camera_file=camera_file,
        notes=(*grid.notes, *notes),
        transform=grid.transform,
        recovery=recovery,
        moves=moves,
    )
