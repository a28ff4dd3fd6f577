"""Find the cameras that show the Gaussians of a file in place, and the pixel of each row if rows are pixels.

Most files are plain: rows are the pixels in order, and the stored cameras show them there. In other files the rows are
all pixels in another order, or the Gaussians have another world than the cameras. The pose of each view then follows
from the rows alone. Two things remain unknown: the file's camera of each view, and the similarity from the world of the
cameras to the world of the Gaussians. They are searched in each convention of the poses and each likely order of the
views. If no layout of all pixels fits, cameras are searched under which the Gaussians lie on the centres of pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from gsmerge.alignment.cameras import NEAR_PX, describe_other_convention, max_pixels, move_cameras
from gsmerge.alignment.centres import CentreCheck, check_centres, find_rows, sample_points
from gsmerge.alignment.frames import exporter_frames, scale_by
from gsmerge.alignment.grids import (
    Grid,
    PlacedGrid,
    file_grids,
    grids_of,
    network_sizes,
    photo_grid,
    shown_sizes,
    small_photos_error,
    square_sizes,
    with_photo_size,
)
from gsmerge.alignment.judge import Candidate, Recovery, judge
from gsmerge.alignment.layouts import (
    ESTIMATED,
    MAY_BE_UNALIGNED,
    Layout,
    depth_layouts,
    dropped_layout,
    exact_layouts,
    plain_layout,
    subsample,
    view_orders,
)
from gsmerge.alignment.match import GridLayout, RowSource, match_views, other_grids, rescore
from gsmerge.alignment.most_views import align_most_views, describe_misfits
from gsmerge.alignment.score import AS_NEAR_PX, SHUFFLED_MARGIN, score_layout
from gsmerge.errors import SceneError
from gsmerge.geometry import IDENTITY, Similarity
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.formats.read import GaussianFile
from gsmerge.io.photo_files import PhotoArrays, PhotoTransform, photo_size, same_shape
from gsmerge.runtime.memory import free_pages
from gsmerge.types import Cameras

_PLAIN_PX = 0.5  # rows in order that are nearer to their pixels, pixels, need no search
_MIN_ROWS, _MIN_SHARE = 24, 0.05  # finite rows needed to find pixels: this number, or this share of all rows
_MANY_PIXELS = 4  # pixels per row above which the grid is probably smaller than the photos
_MOVED_GAUSSIANS = 2000  # Gaussians of a view that its moved pose is solved from


@dataclass(frozen=True, eq=False)
class AlignmentResult:
    """Result of :func:`align`: the pixel of every row, or for rows without pixels the cameras that see them."""

    # ``[n]`` int64, the pixel ``(part·H + y)·W + x`` of each row, -1: none; None if the rows belong to no pixels.
    # A part is a view, or one layer of a view with several Gaussians per pixel
    pixel_ids: np.ndarray | None
    cameras: Cameras  # all c views, in the frame of the Gaussians, at the size of the grid
    images: np.ndarray  # ``[c,h,w,3]`` photos of that size, sRGB in [0, 1], float32; [0,...] without any
    camera_file: CameraFile | None  # in the chosen convention and frame; None without cameras
    notes: tuple[str, ...] = ()  # what was adapted, one sentence each
    transform: PhotoTransform | None = None  # applied to the photos
    recovery: Recovery | None = None  # the chosen layout of the rows, and its margin; None without pixels
    moves: Sequence[dict[str, Any]] = ()  # how far each camera was moved to its Gaussians; empty if none was moved
    given: np.ndarray | None = None  # ``[c,4,4]`` given poses, to which views are to be moved with their Gaussians
    problem: str | None = None  # why the rows belong to no pixels; None if they do
    left_out: tuple[str, ...] = ()  # notes on views and cameras that do not fit each other

    @property
    def layout(self) -> Layout | None:
        """The chosen layout, with the pixel of each row; None for rows without pixels."""
        return None if self.recovery is None else self.recovery.best.layout

    @property
    def views(self) -> tuple[int, ...]:
        """Camera of each part; for rows without pixels, all cameras."""
        return tuple(range(len(self.cameras))) if self.layout is None else self.layout.views


def align(
    ply: GaussianFile,
    camera_file: CameraFile,
    photos: PhotoArrays = (),
    *,
    order: str = "auto",
    scale: float | None = None,
    depths: Callable[[], np.ndarray | None] = lambda: None,
    frames: Callable[[], Sequence[Similarity]] = tuple,
) -> AlignmentResult:
    """Find the pixel of every row; for rows without pixels, choose the camera poses that see them.

    Also finds the size of the grid, the frame and convention of the poses, and the transform of the photos.

    Args:
        ply: The file's rows.
        camera_file: Its cameras.
        photos: c uint8 photos of one size, or none.
        order: The order of the rows if it is known, see :class:`gsmerge.settings.reading.ReadHints`.
        scale: Length of one unit of the cameras' world in the world of the Gaussians, if it is given.
        depths: Reads ``[c,h,w]`` depth maps next to the cameras; returns None if there are none.
        frames: Reads the frames that a file gives for the cameras; used only for rows without pixels.

    Raises:
        SceneError: If sizes do not agree, if poses fit in several conventions, if no cameras see the Gaussians, or if
            the rows are the pixels of other cameras or of larger photos.
    """
    camera_file = with_photo_size(camera_file, photo_size(photos))
    source = RowSource(ply, camera_file, photos, order, scale, depths)
    grids, problem = file_grids(camera_file, source.size), None
    try:
        grids.insert(0, photo_grid(camera_file, source.size))
    except SceneError as error:
        problem = error
    result = _align_in_order(source, grids) or _search(source, grids)
    if problem is not None:
        # rows that lack pixels also fit cameras of other shapes, so photos have to confirm them
        if isinstance(result, Recovery) and (result.best.layout.kind != "pruned" or result.confirmed):
            return _make_result(source, result)
        best_grid = _choose_grid(source, grids)
        if best_grid is None:
            raise problem
        return _choose_cameras(source, best_grid, frames, None)
    if isinstance(result, Recovery):
        return _make_result(source, result)
    return _choose_cameras(source, grids[0] if result is None else result.grid, frames, result)


def _align_in_order(source: RowSource, grids: Sequence[Grid]) -> Recovery | None:
    """Take the rows as the pixels of the stored cameras in order, as in most files; None if that is not certain.

    If the cameras were estimated from the rows, the rows have the pixels of that estimate instead.
    """
    count, pixel_ids, candidates = len(source.ply.gaussians), source.camera_file.pixel_ids, []
    for grid in grids:
        inputs = source.inputs(grid, photos=False)
        if pixel_ids is not None:
            layout = dropped_layout(pixel_ids, len(grid.cameras), *grid.size)
            candidates.append(Candidate(grid, score_layout(inputs, layout, IDENTITY)))
        elif count == len(grid.cameras) * math.prod(grid.size) and source.may_be("view-major") and _has_rows(source):
            layouts = plain_layout(len(grid.cameras), *grid.size).with_views_in(source.orders(grid))
            in_order, *in_other_orders = (score_layout(inputs, layout, IDENTITY) for layout in layouts)
            worst_px = in_order.alignment.worst_px
            far_px = SHUFFLED_MARGIN * max(worst_px, AS_NEAR_PX)
            is_only_order = all(scored.alignment.worst_px >= far_px for scored in in_other_orders)
            if source.scale is None and worst_px <= _PLAIN_PX and is_only_order:
                candidates.append(Candidate(grid, in_order))
    candidates = [candidate for candidate in candidates if candidate.scored.alignment.ok]
    return judge(candidates, source.inputs, lambda candidate: candidate) if candidates else None


def _has_rows(source: RowSource) -> bool:
    """Return True if enough rows are finite to find their pixels."""
    finite = int(source.ply.valid.sum())
    return finite >= _MIN_ROWS or finite >= _MIN_SHARE * len(source.ply.gaussians)


# Search for pixels and cameras


def _search(source: RowSource, known_grids: Sequence[Grid]) -> Recovery | PlacedGrid | None:
    """Find the pixels of the rows, or at least cameras that show the Gaussians in place; None if neither is found.

    ``known_grids`` are the grids of the sizes that files give.
    """
    if source.order == "none" or not _has_rows(source):
        return None
    recovery: Recovery | None = None
    place: PlacedGrid | None = None
    for result in _run_searches(source, known_grids):
        if isinstance(result, PlacedGrid):
            place = place or _at_photo_size(result, known_grids)
            if not _have_smaller_grid(source, len(result.grid.cameras), result.grid):
                break
        elif result is not None:
            recovery = result if recovery is None or result.chosen.px < recovery.chosen.px else recovery
            if not recovery.chosen.is_doubtful:
                return recovery
    return recovery or place


def _run_searches(source: RowSource, known_grids: Sequence[Grid]) -> Iterator[Recovery | PlacedGrid | None]:
    """Yield the results of one search after another: by the number of rows, by pixel centres, by the rows' own grid."""
    recovery = _match(source, [(grid, layout) for grid in known_grids for layout in _layouts(source, grid)])
    yield recovery
    if recovery is None and known_grids:
        yield _move_cameras(source, known_grids[0])
        yield align_most_views(source, known_grids[0])
    yield _align_by_centres(source, (place for grid in known_grids for place in _usual_places(source, grid)))
    if source.order not in MAY_BE_UNALIGNED:
        from gsmerge.alignment.row_grid import find_layouts  # here because few files need it

        layouts = find_layouts(source.ply.gaussians, source.ply.valid)
        shape = (layouts[0].width, layouts[0].height) if layouts else (0, 0)
        grids = grids_of(source.camera_file, source.size, partial(shown_sizes, shape=shape)) if layouts else []
        grid_layouts = [(grid, layout) for grid in grids for layout in _layouts(source, grid)]
        yield _match(source, [(grid, layout) for grid, layout in grid_layouts if _has_shape_of(layout, layouts)])
    network_grids = grids_of(source.camera_file, source.size, network_sizes)
    result = _align_by_centres(source, (place for grid in network_grids for place in _usual_places(source, grid)))
    yield result if isinstance(result, Recovery) else None  # without pixels, cameras at the photos' size are better


