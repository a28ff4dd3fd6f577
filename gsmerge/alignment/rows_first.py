"""Find the cameras that show the Gaussians of a file in their place, and which row is which pixel where that shows.

Most files are plain: rows are the pixels in order, which the stored cameras show. Rows of every pixel in another order,
or in another world, show the pose of each view by themselves; what is left to find is which of the file's cameras each
view is, and how their world lies in that of the Gaussians: one similarity, for every convention of the poses and every
likely order of the views. Gaussians of other rows show the cameras by the centres of pixels, about which they lie.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from gsmerge.alignment.cameras import NEAR_PX, describe_reading, max_pixels, move_cameras
from gsmerge.alignment.centres import CentreCheck, check_centres, find_rows, sample_points
from gsmerge.alignment.frames import exporter_frames, scale_by
from gsmerge.alignment.grids import (
    Grid,
    Place,
    file_grids,
    grids_of,
    network_sizes,
    photo_grid,
    shown_sizes,
    small_photos_error,
    square_sizes,
    with_photo_size,
)
from gsmerge.alignment.judge import GridReading, Recovery, judge
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
from gsmerge.alignment.match import GridLayout, RowSource, match_views, other_grids, refine
from gsmerge.alignment.score import AS_NEAR_PX, SHUFFLED_MARGIN, score_layout
from gsmerge.errors import SceneError
from gsmerge.geometry import IDENTITY, Similarity
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.formats.read import GaussianFile
from gsmerge.io.photo_files import PhotoArrays, PhotoTransform, photo_size, same_shape
from gsmerge.runtime.memory import free_pages
from gsmerge.types import Cameras

_PLAIN_PX = 0.5  # a file whose rows are the grid as they are is not searched if it is this near to its pixels
_ENOUGH, _FEW = 24, 0.05  # finite rows that decide between readings; fewer will do where they are no such small share
_MANY_PIXELS = 4  # times as many pixels as rows: likely of photos three times the size of the grid, or more
_MOVED_GAUSSIANS = 2000  # Gaussians of a view that its moved pose is solved from


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
        order: The order of the rows where it is known, see :class:`gsmerge.settings.reading.ReadHints`.
        scale: Size of the Gaussians' world in units of the cameras', where it is given.
        depths: Reads ``[c,h,w]`` depth maps next to the cameras; None where there are none.
        frames: Reads the frames that a file names in which the cameras may see rows without pixels.

    Raises:
        SceneError: If sizes do not agree, several conventions fit, the Gaussians are not those of the cameras' views,
            or other cameras would make pixels of the rows.
    """
    camera_file = with_photo_size(camera_file, photo_size(photos))
    source = RowSource(ply, camera_file, photos, order, scale, depths)
    grids, problem = file_grids(camera_file, source.size), None
    try:
        grids.insert(0, photo_grid(camera_file, source.size))
    except SceneError as error:
        problem = error
    found = _read_in_order(source, grids) or _search(source, grids)
    if problem is not None:
        if isinstance(found, Recovery) and (found.best.layout.kind != "pruned" or found.confirmed):
            return _make_result(source, found)  # rows that lack pixels fit cameras of other shapes, too
        cropped = _cropped_grid(source, grids)
        if cropped is None:
            raise problem
        return _choose_cameras(source, cropped, frames, None)
    if isinstance(found, Recovery):
        return _make_result(source, found)
    return _choose_cameras(source, grids[0] if found is None else found.grid, frames, found)


def _read_in_order(source: RowSource, grids: Sequence[Grid]) -> Recovery | None:
    """Read the rows in order with the stored cameras, which fits most files; None in doubt, for a longer search.

    Or read them by the pixels that they showed when their cameras were estimated.
    """
    count, pixel_ids, candidates = len(source.ply.gaussians), source.camera_file.pixel_ids, []
    for grid in grids:
        inputs = source.inputs(grid, photos=False)
        if pixel_ids is not None:
            layout = dropped_layout(pixel_ids, len(grid.cameras), *grid.size)
            candidates.append(GridReading(grid, score_layout(inputs, layout, IDENTITY)))
        elif count == len(grid.cameras) * math.prod(grid.size) and source.may_be("view-major") and _has_enough(source):
            layouts = plain_layout(len(grid.cameras), *grid.size).with_views_in(source.orders(grid))
            best, *others = (score_layout(inputs, layout, IDENTITY) for layout in layouts)
            worst = best.alignment.worst_px
            far = SHUFFLED_MARGIN * max(worst, AS_NEAR_PX)
            if source.scale is None and worst <= _PLAIN_PX and all(o.alignment.worst_px >= far for o in others):
                candidates.append(GridReading(grid, best))
    candidates = [candidate for candidate in candidates if candidate.reading.alignment.ok]
    return judge(candidates, source.inputs, lambda candidate: candidate) if candidates else None


