"""Lay out rows as pixels: list the layouts that have a given number of rows, and make layouts of incomplete grids."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from gsmerge.io.image_names import natural_key

MAY_BE_UNALIGNED: tuple[str, ...] = ("unordered", "none")  # orders of files whose rows need not belong to pixels
ESTIMATED = "estimated from the grid"  # source of cameras
TRIMS = (8, 4, 2)  # pixels that DepthSplat, ZPressor and ReSplat cut off at every border
_MAX_TRIM = 0.25  # largest trim at every border, over the shorter side
PER_PIXEL = (1, 2, 3, 4, 16)  # Gaussians per pixel that backbones write
_FEW_ROWS = 0.01  # parts with a smaller share of the rows of the largest part count as empty
_ORDERED = 0.99  # share of pairs of consecutive rows whose pixels must be in ascending order
_MAX_STEP = 10  # pixels from one to the next that was kept or dropped
DEPTH_SHARE = 0.9  # share of each view's pixels that Depth Anything 3 exports, the nearest ones


@dataclass(frozen=True, eq=False)
class Layout:
    """The pixel of each row, part by part; a part is one view, or one layer of a view."""

    description: str  # in words, for messages
    kind: str  # "full", "trim", "box", "box+depth" or "pruned": which pixels have rows
    order: str  # order of the rows: "view-major", "view-fastest", "column-major", "layer-major" or "unordered"
    width: int  # of the grid, pixels
    height: int
    views: tuple[int, ...]  # the camera of each part
    rows: tuple[np.ndarray, ...]  # the rows of each part, of any shape, so that strided views need no copy
    pixels: tuple[np.ndarray, ...]  # ``[p]`` the pixel ``y·W + x`` of each of these rows
    per_pixel: int = 1  # Gaussians per pixel; above 1 each layer is a part

    def with_views_in(self, orders: Iterable[Sequence[int]]) -> Iterator[Layout]:
        """Yield copies of the layout with the views permuted by each of ``orders``, without duplicates."""
        permuted = dict.fromkeys(tuple(order[view] for view in self.views) for order in orders)
        return (replace(self, views=views) for views in permuted)

    def select(self, view: int) -> Layout:
        """Return the layout of one view, with all its layers."""
        ids = [i for i, other in enumerate(self.views) if other == view]
        rows, pixels = (tuple(arrays[i] for i in ids) for arrays in (self.rows, self.pixels))
        return replace(self, views=(view,) * len(ids), rows=rows, pixels=pixels)

    def without_empty_parts(self) -> Layout:
        """Return the layout without parts that have no or few rows."""
        least = _FEW_ROWS * max(map(len, self.rows))
        ids = [i for i, rows in enumerate(self.rows) if len(rows) >= least]
        rows, pixels = (tuple(arrays[i] for i in ids) for arrays in (self.rows, self.pixels))
        return replace(self, views=tuple(self.views[i] for i in ids), rows=rows, pixels=pixels)

    @property
    def is_plain(self) -> bool:
        """True if the rows are all pixels in order."""
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
class PixelBox:
    """The exported pixels of a view: all but ``top`` lines above and below, and ``left`` columns on each side."""

    kind: str  # as in Layout
    description: str  # in words, for messages
    top: int
    left: int

    def pixels(self, width: int, height: int) -> np.ndarray:
        """Return the pixels ``y·W + x`` inside the box, as an array of its lines and columns."""
        grid = np.arange(width * height, dtype=np.int64).reshape(height, width)
        return grid[self.top : height - self.top, self.left : width - self.left]


def boxes(width: int, height: int) -> Iterator[PixelBox]:
    """Yield the boxes of pixels that exporters may keep, likely boxes first.

    First comes the whole picture. The next box lacks 8 pixels at each border, as files of DepthSplat do. The third
    lacks 8/256 of each side at both ends, as files of Depth Anything 3 do. Boxes with any other border come last.
    """
    yield PixelBox("full", "every pixel", 0, 0)
    usual, side = TRIMS[0], min(width, height)
    if side > 2 * usual:
        yield trim_box(usual)
    da3 = da3_box(width, height)
    if (da3.top or da3.left) and (da3.top, da3.left) != (usual, usual):
        yield da3
    yield from (trim_box(trim) for trim in range(1, int(_MAX_TRIM * side) + 1) if trim != usual)


def trim_box(trim: int) -> PixelBox:
    """Return the box without ``trim`` pixels at every border."""
    return PixelBox("trim", f"{trim} pixels trimmed at every border", trim, trim)


def da3_box(width: int, height: int) -> PixelBox:
    """Return the box of pixels that Depth Anything 3 keeps."""
    top, left = da3_trim(height), da3_trim(width)
    return PixelBox("box", f"{top} rows and {left} columns trimmed at every border", top, left)


def da3_trim(side: int) -> int:
    """Return the number of pixels that Depth Anything 3 cuts off at both ends of a side."""
    return int(8 / 256 * side)


def da3_borders(side: int) -> list[int]:
    """List the numbers of pixels that Depth Anything 3 may have cut off at both ends if ``side`` pixels are left."""
    return [border for border in range(side) if da3_trim(side + 2 * border) == border]


def some_views(layout: Layout) -> list[int]:
    """List the first, the middle and the last view of a layout."""
    views = list(dict.fromkeys(layout.views))
    return list(dict.fromkeys((views[0], views[len(views) // 2], views[-1])))


def view_orders(names: Sequence[str]) -> list[tuple[int, ...]]:
    """List the possible orders of a file's views: the order of the cameras, and the order of the names."""
    return [tuple(range(len(names))), _order_names(tuple(names))]