def _match(source: RowSource, grid_layouts: Sequence[GridLayout]) -> Recovery | None:
    """Match the views of layouts with the file's cameras; None if no layout fits."""
    candidates = match_views(source, grid_layouts)
    return judge(candidates, source.inputs, partial(rescore, source)) if candidates else None


def _at_photo_size(place: PlacedGrid, known_grids: Sequence[Grid]) -> PlacedGrid:
    """Bring cameras to the size of the photos, because larger photos show more detail than photos at a network's size.

    ``known_grids`` are the grids of the sizes that files give; the cameras stay unchanged if none has their shape.
    """
    grid = next((grid for grid in known_grids if same_shape(grid.size, place.grid.size)), place.grid)
    cameras = replace(grid.cameras, viewmats=place.grid.cameras.viewmats)
    return replace(place, grid=replace(grid, camera_file=place.grid.camera_file, cameras=cameras))


def _usual_places(source: RowSource, grid: Grid) -> Iterator[PlacedGrid]:
    """Yield the cameras of a grid in each frame of exporters, then in each other convention of their poses."""
    evidence = "Gaussians' places in their pixels"
    yield from (PlacedGrid(grid, frame, evidence) for frame in exporter_frames(grid.cameras, source.scale))
    yield from (PlacedGrid(other, IDENTITY) for other in other_grids(source, grid))