def _has_enough(source: RowSource) -> bool:
    """Return whether enough rows are finite to find their pixels."""
    finite = int(source.ply.valid.sum())
    return finite >= _ENOUGH or finite >= _FEW * len(source.ply.gaussians)


# Rows and cameras that belong together


def _search(source: RowSource, named: Sequence[Grid]) -> Recovery | Place | None:
    """Find which pixels the rows are, or at least cameras that show them in their place; None if neither.

    ``named``: the grids of sizes that files name.
    """
    if source.order == "none" or not _has_enough(source):
        return None
    found: Recovery | None = None
    place: Place | None = None
    for other in _findings(source, named):
        if isinstance(other, Place):
            place = place or _at_photo_size(other, named)
            if not _are_few(source, len(other.grid.cameras), other.grid):
                break
        elif other is not None:
            found = other if found is None or other.chosen.px < found.chosen.px else found
            if not found.chosen.is_doubtful:
                return found
    return found or place


def _findings(source: RowSource, named: Sequence[Grid]) -> Iterator[Recovery | Place | None]:
    """Yield what the number of rows, centres of pixels, and the rows themselves show, in turn."""
    found = _match(source, [(grid, layout) for grid in named for layout in _layouts(source, grid)])
    yield found
    if found is None and named:
        yield _move_cameras(source, named[0])
    yield _read_centres(source, (place for grid in named for place in _usual_places(source, grid)))
    if source.order not in MAY_BE_UNALIGNED:
        from gsmerge.alignment.row_grid import find_layouts  # few files come here

        layouts = find_layouts(source.ply.gaussians, source.ply.valid)
        shape = (layouts[0].width, layouts[0].height) if layouts else (0, 0)
        shown = grids_of(source.camera_file, source.size, partial(shown_sizes, shape=shape)) if layouts else []
        yield _match(source, [(g, each) for g in shown for each in _layouts(source, g) if _are_same(each, layouts)])
    usual = grids_of(source.camera_file, source.size, network_sizes)
    other = _read_centres(source, (place for grid in usual for place in _usual_places(source, grid)))
    yield other if isinstance(other, Recovery) else None  # cameras alone are better at the photos' size


def _match(source: RowSource, places: Sequence[GridLayout]) -> Recovery | None:
    """Match the views of layouts with the file's cameras; None if none fit."""
    candidates = match_views(source, places)
    return judge(candidates, source.inputs, partial(refine, source)) if candidates else None


def _at_photo_size(place: Place, named: Sequence[Grid]) -> Place:
    """Bring cameras to the size of the photos, which show more than those of the size of a network's grid."""
    grid = next((grid for grid in named if same_shape(grid.size, place.grid.size)), place.grid)
    cameras = replace(grid.cameras, viewmats=place.grid.cameras.viewmats)
    return replace(place, grid=replace(grid, camera_file=place.grid.camera_file, cameras=cameras))


def _usual_places(source: RowSource, grid: Grid) -> Iterator[Place]:
    """Yield the cameras of a grid in each frame of exporters, and in each other convention of their poses."""
    how = "Gaussians' places in their pixels"
    yield from (Place(grid, frame, how) for frame in exporter_frames(grid.cameras, source.scale))
    yield from (Place(other, IDENTITY) for other in other_grids(source, grid))


def _read_centres(source: RowSource, places: Iterable[Place]) -> Recovery | Place | None:
    """Choose cameras under which the Gaussians lie about centres of pixels, and find their rows' pixels.

    The cameras alone where the rows are no pixels in their order, nor lie so near that they show them in any.
    """
    points = sample_points(source.ply.gaussians.means, source.ply.valid)
    checked = [(check_centres(points, place.cameras), place) for place in places]
    right = [each for each in checked if each[0].ok]
    if not right:
        return None
    check, place = min(right, key=lambda each: each[0].px / each[0].chance_px)
    found = _read_place(source, place, check)
    return place if found is None and _shows_colors(source, place) else found