@lru_cache(maxsize=4)  # called for every layout of a file
def _order_names(names: tuple[str, ...]) -> tuple[int, ...]:
    return tuple(sorted(range(len(names)), key=lambda view: natural_key(names[view])))


def every_nth(views: int) -> list[tuple[int, ...]]:
    """List the selections of every n-th view, for all n."""
    return [tuple(range(0, views, step)) for step in range(1, views + 1)]


def plain_layout(views: int, width: int, height: int) -> Layout:
    """Return the layout of one Gaussian per pixel, view by view and row by row."""
    return next(layout for layout in exact_layouts(views * width * height, views, width, height) if layout.is_plain)


def exact_layouts(count: int, views: int, width: int, height: int) -> Iterator[Layout]:
    """Yield the layouts with exactly ``count`` rows and at most ``views`` views.

    The cameras of the parts are a first guess: every n-th camera, or the first ones.
    """
    for box in boxes(width, height):
        for per_pixel in PER_PIXEL:
            num_used, remainder = divmod(count, (height - 2 * box.top) * (width - 2 * box.left) * per_pixel)
            if remainder or not 1 <= num_used <= views:
                continue
            cameras = next((ids for ids in every_nth(views) if len(ids) == num_used), tuple(range(num_used)))
            yield from _orders(count, box, per_pixel, cameras, width, height)


