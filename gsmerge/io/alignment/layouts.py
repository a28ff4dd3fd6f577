"""Which row of a file may belong to which pixel: what the number of rows allows; and scenes laid out accordingly."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Literal, get_args

import numpy as np

from gsmerge.geometry import rgb_to_sh0
from gsmerge.types import Cameras, Gaussians, Scene, grid_ids

Order = Literal["auto", "view-major", "view-fastest", "layer-major", "column-major", "unordered", "none"]
ORDERS: tuple[str, ...] = get_args(Order)
MAY_BE_UNALIGNED: tuple[str, ...] = ("unordered", "none")  # orders of files whose rows need not belong to pixels

TRIM = 8  # pixels that DepthSplat and its relatives cut off at every side
PER_PIXEL = (1, 2, 3, 4, 16)  # Gaussians per pixel that backbones write
_MAX_SPREAD = 0.15  # of the Gaussians' depth over a depth map's: above it the map is not that of the Gaussians
DEPTH_SHARE = 0.9  # of each view's pixels, the nearest ones, that Depth Anything 3 keeps


@dataclass(frozen=True)
class Layout:
    """Rows and pixels, block by block: a block is what one view (or one layer of it) wrote."""

    description: str  # what it is, for people
    kind: str  # "full", "trim", "box", "box+depth" or "pruned": which pixels there are
    order: str  # in which order the rows are
    width: int  # of the grid, pixels
    height: int
    views: tuple[int, ...]  # the camera of each block
    rows: tuple[np.ndarray, ...]  # the rows of each block, of any shape: not a copy where a stride will do
    pixels: tuple[np.ndarray, ...]  # ``[p]`` the pixel ``y·W + x`` of each of these rows
    per_pixel: int = 1  # Gaussians per pixel; above 1 each layer is a block

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
    out = [Box("full", "every pixel", 0, 0)]
    if min(width, height) > 2 * TRIM:
        out.append(Box("trim", f"{TRIM} pixels trimmed at every border", TRIM, TRIM))
    da3 = da3_box(width, height)
    if (da3.top or da3.left) and (da3.top, da3.left) != (TRIM, TRIM):
        out.append(da3)
    return out


def da3_box(width: int, height: int) -> Box:
    """What Depth Anything 3 cuts off."""
    top, left = int(8 / 256 * height), int(8 / 256 * width)
    return Box("box", f"{top} rows and {left} columns trimmed at every border", top, left)


def every_nth(views: int) -> list[tuple[int, ...]]:
    """The choices of views of exporters that take every n-th one, for all n."""
    return [tuple(range(0, views, step)) for step in range(1, views + 1)]


def plain_layout(views: int, width: int, height: int) -> Layout:
    """One Gaussian per pixel, view by view and row by row."""
    return next(one for one in exact_layouts(views * width * height, views, width, height) if one.is_plain)


def exact_layouts(count: int, views: int, width: int, height: int) -> Iterator[Layout]:
    """Layouts with exactly ``count`` rows, for every number of views up to ``views``.

    Which camera a block belongs to is a first guess: the cameras in order, or every n-th of them.
    """
    for box in boxes(width, height):
        for per_pixel in PER_PIXEL:
            blocks, rest = divmod(count, (height - 2 * box.top) * (width - 2 * box.left) * per_pixel)
            if rest or not 1 <= blocks <= views:
                continue
            chosen = next((some for some in every_nth(views) if len(some) == blocks), tuple(range(blocks)))
            yield from _orders(count, box, per_pixel, chosen, width, height)


def _orders(count: int, box: Box, per_pixel: int, views: tuple[int, ...], width: int, height: int) -> Iterator[Layout]:
    index, grid = np.arange(count, dtype=np.int64), box.pixels(width, height)
    rows, columns, blocks = *grid.shape, len(views)
    arranged = {
        "view-major": index.reshape(blocks, rows, columns, per_pixel).transpose(0, 3, 1, 2),
        "view-fastest": index.reshape(rows, columns, per_pixel, blocks).transpose(3, 2, 0, 1),
        "column-major": index.reshape(blocks, columns, rows, per_pixel).transpose(0, 3, 2, 1),
        "layer-major": index.reshape(per_pixel, blocks, rows, columns).transpose(1, 0, 2, 3),
    }
    layers = f", {per_pixel} Gaussians per pixel" if per_pixel > 1 else ""
    for order, ids in arranged.items():
        if (order == "layer-major" and per_pixel == 1) or (order == "view-fastest" and blocks == 1):
            continue
        yield Layout(
            description=f"{box.description}{layers}, {order}",
            kind=box.kind,
            order=order,
            width=width,
            height=height,
            views=tuple(view for view in views for _ in range(per_pixel)),
            rows=tuple(layer for block in ids for layer in block),
            pixels=(grid.reshape(-1),) * (blocks * per_pixel),
            per_pixel=per_pixel,
        )


def depth_layouts(count: int, depths: np.ndarray) -> list[Layout]:
    """The layout of Depth Anything 3 from its depth maps: border, nearest 90 % of each view, every n-th view.

    Of ``depths [v,h,w]`` only the order matters, so any scale will do. Empty if no choice of views has ``count``
    pixels.
    """
    views, height, width = depths.shape
    kept = [depth_mask(depth) for depth in depths]
    for step, chosen in enumerate(every_nth(views), 1):
        pixels = tuple(kept[view] for view in chosen)
        ends = np.cumsum([len(some) for some in pixels])
        if ends[-1] == count:
            border = da3_box(width, height).description.removesuffix(" at every border")
            every = "" if step == 1 else f", every {step}. view"
            description = f"{border}, nearest 90 % of each view{every}, view-major"
            rows = tuple(np.split(np.arange(count, dtype=np.int64), ends[:-1]))
            return [Layout(description, "box+depth", "view-major", width, height, chosen, rows, pixels)]
    return []


def depth_mask(depth: np.ndarray) -> np.ndarray:
    """Pixels of one view that Depth Anything 3 keeps, in order.

    Its threshold is the 90 % quantile of all the view's depths, interpolated: between two depths that occur, so
    the lower of the two decides.
    """
    height, width = depth.shape
    rank = int(DEPTH_SHARE * (depth.size - 1))
    mask = depth <= np.partition(depth.reshape(-1), rank)[rank]
    inside = da3_box(width, height).pixels(width, height)
    return inside[mask.reshape(-1)[inside]]


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
    gaussians: Gaussians,
    valid: np.ndarray,
    layout: Layout,
    cameras: Cameras,
    images: np.ndarray | None,
    names: tuple[str, ...],
) -> Scene:
    """The scene on the full grid of the layout; pixels without a row get a fully transparent Gaussian.

    ``gaussians`` and ``valid [n]`` are the file's rows; cameras (in their frame and at the grid's size), ``images
    [c,h,w,3]`` and names are those of all views.
    """
    views = list(layout.views)
    if views != list(range(len(cameras))):
        cameras, images = cameras[views], None if images is None else images[views]
    grid = len(views), layout.height, layout.width
    names = tuple(names[view] for view in views)
    if layout.is_plain:
        return Scene(gaussians, cameras, images, grid_ids(valid), names)
    size = layout.width * layout.height
    source = np.full(size * len(views), -1, np.int64)
    for i, (rows, pixels) in enumerate(zip(layout.rows, layout.pixels, strict=True)):
        source[i * size + pixels] = rows.reshape(-1)
    missing = source < 0
    if not missing.any():
        return Scene(gaussians[source], cameras, images, grid_ids(valid[source]), names)
    before = np.maximum.accumulate(np.where(missing, np.argmin(missing), np.arange(len(source))))
    out, kept = gaussians[source[before]], valid[source[before]]
    kept[missing] = False
    for values in (out.opacities, out.sh0, out.shN):
        values[missing] = 0
    out.quats[missing] = (1, 0, 0, 0)
    return Scene(out, cameras, images, grid_ids(kept), names, missing.reshape(grid))


def fill_from_depths(scene: Scene, depths: np.ndarray) -> Scene:
    """The scene with a Gaussian for each pixel that the file has no row for.

    It lies on the pixel's ray at the depth of the map (``depths [v,h,w]`` of the scene's views), in units that follow
    from the other pixels: as depth along z or as distance, whichever they agree with. Its colour is the photo's; its
    opacity, rotation and size in pixels are those of the pixel before it in the same row. The scene stays as it is if
    it has no photos, lacks nothing, or its Gaussians do not lie at the maps' depths.
    """
    if scene.images is None or scene.missing is None:
        return scene
    V = scene.cameras.viewmats
    views, height, width = scene.valid.shape
    valid, g = scene.valid.reshape(views, -1), scene.gaussians
    means = g.means.astype(np.float64).reshape(views, -1, 3)
    y, x = np.mgrid[:height, :width].reshape(2, -1) + 0.5
    pixels = np.stack([x, y, np.ones(x.size)], 1)
    rays = pixels @ np.linalg.inv(scene.cameras.Ks).transpose(0, 2, 1)  # [v,p,3] in the camera, z = 1
    z = np.einsum("vi,vpi->vp", V[:, 2, :3], means) + V[:, 2, 3, None]
    length = np.linalg.norm(rays, axis=2)
    maps = depths.reshape(views, -1).astype(np.float64)
    usable = valid & (maps > 0) & np.isfinite(maps) & (z > 0)
    if not usable.any():
        return scene
    ratio = z[usable] / maps[usable]
    spread, unit, along = min(_agreement(ratio, 0), _agreement(ratio * length[usable], 1))
    if spread > _MAX_SPREAD:
        return scene
    new_z = unit * maps / (length if along else 1)
    ranks = np.arange(usable.size).reshape(usable.shape)
    before = np.maximum.accumulate(np.where(usable, ranks, 0), axis=1).reshape(-1)
    before = np.where(usable.reshape(-1)[before], before, np.flatnonzero(usable)[0])
    rows = np.flatnonzero(~valid & (maps > 0) & np.isfinite(maps))
    view = rows // (height * width)
    local = rays.reshape(-1, 3)[rows] * new_z.reshape(-1)[rows, None]
    world = np.einsum("tji,tj->ti", V[view, :3, :3], local - V[view, :3, 3])
    source = before[rows]
    full = Gaussians(**{field.name: getattr(g, field.name).copy() for field in fields(g)})
    full.means[rows] = world
    growth = new_z.reshape(-1)[rows] / z.reshape(-1)[source]
    full.scales[rows] = g.scales[source] * growth.astype(np.float32)[:, None]
    full.quats[rows], full.opacities[rows] = g.quats[source], g.opacities[source]
    full.sh0[rows] = rgb_to_sh0(scene.images.reshape(-1, 1, 3)[rows])
    kept = scene.valid.reshape(-1).copy()
    kept[rows] = True
    return replace(scene, gaussians=full, pixel_ids=grid_ids(kept))


def _agreement(ratio: np.ndarray, far: int) -> tuple[float, float, int]:
    """(spread, median, kind) of the Gaussians' depth over the map's."""
    middle = float(np.median(ratio))
    return float(np.median(np.abs(ratio / middle - 1))), middle, far
