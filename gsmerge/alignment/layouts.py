"""Lay rows out as pixels: the layouts that a number of rows allows, and the possible sizes of their grid."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import PATCH, CameraFile, sizes_of, to_cameras
from gsmerge.io.cameras.json_files import FFGS
from gsmerge.io.formats.read import FileInfo
from gsmerge.io.image_names import natural_key
from gsmerge.io.photo_files import ASPECT_TOLERANCE, PhotoTransform, Size, resize_and_crop, resize_to, same_shape
from gsmerge.types import Cameras

MAY_BE_UNALIGNED: tuple[str, ...] = ("unordered", "none")  # orders of files whose rows need not belong to pixels
ESTIMATED = "estimated from the grid"  # source of cameras
TRIMS = (8, 4, 2)  # pixels that DepthSplat, ZPressor and ReSplat cut off at every side
_MAX_TRIM = 0.25  # of the shorter side, cut off at every side
PER_PIXEL = (1, 2, 3, 4, 16)  # Gaussians per pixel that backbones write
DEPTH_SHARE = 0.9  # of each view's pixels, the nearest ones, that Depth Anything 3 keeps
SIDES = (504, 518)  # to which Depth Anything 3 and others resize the longer or the shorter side, pixels
SQUARE = 256  # side of the pictures of pixelSplat and its relatives, pixels
_ROUND = (8, PATCH)  # sides of grids that photos are cropped to are multiples of one of them
_STRETCHED, _MAX_STRETCH = 16, 0.15  # multiples of its sides, to which ReSplat stretches photos, and by how much
_MIN_KEPT = 0.5  # of a photo's area, when it is cropped
_MIN_ROWS = 0.5  # of the pixels of half the photos' size, where rows may be of those that were not dropped
_NEAR_SIZE = 0.05  # of the longer side, by which cameras' sizes may differ that are no more than assumed
_MAX_ENLARGED = 1.5  # times the side of a photo; some networks enlarge small ones


@dataclass(frozen=True)
class Layout:
    """The pixel of each row, part by part; a part is one view, or one layer of a view."""

    description: str  # what it is, for people
    kind: str  # "full", "trim", "box", "box+depth" or "pruned": which pixels there are
    order: str  # in which order the rows are
    width: int  # of the grid, pixels
    height: int
    views: tuple[int, ...]  # the camera of each part
    rows: tuple[np.ndarray, ...]  # the rows of each part, of any shape: not a copy where a stride will do
    pixels: tuple[np.ndarray, ...]  # ``[p]`` the pixel ``y·W + x`` of each of these rows
    per_pixel: int = 1  # Gaussians per pixel; above 1 each layer is a part

    def with_views_in(self, orders: Iterable[Sequence[int]]) -> Iterator[Layout]:
        """Yield copies of the layout with the views permuted by each of the ``orders``."""
        labellings = dict.fromkeys(tuple(order[view] for view in self.views) for order in orders)
        return (replace(self, views=labelling) for labelling in labellings)

    @property
    def is_plain(self) -> bool:
        """Whether the rows are the full grid in order: nothing moves, nothing is missing."""
        return self.kind == "full" and self.order == "view-major" and self.per_pixel == 1

    def pixel_ids(self, count: int) -> np.ndarray:
        """Return the pixel ``(part·H + y)·W + x`` of each of ``count`` rows; -1 for rows without one."""
        if self.is_plain:
            return np.arange(count, dtype=_row_type(count))
        ids = np.full(count, -1, np.int64)
        for part, (rows, pixels) in enumerate(zip(self.rows, self.pixels, strict=True)):
            ids[rows.reshape(-1)] = part * self.width * self.height + pixels
        return ids


@dataclass(frozen=True)
class KeptBox:
    """The kept part of a view: rows ``top`` to ``height - top``, columns ``left`` to ``width - left``."""

    kind: str
    description: str
    top: int
    left: int

    def pixels(self, width: int, height: int) -> np.ndarray:
        """Return the pixel indices inside the box, row by row."""
        grid = np.arange(width * height, dtype=np.int64).reshape(height, width)
        return grid[self.top : height - self.top, self.left : width - self.left]


def boxes(width: int, height: int) -> Iterator[KeptBox]:
    """Yield the boxes of pixels that exporters may keep, the likely ones first.

    They are the whole picture; without 8 pixels, or 8/256 of the side as Depth Anything 3, at each border; and without
    any other border.
    """
    yield KeptBox("full", "every pixel", 0, 0)
    usual, side = TRIMS[0], min(width, height)
    if side > 2 * usual:
        yield trim_box(usual)
    da3 = da3_box(width, height)
    if (da3.top or da3.left) and (da3.top, da3.left) != (usual, usual):
        yield da3
    yield from (trim_box(trim) for trim in range(1, int(_MAX_TRIM * side) + 1) if trim != usual)


def trim_box(trim: int) -> KeptBox:
    """Return the box without ``trim`` pixels at every border."""
    return KeptBox("trim", f"{trim} pixels trimmed at every border", trim, trim)


def da3_box(width: int, height: int) -> KeptBox:
    """Return the box of pixels that Depth Anything 3 keeps."""
    top, left = da3_trim(height), da3_trim(width)
    return KeptBox("box", f"{top} rows and {left} columns trimmed at every border", top, left)


def da3_trim(side: int) -> int:
    """Return the pixels that Depth Anything 3 cuts off at both ends of a side."""
    return int(8 / 256 * side)


def da3_borders(side: int) -> list[int]:
    """List the pixels that Depth Anything 3 may have cut off at both ends of what is left of a side."""
    return [border for border in range(side) if da3_trim(side + 2 * border) == border]


def view_orders(names: Sequence[str]) -> list[tuple[int, ...]]:
    """List the possible orders of a file's views: the order of the cameras, and the order of the names."""
    views = range(len(names))
    return [tuple(views), tuple(sorted(views, key=lambda view: natural_key(names[view])))]