def _shows_colors(source: RowSource, place: Place) -> bool:
    """Return whether photos, if there are any, have the colours of the Gaussians that the cameras show."""
    from gsmerge.alignment.unaligned import check_cameras  # few files come here

    inputs = source.inputs(place.grid)
    return check_cameras(inputs.gaussians, inputs.valid, place.cameras, inputs.images).ok


def _read_place(source: RowSource, place: Place, check: CentreCheck) -> Recovery | None:
    """Find the pixels of rows whose cameras are known: of their number, or of the rows that are there; None without."""
    grid, frame = place.grid, place.frame
    inputs = source.inputs(grid, photos=False)
    layouts = [each for layout in _layouts(source, grid) for each in layout.with_views_in(source.orders(grid))]
    readings = [GridReading(grid, score_layout(inputs, each, frame)) for each in layouts]
    readings = [each for each in readings if each.reading.alignment.ok and each.px <= _PLAIN_PX]
    if not readings:
        ids = find_rows(source.ply.gaussians.means, source.ply.valid, place.cameras, check)
        layout = None if ids is None else dropped_layout(ids, len(grid.cameras), *grid.size).without_empty_parts()
        if layout is None or not source.may_be(layout.order) or _are_few(source, len(layout.views), grid):
            return None
        readings = [GridReading(grid, score_layout(inputs, layout, frame))]
    is_solved = frame.scale != 1 and source.scale is None  # roughly: rows show it better
    return judge(readings, source.inputs, partial(refine, source) if is_solved else lambda candidate: candidate)


def _are_few(source: RowSource, views: int, grid: Grid) -> bool:
    """Return whether rows are so few for some views of a grid that they are likely every pixel of a smaller one."""
    return _MANY_PIXELS * len(source.ply.gaussians) < views * math.prod(grid.size)


def _layouts(source: RowSource, grid: Grid) -> list[Layout]:
    """List the layouts in a grid that the number of rows allows, or the depth maps next to the cameras."""
    views, (width, height), count = len(grid.cameras), grid.size, len(source.ply.gaussians)
    layouts = list(exact_layouts(count, views, width, height))
    if count < views * width * height and source.may_be("view-major"):
        depths = source.depths()
        if depths is not None and depths.shape == (views, height, width):
            layouts += depth_layouts(count, depths)
    return [layout for layout in layouts if source.may_be(layout.order)]


def _are_same(layout: Layout, shown: Sequence[Layout]) -> bool:
    """Return whether a layout without its borders is one of those that rows have shown."""
    y, x = np.divmod(layout.pixels[0][[0, -1]], layout.width)
    what = int(np.ptp(x)) + 1, int(np.ptp(y)) + 1, layout.order, layout.per_pixel
    return any(what == (other.width, other.height, other.order, other.per_pixel) for other in shown)


# Cameras that are off


def _move_cameras(source: RowSource, grid: Grid) -> Recovery | None:
    """Fit rows of every pixel by slightly moved cameras; None if that does not fit.

    Also None if the colours of the photos disagree: views in the wrong order look the same.
    """
    if source.scale is not None:
        return None
    inputs = source.inputs(grid)
    layouts = [each for layout in _layouts(source, grid) for each in layout.with_views_in(source.orders(grid))]
    readings = [score_layout(inputs, layout, IDENTITY) for layout in layouts]
    best = min(readings, key=lambda reading: reading.alignment.worst_px, default=None)
    if best is None or not NEAR_PX < best.alignment.worst_px <= max_pixels(*grid.size):
        return None
    pairs = inputs.pairs(subsample(best.layout, _MOVED_GAUSSIANS))
    path = str(source.camera_file.path)
    moved = move_cameras(pairs, grid.cameras, source.camera_file.names, path, inputs.images)
    if moved is None:
        return None
    given, moves = (grid.cameras.viewmats, ()) if moved.confirmed else (None, moved.moves)
    grid = replace(grid, cameras=moved.cameras, notes=(*grid.notes, moved.note), moves=moves, given=given)
    candidate = GridReading(grid, score_layout(source.inputs(grid), best.layout, IDENTITY))
    found = judge([candidate], source.inputs, lambda each: each) if candidate.reading.alignment.ok else None
    return None if found is None or found.confirmed is False else found