def _align_by_centres(source: RowSource, places: Iterable[PlacedGrid]) -> Recovery | PlacedGrid | None:
    """Choose cameras under which the Gaussians lie around pixel centres, and find the pixels of the rows.

    Returns only the cameras if the rows have no pixels, and None if the photos contradict the cameras as well.
    """
    points = sample_points(source.ply.gaussians.means, source.ply.valid)
    checked = [(check_centres(points, place.cameras), place) for place in places]
    passing = [(check, place) for check, place in checked if check.ok]
    if not passing:
        return None
    check, place = min(passing, key=lambda checked_place: checked_place[0].px / checked_place[0].chance_px)
    recovery = _find_pixels(source, place, check)
    return place if recovery is None and _shows_colors(source, place) else recovery


def _shows_colors(source: RowSource, place: PlacedGrid) -> bool:
    """Return True if the cameras see the Gaussians, with the colours of the photos if there are any."""
    from gsmerge.alignment.unaligned import check_cameras  # here because few files need it

    inputs = source.inputs(place.grid)
    return check_cameras(inputs.gaussians, inputs.valid, place.cameras, inputs.images).ok


def _find_pixels(source: RowSource, place: PlacedGrid, check: CentreCheck) -> Recovery | None:
    """Find the pixels of rows whose cameras are known; None if they have none.

    Layouts with the right number of rows are tried first, then the nearest pixel centre of each row.
    """
    grid, frame = place.grid, place.frame
    inputs = source.inputs(grid, photos=False)
    scored = (score_layout(inputs, layout, frame) for layout in _ordered_layouts(source, grid))
    candidates = [
        Candidate(grid, score) for score in scored if score.alignment.ok and score.alignment.worst_px <= _PLAIN_PX
    ]
    if not candidates:
        ids = find_rows(source.ply.gaussians.means, source.ply.valid, place.cameras, check)
        layout = None if ids is None else dropped_layout(ids, len(grid.cameras), *grid.size).without_empty_parts()
        if layout is None or not source.may_be(layout.order) or _have_smaller_grid(source, len(layout.views), grid):
            return None
        candidates = [Candidate(grid, score_layout(inputs, layout, frame))]
    is_solved = frame.scale != 1 and source.scale is None  # then the rows give a more exact scale
    return judge(candidates, source.inputs, partial(rescore, source) if is_solved else lambda candidate: candidate)