def every_nth(views: int) -> list[tuple[int, ...]]:
    """List the selections of every n-th view, for all n."""
    return [tuple(range(0, views, step)) for step in range(1, views + 1)]


def plain_layout(views: int, width: int, height: int) -> Layout:
    """Return the layout of one Gaussian per pixel, view by view and row by row."""
    return next(layout for layout in exact_layouts(views * width * height, views, width, height) if layout.is_plain)


def exact_layouts(count: int, views: int, width: int, height: int) -> Iterator[Layout]:
    """Yield the layouts with exactly ``count`` rows and at most ``views`` views.

    The cameras of the parts are a first guess: in order, or every n-th of them.
    """
    for box in boxes(width, height):
        for per_pixel in PER_PIXEL:
            num_used, remainder = divmod(count, (height - 2 * box.top) * (width - 2 * box.left) * per_pixel)
            if remainder or not 1 <= num_used <= views:
                continue
            chosen = next((ids for ids in every_nth(views) if len(ids) == num_used), tuple(range(num_used)))
            yield from _orders(count, box, per_pixel, chosen, width, height)


def dropped_layout(pixel_ids: np.ndarray, views: int, width: int, height: int) -> Layout:
    """Return the layout of rows by their pixels ``[n]``, -1 for none; some pixels may have no row."""
    area = width * height
    parts = [np.flatnonzero(pixel_ids // area == view) for view in range(views)]
    mixed = any(len(a) and len(b) and a[-1] > b[0] for a, b in pairwise(parts))
    pixels, order = tuple(pixel_ids[rows] % area for rows in parts), "view-fastest" if mixed else "view-major"
    chosen = tuple(range(views))
    return Layout(f"some pixels dropped, {order}", "pruned", order, width, height, chosen, tuple(parts), pixels)


def move_layout(layout: Layout, width: int, height: int, left: int, top: int) -> Layout:
    """Move a layout into a grid of another size, so that its first pixel comes to (left, top)."""
    places = (np.divmod(pixels, layout.width) for pixels in layout.pixels)
    return replace(layout, width=width, height=height, pixels=tuple((y + top) * width + x + left for y, x in places))


def full_layouts(views: int, per_pixel: int, width: int, height: int) -> Iterator[Layout]:
    """Yield the layouts of every pixel of all ``views``."""
    whole = next(iter(boxes(width, height)))
    return _orders(views * per_pixel * width * height, whole, per_pixel, tuple(range(views)), width, height)


def _row_type(count: int) -> type[np.signedinteger[Any]]:
    """Return the smallest integer type for ``count`` rows, since there may be hundreds of millions."""
    return np.int32 if count <= np.iinfo(np.int32).max else np.int64


def _orders(
    count: int, box: KeptBox, per_pixel: int, views: tuple[int, ...], width: int, height: int
) -> Iterator[Layout]:
    index, grid = np.arange(count, dtype=_row_type(count)), box.pixels(width, height)
    rows, columns, num_views = *grid.shape, len(views)
    arranged = {
        "view-major": index.reshape(num_views, rows, columns, per_pixel).transpose(0, 3, 1, 2),
        "view-fastest": index.reshape(rows, columns, per_pixel, num_views).transpose(3, 2, 0, 1),
        "column-major": index.reshape(num_views, columns, rows, per_pixel).transpose(0, 3, 2, 1),
        "layer-major": index.reshape(per_pixel, num_views, rows, columns).transpose(1, 0, 2, 3),
    }
    layers = f", {per_pixel} Gaussians per pixel" if per_pixel > 1 else ""
    for order, ids in arranged.items():
        if (order == "layer-major" and per_pixel == 1) or (order == "view-fastest" and num_views == 1):
            continue
        yield Layout(
            description=f"{box.description}{layers}, {order}",
            kind=box.kind,
            order=order,
            width=width,
            height=height,
            views=tuple(view for view in views for _ in range(per_pixel)),
            rows=tuple(layer for layers in ids for layer in layers),
            pixels=(grid.reshape(-1),) * (num_views * per_pixel),
            per_pixel=per_pixel,
        )


def depth_layouts(count: int, depths: np.ndarray) -> list[Layout]:
    """List the layouts that Depth Anything 3 may have made by its depth maps: border, nearest 90 %, every n-th view.

    Only the order of the values of ``depths [v,h,w]`` matters, so their scale does not. Empty if no choice of views has
    ``count`` pixels.
    """
    views, height, width = depths.shape
    inside = da3_box(width, height).pixels(width, height)
    # the threshold is the interpolated 90 % quantile of all the view's depths: the lower of the two around it decides
    rank = int(DEPTH_SHARE * (width * height - 1))
    kept = []
    for depth in depths:
        mask = depth <= np.partition(depth.reshape(-1), rank)[rank]
        kept.append(inside[mask.reshape(-1)[inside]])
    for step, chosen in enumerate(every_nth(views), 1):
        pixels = tuple(kept[view] for view in chosen)
        ends = np.cumsum([len(view_pixels) for view_pixels in pixels])
        if ends[-1] == count:
            border = da3_box(width, height).description.removesuffix(" at every border")
            every = "" if step == 1 else f", every {step}. view"
            description = f"{border}, nearest 90 % of each view{every}, view-major"
            rows = tuple(np.split(np.arange(count, dtype=np.int64), ends[:-1]))
            return [Layout(description, "box+depth", "view-major", width, height, chosen, rows, pixels)]
    return []


def subsample(layout: Layout, per_part: int) -> Layout:
    """Thin a layout to about ``per_part`` rows of each part, spread over all columns and rows."""
    rows, pixels = [], []
    for part_rows, part_pixels in zip(layout.rows, layout.pixels, strict=True):
        chosen = np.arange(0, part_rows.size, spread_step(-(-part_rows.size // per_part), layout.width))
        rows.append(part_rows.flat[chosen])
        pixels.append(part_pixels[chosen])
    return replace(layout, rows=tuple(rows), pixels=tuple(pixels))


def spread_step(step: int, width: int) -> int:
    """Enlarge a sampling step until it is coprime to the width, so that samples spread over all columns."""
    step = max(1, step)
    while step > 1 and np.gcd(step, width) > 1:
        step += 1
    return step


@dataclass(frozen=True)
class GridFit:
    """One assumption about the size of the pixel grid, with the cameras and the photo transform for that size."""

    camera_file: CameraFile  # the cameras as they are read, in one convention of the poses
    cameras: Cameras  # the same at the grid's size
    transform: PhotoTransform | None  # what is done to the photos, if anything
    notes: tuple[str, ...]  # what it is, for people
    # what suggests it: a size in files (0), the number of rows and the photos' shape (1), the number alone (2), or a
    # network's usual sizes (3)
    rank: int = 0
    moves: Sequence[dict[str, Any]] = ()  # how far each camera was moved to its Gaussians; empty where none was
    given: np.ndarray | None = None  # ``[c,4,4]`` poses that the photos confirm, to which Gaussians are to be moved

    @property
    def size(self) -> Size:
        """(width, height) of the grid, pixels."""
        return self.cameras.width, self.cameras.height

    @property
    def guessed(self) -> bool:
        """Whether the size was guessed from the number of rows, which many other sizes would fit as well."""
        return self.rank in (1, 2)


def with_photo_size(camera_file: CameraFile, size: Size | None, most: float = 1) -> CameraFile:
    """Return the cameras with the photos' size if theirs is up to ``most`` pixels off, as twice a principal point is.

    The same cameras where it is not.
    """
    stored = sizes_of(camera_file)
    if size is None or len(stored) != 1 or not 0 < max(abs(np.subtract(stored[0], size))) <= most:
        return camera_file
    widths, heights = (np.full_like(camera_file.widths, side) for side in size)
    return replace(camera_file, widths=widths, heights=heights)


def photo_grid(camera_file: CameraFile, size: Size | None) -> GridFit:
    """Assume a grid of the photos' size, or of the cameras' size without photos; SceneError if the two disagree."""
    if size is None:
        return GridFit(camera_file, to_cameras(camera_file), None, ())
    if camera_file.photo_map is not None:
        return _mapped_grid(camera_file, size, *camera_file.photo_map)
    width, height = size
    for w, h in sizes_of(camera_file):
        if not same_shape((w, h), size) and not _are_stretched(camera_file, size):
            if camera_file.source == FFGS:
                return _mapped_grid(camera_file, size, size, resize_and_crop(size, (w, h)))
            problem = f"expected cameras of the images' size {width} x {height} or a multiple of it, found {w} x {h}"
            swapped = (w, h) == (height, width)
            remedy = "width and height are swapped" if swapped else "crop cameras and images alike"
            raise SceneError(camera_file.path, problem, remedy)
    other = [s for s in sizes_of(camera_file) if s != size]
    notes = tuple(f"intrinsics scaled from {w} x {h} to the images' {width} x {height}" for w, h in other)
    return GridFit(camera_file, to_cameras(camera_file, size), None, notes)


def _mapped_grid(camera_file: CameraFile, size: Size, file_size: Size, transform: PhotoTransform) -> GridFit:
    """Return the grid of photos that were resized or cropped by a known transform; ``size``: in memory."""
    x, y = (whole / part for whole, part in zip(file_size, size, strict=True))
    transform = replace(transform, scale_x=x * transform.scale_x, scale_y=y * transform.scale_y)
    note = f"photos of {file_size[0]} x {file_size[1]} are {transform.description}, the Gaussian grid's size"
    is_same = file_size == (transform.width, transform.height)
    return GridFit(camera_file, to_cameras(camera_file), transform, () if is_same else (note,))


def square_grids(grid: GridFit) -> Iterator[GridFit]:
    """Yield the square to which pixelSplat and similar models crop photos, unless the grid is no larger."""
    width, height = grid.size
    if min(width, height) >= SQUARE and (width, height) != (SQUARE, SQUARE):
        transform = resize_and_crop((width, height), (SQUARE, SQUARE))
        note = f"photos and cameras of {width} x {height} are {transform.description}, the Gaussian grid's size"
        yield replace(grid, cameras=transform.cameras(grid.cameras), transform=transform, notes=(*grid.notes, note))


def _are_stretched(camera_file: CameraFile, size: Size) -> bool:
    """Return whether oblong pixels become square at the size of the photos, which means that a model stretched them."""
    if camera_file.focal is None:
        return False
    focals = camera_file.Ks[:, (0, 1), (0, 1)]
    sides = np.stack([camera_file.widths, camera_file.heights], 1)
    ratios = np.divide(*(focals * size / np.maximum(sides, 1)).T)
    return bool((np.abs(ratios - 1) <= ASPECT_TOLERANCE).all())


def other_grids(ply: FileInfo, camera_file: CameraFile, size: Size | None) -> Iterator[GridFit]:
    """Yield all other grid sizes that fit the files and the number of rows, the likely ones first.

    ``size``: size of the photos.
    """
    sizes = sizes_of(camera_file)
    camera_size = sizes[0] if len(sizes) == 1 else None
    if size is not None and camera_size is not None and camera_size != size:
        yield from _between(camera_file, size, camera_size)
    base = size or camera_size
    if base is None or any(not same_shape(s, base) for s in sizes):
        return
    near = with_photo_size(camera_file, base, _NEAR_SIZE * max(base))
    files = [camera_file] + [near] * (near is not camera_file)
    what = "photos and cameras" if size is not None else "cameras"
    by_count = grids_of_count(ply.count, len(camera_file), base)
    ranked = [(2 if t.crops or not same_shape((t.width, t.height), base) else 1, t) for t in by_count]
    if ply.sh_degree == 0 and ply.opacity_encoding == "logit":
        kept = ply.count / len(camera_file)
        halves = (resize_to(base, half) for half in _half_sizes(base) if kept >= _MIN_ROWS * half[0] * half[1])
        ranked += [(3, t) for t in (*patch_grids(base), *halves) if kept < t.width * t.height]
    for rank, transform in ranked:
        note = f"{what} of {base[0]} x {base[1]} are {transform.description}, the Gaussian grid's size"
        for file in files:
            yield GridFit(file, transform.cameras(to_cameras(file, base)), transform, (note,), rank)
        if not sizes and transform.crops:
            whole = to_cameras(camera_file, (transform.width, transform.height))
            yield GridFit(camera_file, whole, transform, (f"{note}; the intrinsics are those of the result",), rank)


def _between(camera_file: CameraFile, size: Size, camera_size: Size) -> Iterator[GridFit]:
    """Resize photos to the size of the cameras; if cameras are of uncropped pictures, crop the cameras instead."""
    cameras = to_cameras(camera_file, camera_size)
    for transform in (resize_to(size, camera_size), resize_and_crop(size, camera_size)):
        if max(transform.scale_x, transform.scale_y) > _MAX_ENLARGED:
            continue  # previews: a fit to them would blur the Gaussians
        note = f"photos of {size[0]} x {size[1]} are {transform.description}, the cameras' and the Gaussian grid's size"
        yield GridFit(camera_file, cameras, transform, (note,))
    if not same_shape(camera_size, size):
        for transform in (resize_to(camera_size, size), resize_and_crop(camera_size, size)):
            note = f"cameras of {camera_size[0]} x {camera_size[1]} are {transform.description}, the images' size"
            yield GridFit(camera_file, transform.cameras(cameras), None, (note,))


def grids_of_count(count: int, views: int, size: Size) -> Iterator[PhotoTransform]:
    """Yield the transforms that shrink photos so that ``views`` of them have ``count`` pixels in all."""
    crops: list[PhotoTransform] = []
    for trim in (0, *TRIMS):
        for per_pixel in PER_PIXEL:
            pixels, remainder = divmod(count, views * per_pixel)
            if remainder:
                continue
            for to in _sizes_of_area(pixels, trim, size):
                aspect = to[0] * size[1] / (to[1] * size[0])
                if abs(aspect - 1) <= ASPECT_TOLERANCE:
                    yield resize_to(size, to)
                is_round = to[0] == to[1] or any(to[0] % side == to[1] % side == 0 for side in _ROUND)
                if to[0] * to[1] < size[0] * size[1] and min(aspect, 1 / aspect) >= _MIN_KEPT and is_round:
                    stretched = abs(aspect - 1) <= _MAX_STRETCH and to[0] % _STRETCHED == to[1] % _STRETCHED == 0
                    crops += [resize_to(size, to)] * stretched + [resize_and_crop(size, to)]
    for width, height in _half_sizes(size):
        if views * da3_box(width, height).pixels(width, height).size == count:
            yield resize_to(size, (width, height))
    yield from (crop for crop in crops if crop.crops or not same_shape((crop.width, crop.height), size))


def _half_sizes(size: Size) -> Iterator[Size]:
    """Yield the sizes at which Lyra 2 writes Gaussians: half the photos', or half of these as multiples of 14."""
    yield from product(*({side // 2, PATCH * round(side / PATCH) // 2} for side in size))


def _sizes_of_area(pixels: int, trim: int, size: Size) -> Iterator[Size]:
    """Yield sizes up to ``size`` with ``pixels`` pixels left after ``trim`` pixels are cut off at each border."""
    for width in range(max(1, pixels // size[1]), min(size[0], pixels) + 1):
        height, remainder = divmod(pixels, width)
        to = width + 2 * trim, height + 2 * trim
        if not remainder and to != size and to[0] <= size[0] and to[1] <= size[1]:
            yield to


def patch_grids(size: Size) -> list[PhotoTransform]:
    """List the transforms of networks that take multiples of 14: each side rounded, or cropped, to a multiple."""
    transforms = []
    for side in SIDES:
        for scale in (side / max(size), side / min(size)):
            if scale <= 1:
                width, height = (PATCH * max(1, round(s * scale / PATCH)) for s in size)
                transforms.append(resize_to(size, (width, height)))
                width, height = (PATCH * max(1, round(s * scale) // PATCH) for s in size)
                transforms.append(resize_and_crop(size, (width, height), scale))
    return list(dict.fromkeys(transforms))


def check_photo_size(ply: FileInfo, camera_file: CameraFile, size: Size | None) -> None:
    """Raise a SceneError for photos smaller than a pixel grid of the cameras' size."""
    grid_size = next((s for s in sizes_of(camera_file) if ply.count == len(camera_file) * s[0] * s[1]), None)
    if size is None or grid_size is None or grid_size == size:
        return
    problem = f"expected images of the Gaussian grid's size {grid_size[0]} x {grid_size[1]} or larger"
    problem += f", found {size[0]} x {size[1]}"
    raise SceneError(camera_file.path, problem, "give the images that the backbone saw, or their originals")