def dropped_layout(pixel_ids: np.ndarray, views: int, width: int, height: int) -> Layout:
    """Make the layout of n rows from their pixels ``[n]``, if some pixels may have no row.

    A pixel is ``(view·H + y)·W + x``, or -1 for a row without a pixel.
    """
    area = width * height
    parts = [np.flatnonzero(pixel_ids // area == view) for view in range(views)]
    placed = pixel_ids[pixel_ids >= 0]
    keys = {"view-major": placed, "view-fastest": placed % area * views + placed // area}
    order = next((name for name, key in keys.items() if (np.diff(key) > 0).mean() >= _ORDERED), "unordered")
    pixels = tuple(pixel_ids[rows] % area for rows in parts)
    cameras = tuple(range(views))
    return Layout(f"some pixels dropped, {order}", "pruned", order, width, height, cameras, tuple(parts), pixels)


def thinned_layouts(count: int, views: int, width: int, height: int) -> Iterator[Layout]:
    """Yield the layouts of ``count`` rows if every k-th pixel of all views was kept, or every k-th one dropped."""
    total = views * width * height
    for step in range(2, _MAX_STEP + 1):
        for first in range(step):
            num_chosen = len(range(first, total, step))
            if count in (num_chosen, total - num_chosen):
                is_chosen = np.arange(total) % step == first
                pixel_ids = np.flatnonzero(is_chosen if count == num_chosen else ~is_chosen)
                yield dropped_layout(pixel_ids, views, width, height)


def move_layout(layout: Layout, width: int, height: int, left: int, top: int) -> Layout:
    """Move a layout into a grid of another size, so that its first pixel moves to (left, top)."""
    coordinates = (np.divmod(pixels, layout.width) for pixels in layout.pixels)
    pixels = tuple((y + top) * width + x + left for y, x in coordinates)
    return replace(layout, width=width, height=height, pixels=pixels)


def full_layouts(views: int, per_pixel: int, width: int, height: int) -> Iterator[Layout]:
    """Yield the layouts of all pixels of all ``views`` in each order."""
    whole = next(iter(boxes(width, height)))
    return _orders(views * per_pixel * width * height, whole, per_pixel, tuple(range(views)), width, height)


def _row_type(count: int) -> type[np.signedinteger[Any]]:
    """Return the smaller integer type that can number ``count`` rows; there may be hundreds of millions."""
    return np.int32 if count <= np.iinfo(np.int32).max else np.int64


def _orders(
    count: int, box: PixelBox, per_pixel: int, views: tuple[int, ...], width: int, height: int
) -> Iterator[Layout]:
    """Yield the layouts of ``count`` rows in each order; the rows are the pixels of a box in ``views``."""
    row_ids, grid = np.arange(count, dtype=_row_type(count)), box.pixels(width, height)
    rows, columns, num_views = *grid.shape, len(views)
    rows_by_order = {  # arrays [view,layer,line,column]
        "view-major": row_ids.reshape(num_views, rows, columns, per_pixel).transpose(0, 3, 1, 2),
        "view-fastest": row_ids.reshape(rows, columns, per_pixel, num_views).transpose(3, 2, 0, 1),
        "column-major": row_ids.reshape(num_views, columns, rows, per_pixel).transpose(0, 3, 2, 1),
        "layer-major": row_ids.reshape(per_pixel, num_views, rows, columns).transpose(1, 0, 2, 3),
    }
    layer_text = f", {per_pixel} Gaussians per pixel" if per_pixel > 1 else ""
    for order, ordered_rows in rows_by_order.items():
        if (order == "layer-major" and per_pixel == 1) or (order == "view-fastest" and num_views == 1):
            continue
        yield Layout(
            description=f"{box.description}{layer_text}, {order}",
            kind=box.kind,
            order=order,
            width=width,
            height=height,
            views=tuple(view for view in views for _ in range(per_pixel)),
            rows=tuple(layer for view_layers in ordered_rows for layer in view_layers),
            pixels=(grid.reshape(-1),) * (num_views * per_pixel),
            per_pixel=per_pixel,
        )


def depth_layouts(count: int, depths: np.ndarray) -> list[Layout]:
    """List the layout that Depth Anything 3 made with its depth maps, if it has ``count`` rows.

    Depth Anything 3 cuts off a border, exports the nearest 90 % of each view, and may take every n-th view only. Only
    the order of the values of ``depths [v,h,w]`` matters, not their scale.
    """
    views, height, width = depths.shape
    inside = da3_box(width, height).pixels(width, height)
    # The threshold is the 90 % quantile of the view's depths, interpolated between two depths. No depth lies between
    # these two, so the pixels up to the lower one are the same
    rank = int(DEPTH_SHARE * (width * height - 1))
    near_pixels = []
    for depth in depths:
        mask = depth <= np.partition(depth.reshape(-1), rank)[rank]
        near_pixels.append(inside[mask.reshape(-1)[inside]])
    for step, cameras in enumerate(every_nth(views), 1):
        pixels = tuple(near_pixels[view] for view in cameras)
        ends = np.cumsum([len(view_pixels) for view_pixels in pixels])
        if ends[-1] == count:
            border = da3_box(width, height).description.removesuffix(" at every border")
            step_text = "" if step == 1 else f", every {step}. view"
            description = f"{border}, nearest 90 % of each view{step_text}, view-major"
            rows = tuple(np.split(np.arange(count, dtype=np.int64), ends[:-1]))
            return [Layout(description, "box+depth", "view-major", width, height, cameras, rows, pixels)]
    return []


def subsample(layout: Layout, per_part: int) -> Layout:
    """Thin a layout to about ``per_part`` rows of each part, spread over all columns and lines."""
    rows, pixels = [], []
    for part_rows, part_pixels in zip(layout.rows, layout.pixels, strict=True):
        sample = np.arange(0, part_rows.size, spread_step(-(-part_rows.size // per_part), layout.width))
        rows.append(part_rows.flat[sample])
        pixels.append(part_pixels[sample])
    return replace(layout, rows=tuple(rows), pixels=tuple(pixels))


def spread_step(step: int, width: int) -> int:
    """Enlarge a sampling step until it is coprime to the width, so that samples spread over all columns."""
    step = max(1, step)
    while step > 1 and np.gcd(step, width) > 1:
        step += 1
    return step