def _have_smaller_grid(source: RowSource, views: int, grid: Grid) -> bool:
    """Return True if there are so few rows for the views of a grid that they are probably pixels of a smaller grid."""
    return _MANY_PIXELS * len(source.ply.gaussians) < views * math.prod(grid.size)


def _layouts(source: RowSource, grid: Grid) -> list[Layout]:
    """List the layouts in a grid that have the right number of rows, including layouts made with depth maps."""
    views, (width, height), count = len(grid.cameras), grid.size, len(source.ply.gaussians)
    layouts = list(exact_layouts(count, views, width, height))
    if count < views * width * height and source.may_be("view-major"):
        depths = source.depths()
        if depths is not None and depths.shape == (views, height, width):
            layouts += depth_layouts(count, depths)
    return [layout for layout in layouts if source.may_be(layout.order)]


def _ordered_layouts(source: RowSource, grid: Grid) -> list[Layout]:
    """List the layouts in a grid that have the right number of rows, with the views in each likely order."""
    orders = source.orders(grid)
    return [ordered for layout in _layouts(source, grid) for ordered in layout.with_views_in(orders)]


def _has_shape_of(layout: Layout, shown_layouts: Sequence[Layout]) -> bool:
    """Return True if a layout without its borders has the size, order and layers of one of ``shown_layouts``."""
    y, x = np.divmod(layout.pixels[0][[0, -1]], layout.width)
    key = int(np.ptp(x)) + 1, int(np.ptp(y)) + 1, layout.order, layout.per_pixel
    return any(key == (other.width, other.height, other.order, other.per_pixel) for other in shown_layouts)


