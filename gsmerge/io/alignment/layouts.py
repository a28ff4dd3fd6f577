"""Which row of a file may belong to which pixel: what the number of rows allows; and scenes laid out accordingly."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from gsmerge.types import Cameras, Gaussians, PixelScene

Order = Literal["auto", "view-major", "view-fastest", "layer-major", "column-major", "unordered", "none"]
ORDERS: tuple[str, ...] = get_args(Order)
MAY_BE_UNALIGNED: tuple[str, ...] = ("unordered", "none")  # orders of files whose rows need not belong to pixels

TRIM = 8  # pixels that DepthSplat and its relatives cut off at every side
PER_PIXEL = (1, 2, 3, 4, 16)  # Gaussians per pixel that backbones write
DEPTH_SHARE = 0.9  # of each view's pixels, the nearest ones, that Depth Anything 3 keeps


@dataclass(frozen=True)
class Layout:
    """Rows and pixels, block by block: a block is what one view (or one layer of it) wrote.

    Args:
        description: What it is, for people.
        kind: "full", "trim", "box", "box+depth" or "pruned": which pixels there are.
        order: In which order the rows are.
        width: Of the grid, pixels.
        height: The same.
        views: The camera of each block.
        rows: The rows of each block, of any shape: not a copy where a stride will do.
        pixels: ``[p]`` the pixel ``y·W + x`` of each of these rows.
        per_pixel: Gaussians per pixel; above 1 each layer is a block.
    """

    description: str
    kind: str
    order: str
    width: int
    height: int
    views: tuple[int, ...]
    rows: tuple[np.ndarray, ...]
    pixels: tuple[np.ndarray, ...]
    per_pixel: int = 1

    @property
    def is_plain(self) -> bool:
        """Whether the rows are the grid as they are: nothing to move, nothing missing."""
        return self.kind == "full" and self.order == "view-major" and self.per_pixel == 1


@dataclass(frozen=True)
class Box:
    """The part of a view that was kept: rows ``top`` to ``height - top``, columns ``left`` to ``width - left``."""

    kind: str
    description: str
    top: int
    left: int

    def pixels(self, width: int, height: int) -> np.ndarray:
        """Pixels of the box, row by row."""
        grid = np.arange(width * height, dtype=np.int64).reshape(height, width)
        return grid[self.top : height - self.top, self.left : width - self.left]


def boxes(width: int, height: int) -> list[Box]:
    """What is cut off at the border: nothing, 8 pixels, or 8/256 of each side as Depth Anything 3 does."""
    top, left = da3_border(width, height)
    out = [Box("full", "every pixel", 0, 0)]
    if min(width, height) > 2 * TRIM:
        out.append(Box("trim", f"{TRIM} pixels trimmed at every border", TRIM, TRIM))
    if (top or left) and (top, left) != (TRIM, TRIM):
        out.append(Box("box", f"{top} rows and {left} columns trimmed at every border", top, left))
    return out


def da3_border(width: int, height: int) -> tuple[int, int]:
    """Rows and columns that Depth Anything 3 cuts off at each side."""
    return int(8 / 256 * height), int(8 / 256 * width)


def every_nth(views: int, count: int) -> tuple[int, ...] | None:
    """Which ``count`` of the views an exporter that takes every n-th one has; None where no n does."""
    for step in range(1, views + 1):
        chosen = tuple(range(0, views, step))
        if len(chosen) == count:
            return chosen
    return None


def exact_layouts(count: int, views: int, width: int, height: int) -> Iterator[Layout]:
    """Layouts with exactly ``count`` rows, for every number of views up to ``views``.

    Which camera a block belongs to is a first guess: the cameras in order, or every n-th of them.
    """
    index = np.arange(count, dtype=np.int64)
    for box in boxes(width, height):
        size = (height - 2 * box.top) * (width - 2 * box.left)
        for per_pixel in PER_PIXEL:
            blocks, rest = divmod(count, size * per_pixel)
            if rest or not 1 <= blocks <= views:
                continue
            chosen = every_nth(views, blocks) or tuple(range(blocks))
            yield from _orders(index, box, box.pixels(width, height), per_pixel, chosen, width, height)


def _orders(
    index: np.ndarray, box: Box, grid: np.ndarray, per_pixel: int, views: tuple[int, ...], width: int, height: int
) -> Iterator[Layout]:
    rows, columns, blocks = *grid.shape, len(views)
    arranged = {
        "view-major": index.reshape(blocks, rows, columns, per_pixel).transpose(0, 3, 1, 2),
        "view-fastest": index.reshape(rows, columns, per_pixel, blocks).transpose(3, 2, 0, 1),
        "column-major": index.reshape(blocks, columns, rows, per_pixel).transpose(0, 3, 2, 1),
        "layer-major": index.reshape(per_pixel, blocks, rows, columns).transpose(1, 0, 2, 3),
    }
    pixels = grid.reshape(-1)
    for order, ids in arranged.items():
        if (order == "layer-major" and per_pixel == 1) or (order == "view-fastest" and blocks == 1):
            continue
        layers = f", {per_pixel} Gaussians per pixel" if per_pixel > 1 else ""
        parts = tuple(ids[block, layer] for block in range(blocks) for layer in range(per_pixel))
        yield Layout(
            description=f"{box.description}{layers}, {order}",
            kind=box.kind,
            order=order,
            width=width,
            height=height,
            views=tuple(view for view in views for _ in range(per_pixel)),
            rows=parts,
            pixels=(pixels,) * len(parts),
            per_pixel=per_pixel,
        )


def depth_layout(count: int, depths: np.ndarray) -> Layout | None:
    """The layout of Depth Anything 3 from its depth maps: border, nearest 90 % of each view, every n-th view.

    Args:
        count: Rows of the file.
        depths: ``[v,h,w]``; only their order matters, so any scale will do.

    Returns:
        None if no choice of views has that many pixels.
    """
    views, height, width = depths.shape
    kept = [depth_mask(depth) for depth in depths]
    for step in range(1, views + 1):
        chosen = tuple(range(0, views, step))
        if sum(len(kept[view]) for view in chosen) == count:
            ends = np.cumsum([len(kept[view]) for view in chosen])
            top, left = da3_border(width, height)
            every = "" if step == 1 else f", every {step}. view"
            return Layout(
                description=f"{top} rows and {left} columns trimmed, nearest 90 % of each view{every}, view-major",
                kind="box+depth",
                order="view-major",
                width=width,
                height=height,
                views=chosen,
                rows=tuple(np.split(np.arange(count, dtype=np.int64), ends[:-1])),
                pixels=tuple(kept[view] for view in chosen),
            )
    return None


def depth_mask(depth: np.ndarray) -> np.ndarray:
    """Pixels of one view that Depth Anything 3 keeps, in order.

    Its threshold is the 90 % quantile of all the view's depths, interpolated: between two depths that occur, so
    the lower of the two decides.
    """
    height, width = depth.shape
    rank = int(DEPTH_SHARE * (depth.size - 1))
    mask = depth <= np.partition(depth.reshape(-1), rank)[rank]
    top, left = da3_border(width, height)
    inside = np.zeros_like(mask)
    inside[top : height - top, left : width - left] = True
    return np.flatnonzero(mask & inside)


def subsample(layout: Layout, per_block: int) -> Layout:
    """About ``per_block`` rows of each block, spread over all columns and rows."""
    rows, pixels = [], []
    for some, where in zip(layout.rows, layout.pixels, strict=True):
        step = max(1, -(-some.size // per_block))
        while step > 1 and np.gcd(step, layout.width) > 1:  # a step that divides the width sees some columns only
            step += 1
        chosen = np.arange(0, some.size, step)
        rows.append(some.flat[chosen])
        pixels.append(where[chosen])
    return replace(layout, rows=tuple(rows), pixels=tuple(pixels))


def to_grid(
    gaussians: Gaussians, valid: Tensor, layout: Layout, cameras: Cameras, images: Tensor | None, names: tuple[str, ...]
) -> PixelScene:
    """The scene on the full grid of the layout.

    Pixels without a row get a fully transparent Gaussian, like rows that are not finite.

    Args:
        gaussians: The file's rows.
        valid: ``[n]`` bool.
        layout: Which row belongs to which pixel.
        cameras: All cameras, in the frame of the Gaussians and at the grid's size.
        images: ``[c,h,w,3]`` of all cameras, or None.
        names: Names of all cameras.
    """
    views = list(layout.views)
    if views != list(range(len(cameras))):
        cameras, images = cameras[views], None if images is None else images[views]
    grid = len(views), layout.height, layout.width
    names = tuple(names[view] for view in views)
    if layout.is_plain:
        return PixelScene(gaussians, cameras, images, valid.reshape(grid), names)
    source = _row_of_pixel(layout)
    missing = source < 0
    none = torch.from_numpy(missing) if missing.any() else None
    if none is not None:
        there = np.where(missing, 0, np.arange(len(source)))
        there[: int(np.argmin(missing))] = int(np.argmin(missing))
        source = source[np.maximum.accumulate(there)]
    index = torch.from_numpy(source)
    out, kept = gaussians[index], valid[index]
    if none is not None:
        kept[none] = False
        for values, value in ((out.opacities, 0.0), (out.sh0, 0.0), (out.shN, 0.0)):
            values[none] = value
        out.quats[none] = torch.tensor((1.0, 0, 0, 0))
    return PixelScene(out, cameras, images, kept.reshape(grid), names, None if none is None else none.reshape(grid))


def _row_of_pixel(layout: Layout) -> np.ndarray:
    """The file row of every pixel of the grid, -1 where there is none."""
    size = layout.width * layout.height
    source = np.full(size * len(layout.views), -1, np.int64)
    for i, (rows, pixels) in enumerate(zip(layout.rows, layout.pixels, strict=True)):
        source[i * size + pixels] = rows.reshape(-1)
    return source