# Rows without pixels, and results


def _cropped_grid(source: RowSource, grids: Sequence[Grid]) -> Grid | None:
    """Return the one of the grids whose photos show the colours of rows best; None if none do."""
    from gsmerge.alignment.unaligned import check_cameras

    best, least = None, 0.0
    for grid in grids:
        inputs = source.inputs(grid)
        check = check_cameras(inputs.gaussians, inputs.valid, inputs.cameras, inputs.images)
        if check.ok and not math.isnan(check.color_ratio) and check.score > least:
            best, least = grid, check.score
    return best


def _choose_cameras(
    source: RowSource, grid: Grid, frames: Callable[[], Sequence[Similarity]], place: Place | None
) -> AlignmentResult:
    """Choose cameras that see rows, if no ``place`` is known; SceneError if none do, or if rows are their pixels."""
    from gsmerge.alignment.explain import check_frame, count_error
    from gsmerge.alignment.unaligned import choose_cameras
    from gsmerge.alignment.upright import upright_rotation

    camera_file, inputs = source.camera_file, source.inputs(grid)
    small = small_photos_error(source.ply.info, camera_file, source.size)
    if small is not None:
        alone, own = replace(source, photos=()), [photo_grid(camera_file, None)]
        if isinstance(_read_in_order(alone, own) or _search(alone, own), Recovery):
            raise small  # rows that are no pixels are seen by photos of any size
    rotation = upright_rotation(inputs) if place is None else None
    if rotation is not None:
        place = _place_upright(source, grid, rotation)
        points = sample_points(inputs.gaussians.means, inputs.valid)
        found = _read_place(source, place, check_centres(points, place.cameras))
        if found is not None:
            return _make_result(source, found)
    why, more = count_error(source.ply.info, grid.cameras), list[str]()
    if place is None:
        check_frame(inputs, camera_file)
        if source.scale is not None:
            grid = replace(grid, cameras=scale_by(source.scale).move(grid.cameras))
        place, more = choose_cameras(replace(inputs, cameras=grid.cameras), grid, frames(), why)
        again = None if place.frame is IDENTITY or source.order == "none" else _read_centres(source, [place])
        if isinstance(again, Recovery):
            return _make_result(source, again)
    cameras, camera_file, grid = place.cameras, place.grid.camera_file, place.grid
    if place.frame is not IDENTITY:
        camera_file = replace(camera_file, viewmats=cameras.viewmats)
    notes, images = (*place.notes(source.camera_file.convention), *more), source.inputs(grid).images
    return AlignmentResult(None, cameras, images, camera_file, notes, grid.transform, problem=why.problem)


def _place_upright(source: RowSource, grid: Grid, rotation: Similarity) -> Place:
    """Find where rows lie that an exporter centred, rescaled and turned; SceneError if that fails."""
    from gsmerge.alignment.upright import solve_upright, upright_error

    grids = [grid, *grids_of(source.camera_file, source.size, square_sizes)] if len(source.photos) else []
    solved = ((each, solve_upright(source.inputs(each), rotation)) for each in grids)
    place = next((Place(each, frame, "photos' colours") for each, frame in solved if frame is not None), None)
    if place is None:
        raise upright_error(source.ply.info, len(source.photos))
    return place


def _make_result(source: RowSource, recovery: Recovery) -> AlignmentResult:
    """Make the result for rows that are pixels, with cameras in the frame of the Gaussians."""
    grid, best = recovery.chosen.grid, recovery.best
    inputs = source.inputs(grid)
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
    orders = view_orders(usual.names)
    if in_order and layout.views == orders[1] != orders[0]:
        notes.append("views are in the order of the image names, not of the camera file")
    elif not (in_order and layout.views in orders):
        used = len(set(layout.views))
        notes.append(f"read as: {recovery.description}")
        notes += [f"{used} of {count} views are in the file"] * (used < count)
    return AlignmentResult(
        pixel_ids=layout.pixel_ids(len(inputs.gaussians)),
        cameras=grid.cameras if frame is IDENTITY else frame.move(grid.cameras),
        images=inputs.images,
        camera_file=grid.camera_file,
        notes=tuple(notes),
        transform=grid.transform,
        recovery=recovery,
        moves=grid.moves,
        given=None if grid.given is None else frame.move_viewmats(grid.given),
    )