# Inexact cameras


def _move_cameras(source: RowSource, grid: Grid) -> Recovery | None:
    """Move inexact cameras so that they show rows in their pixels; None if slightly moved cameras do not fit.

    Also None if the colours of the photos contradict the result, because moved cameras also fit views in a wrong order.
    """
    if source.scale is not None:
        return None
    inputs = source.inputs(grid)
    scored = [score_layout(inputs, layout, IDENTITY) for layout in _ordered_layouts(source, grid)]
    best = min(scored, key=lambda layout_score: layout_score.alignment.worst_px, default=None)
    if best is None or not NEAR_PX < best.alignment.worst_px <= max_pixels(*grid.size):
        return None
    pairs = inputs.pairs(subsample(best.layout, _MOVED_GAUSSIANS))
    path = str(source.camera_file.path)
    moved = move_cameras(pairs, grid.cameras, source.camera_file.names, path, inputs.images)
    if moved is None:
        return None
    given, moves = (grid.cameras.viewmats, ()) if moved.confirmed else (None, moved.moves)
    grid = replace(grid, cameras=moved.cameras, notes=(*grid.notes, moved.note), moves=moves, given=given)
    candidate = Candidate(grid, score_layout(source.inputs(grid), best.layout, IDENTITY))
    if not candidate.scored.alignment.ok:
        return None
    recovery = judge([candidate], source.inputs, lambda unchanged: unchanged)
    return None if recovery is None or recovery.confirmed is False else recovery


# Rows without pixels, and results


def _choose_grid(source: RowSource, grids: Sequence[Grid]) -> Grid | None:
    """Choose the grid whose photos show the colours of the rows best; None if no photos show them."""
    from gsmerge.alignment.unaligned import check_cameras

    best, best_score = None, 0.0
    for grid in grids:
        inputs = source.inputs(grid)
        check = check_cameras(inputs.gaussians, inputs.valid, inputs.cameras, inputs.images)
        if check.ok and not math.isnan(check.color_ratio) and check.score > best_score:
            best, best_score = grid, check.score
    return best


def _choose_cameras(
    source: RowSource, grid: Grid, frames: Callable[[], Sequence[Similarity]], place: PlacedGrid | None
) -> AlignmentResult:
    """Choose cameras that see rows without pixels, unless they are known as ``place``.

    Raises SceneError if no cameras see them, or if the rows turn out to be pixels of other cameras or larger photos.
    """
    from gsmerge.alignment.explain import check_frame, count_error, describe_lost_order
    from gsmerge.alignment.unaligned import choose_cameras
    from gsmerge.alignment.upright import upright_rotation

    _check_photo_size(source)
    camera_file, inputs = source.camera_file, source.inputs(grid)
    rotation = upright_rotation(inputs) if place is None else None
    if rotation is not None:
        place = _place_upright(source, grid, rotation)
        points = sample_points(inputs.gaussians.means, inputs.valid)
        recovery = _find_pixels(source, place, check_centres(points, place.cameras))
        if recovery is not None:
            return _make_result(source, recovery)
    no_pixels, more_notes = count_error(source.ply.info, grid.cameras), list[str]()
    if place is None:
        check_frame(inputs, camera_file)
        if source.scale is not None:
            grid = replace(grid, cameras=scale_by(source.scale).move(grid.cameras))
        place, more_notes = choose_cameras(replace(inputs, cameras=grid.cameras), grid, frames(), no_pixels)
        result = None if place.frame is IDENTITY or source.order == "none" else _align_by_centres(source, [place])
        if isinstance(result, Recovery):
            return _make_result(source, result)
    cameras, camera_file, grid = place.cameras, place.grid.camera_file, place.grid
    if place.frame is not IDENTITY:
        camera_file = replace(camera_file, viewmats=cameras.viewmats)
    notes, images = [*place.notes(source.camera_file.convention), *more_notes], source.inputs(grid).images
    left_out = describe_misfits(source, grid) if place.frame is IDENTITY else ()
    if not left_out and source.order not in MAY_BE_UNALIGNED:
        notes += describe_lost_order(source.ply.info, grid.cameras)
    return AlignmentResult(
        None, cameras, images, camera_file, tuple(notes), grid.transform, problem=no_pixels.problem, left_out=left_out
    )


def _check_photo_size(source: RowSource) -> None:
    """Raise SceneError if rows are pixels of the cameras' grid, but the photos have another size."""
    error = small_photos_error(source.ply.info, source.camera_file, source.size)
    if error is None:
        return
    without_photos, camera_grids = replace(source, photos=()), [photo_grid(source.camera_file, None)]
    result = _align_in_order(without_photos, camera_grids) or _search(without_photos, camera_grids)
    if isinstance(result, Recovery):  # photos of rows without pixels may have any size
        raise error


def _place_upright(source: RowSource, grid: Grid, rotation: Similarity) -> PlacedGrid:
    """Find the frame of rows that an exporter centred, rescaled and turned upright; SceneError if that fails."""
    from gsmerge.alignment.upright import solve_upright, upright_error

    grids = [grid, *grids_of(source.camera_file, source.size, square_sizes)] if len(source.photos) else []
    for photos_grid in grids:
        frame = solve_upright(source.inputs(photos_grid), rotation)
        if frame is not None:
            return PlacedGrid(photos_grid, frame, "photos' colours")
    raise upright_error(source.ply.info, len(source.photos))


def _make_result(source: RowSource, recovery: Recovery) -> AlignmentResult:
    """Make the result for rows that are pixels, with cameras in the frame of the Gaussians."""
    grid, frame, layout = recovery.chosen.grid, recovery.best.frame, recovery.best.layout
    inputs = source.inputs(grid)
    free_pages(vars(inputs.gaussians).values())  # the search has read all rows
    return AlignmentResult(
        pixel_ids=layout.pixel_ids(len(inputs.gaussians)),
        cameras=grid.cameras if frame is IDENTITY else frame.move(grid.cameras),
        images=inputs.images,
        camera_file=grid.camera_file,
        notes=tuple(_list_notes(source.camera_file, recovery)),
        transform=grid.transform,
        recovery=recovery,
        moves=grid.moves,
        left_out=grid.left_out,
        given=None if grid.given is None else frame.move_viewmats(grid.given),
    )


def _list_notes(usual: CameraFile, recovery: Recovery) -> list[str]:
    """List notes on how rows that are pixels were read, if not as usual; ``usual`` are the cameras as stored."""
    grid, frame, layout = recovery.chosen.grid, recovery.best.frame, recovery.best.layout
    notes, count = [*grid.notes], len(grid.cameras)
    if grid.camera_file.convention != usual.convention:
        notes.append(f"{describe_other_convention(grid.camera_file.convention, usual.convention)}: read so")
    if usual.source == ESTIMATED:
        evidence = "own grid" if usual.pixel_ids is None else "own order"
        separate = len(set(map(bytes, usual.Ks))) > 1
        subject = "poses, and focal lengths that differ between the views," if separate else "poses and focal length"
        notes.append(f"no cameras are used: {subject} are estimated from the Gaussians' {evidence}")
    in_order = layout.is_plain and frame is IDENTITY and len(layout.views) == count
    orders = view_orders(usual.names)
    if in_order and layout.views == orders[1] != orders[0]:
        notes.append("views are in the order of the image names, not of the camera file")
    elif not (in_order and layout.views in orders):
        used = len(set(layout.views))
        notes.append(f"read as: {recovery.description}")
        notes += [f"{used} of {count} views are in the file"] * (used < count and not grid.left_out)
    return notes
