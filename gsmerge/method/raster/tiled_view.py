"""Tile a view: project Gaussians, sort them by depth and list them by tile."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsmerge.arrays import distinct
from gsmerge.frozen import dataclass
from gsmerge.method.geometry.transforms import camera_centres, medians
from gsmerge.method.kernels.matrices import matmul
from gsmerge.method.kernels.raster import project as projection
from gsmerge.method.kernels.raster.binning import count_tiles, deal_open_tiles, deal_tiles, depth_order
from gsmerge.runtime.threads import parallel_map, use_threads
from gsmerge.types import Gaussians

Array = NDArray[Any]

THREAD_PIECE = 1 << 13  # least number of Gaussians or intersections per thread
# Least intersections of a crowded view, and least mean intersections per Gaussian. In a crowded view most Gaussians are
# hidden, so the list of each tile ends at its last visible Gaussian
CROWDED = 1 << 24
CROWDED_EACH = 16
EPS2D = 0.3  # low-pass of the rasterizer, which widens Gaussians; square pixels of the full-size image
# depths, world units
WORLD_NEAR_PLANE = 0.01
FAR_PLANE = math.inf
# Directions are clamped at SPARE_SHARE of the image's size outside its borders, as in gsplat, because the first-order
# projection is too inexact farther outside
SPARE_SHARE = 0.15


@dataclass(frozen=True, eq=False)
class Splats:
    """Gaussians as contiguous float32 arrays for the kernels."""

    means: Array  # [n,3] world positions minus `origin`
    quats: Array  # [n,4] wxyz
    scales: Array  # [n,3] linear
    opacities: Array  # [n] in [0, 1]
    sh0: Array  # [n,1,3]
    shN: Array  # [n,k-1,3]
    origin: Array  # [3] float64, subtracted from the means before they were rounded to float32

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True, eq=False)
class TiledView:
    """Gaussians projected into one view, sorted by depth and listed by tile."""

    splats: Splats
    ids: Array  # [m] int32 Gaussians that may touch the image, ascending; a few near its border do not
    conics: Array  # [m,8] float32, see gsmerge.method.kernels.raster.project
    depths: Array  # [m] float32, camera z
    flatten_ids: Array  # [intersections] int32 rows of `ids`, tile after tile, nearest first
    isect_offsets: Array  # [tiles+1] int64 starts of the tiles' lists
    eye: Array  # [3] float32, the camera's centre minus `splats.origin`
    opacities: Array  # [n] float32, as they are drawn
    camera: Array  # float32 numbers of the camera in the order of gsmerge.method.kernels.raster.project
    viewmat: Array  # [4,4] float64, world to camera
    width: int  # pixels
    height: int  # pixels
    top: int = 0  # first row of a band of the view, which has `height` rows and can only be blended

    @property
    def lists(self) -> tuple[Array, Array, Array, int]:
        """Arrays and the number of tiles per row, the first arguments of kernels that read the lists of tiles."""
        return self.conics, self.flatten_ids, self.isect_offsets, -(-self.width // projection.TILE)


def _choose_origin(means: Array) -> Array:
    """Return zero, or the centre of the means if they are too far from zero for float32."""
    origin_sample = 4096  # centre and spread are measured on at least this many means, or on all if there are fewer
    sample = means[:: max(1, len(means) // origin_sample)].astype(np.float64)
    sample = sample[np.isfinite(sample).all(1)]
    if len(sample) == 0:
        return np.zeros(3)
    centre = medians(sample)
    spread = medians(np.abs(sample - centre)).max()
    far_origin = 16  # means are shifted if their centre is farther from zero than so many times their spread
    return centre if np.abs(centre).max() > far_origin * spread else np.zeros(3)


def make_splats(gaussians: Gaussians, origin: ArrayLike | None = None) -> Splats:
    """Convert Gaussians to float32 splats for the kernels, without a copy of arrays of the right type and layout.

    Means may be float64, for scenes in geographic coordinates. ``origin [3]`` is the world point that becomes the zero
    of the splats. By default the origin is the world's zero, or the centre of the means if this centre is much farther
    from zero than the means are from the centre.
    """
    gaussians = gaussians.numpy()
    zero = _choose_origin(gaussians.means) if origin is None else np.asarray(origin, np.float64).reshape(3)
    means = gaussians.means
    if zero.any():  # subtracted in float64, and the result is rounded to float32
        shifted = np.empty(means.shape, np.float32)
        if means.dtype == np.float32:
            projection.shift_means(np.ascontiguousarray(means), np.ascontiguousarray(zero, np.float64), shifted)
        else:
            for axis in range(3):  # NumPy takes a third of the time if it subtracts one axis at a time
                np.subtract(means[:, axis], zero[axis], out=shifted[:, axis], dtype=np.float64, casting="unsafe")
        means = shifted
    columns = vars(gaussians) | {"means": means}
    return Splats(**{name: np.ascontiguousarray(column, np.float32) for name, column in columns.items()}, origin=zero)


def num_pieces(count: int, threads: int, least: int = THREAD_PIECE) -> int:
    """Return into how many pieces to split ``count`` items: up to four per thread, with at least ``least`` items."""
    return 1 if threads == 1 else max(1, min(4 * threads, count // least))


def pieces(count: int, threads: int) -> list[tuple[int, int]]:
    """Split ``count`` items into ranges for the threads, on which results do not depend."""
    num = num_pieces(count, threads)
    return [(count * i // num, count * (i + 1) // num) for i in range(num)]


def tile_ranges(tiled: TiledView, threads: int, least: int = THREAD_PIECE) -> list[tuple[int, int]]:
    """Split tiles into ranges for the threads, each with about the same number of intersections, at least ``least``."""
    count = len(tiled.flatten_ids)
    num = num_pieces(count, threads, least)
    cuts = np.searchsorted(tiled.isect_offsets, count * np.arange(1, num) / num)
    edges = distinct(np.concatenate([[0], cuts, [len(tiled.isect_offsets) - 1]]))
    return list(pairwise(edges.tolist()))


def camera_numbers(
    viewmat: Array, K: Array, width: int, height: int, eps2d: float, antialiased: bool,
    near: float = WORLD_NEAR_PLANE, far: float = FAR_PLANE,
) -> Array:  # fmt: skip
    """Return a camera as an array of float32 numbers, in the order in which the kernels read them."""
    fx = K[0, 0]
    fy = K[1, 1]
    cx = K[0, 2]
    cy = K[1, 2]
    spare_x = SPARE_SHARE * width / fx
    spare_y = SPARE_SHARE * height / fy
    camera = np.zeros(projection.CAMERA, np.float32)
    camera[projection.ROTATION : projection.SHIFT] = viewmat[:3, :3].ravel()
    camera[projection.SHIFT : projection.FX] = viewmat[:3, 3]
    camera[projection.FX : projection.NEAR] = fx, fy, cx, cy, width, height
    camera[projection.EPS2D] = eps2d
    camera[projection.LIMIT_X : projection.LIMIT_Y] = (width - cx) / fx + spare_x, -cx / fx - spare_x
    camera[projection.LIMIT_Y : projection.ANTIALIASED] = (height - cy) / fy + spare_y, -cy / fy - spare_y
    camera[projection.ANTIALIASED] = antialiased
    camera[projection.NEAR] = near
    camera[projection.FAR] = far
    return camera


def cache_line_rows(count: int, width: int) -> Array:
    """Allocate ``[count,width]`` float32 from the start of a cache line, so that no short row lies in two lines."""
    cache_line = 16  # float32 values per cache line
    buffer = np.empty(count * width + cache_line, np.float32)
    start = -(buffer.ctypes.data // buffer.itemsize) % cache_line
    return buffer[start : start + count * width].reshape(count, width)


def _project(
    splats: Splats, opacities: Array, keep: Array | None, tiles: Array | None, camera: Array, threads: int
) -> tuple[Array, Array, Array, Array]:
    """Project the Gaussians that may touch the image or, with a mask ``tiles``, its True tiles.

    Returns their ascending ids ``[m]``, conics ``[m,8]``, depths ``[m]`` and boxes of tiles ``[m,4]``.
    """
    corner_sums = None
    if tiles is not None:
        # Number of True tiles above and to the left of each corner of a tile. The counts at the four corners of a box
        # tell whether it contains a True tile
        corner_sums = np.pad(tiles.astype(np.int32).cumsum(0).cumsum(1), ((1, 0), (1, 0))).astype(np.int32)

    def cull(span: tuple[int, int]) -> Array:
        """Return the ids of the Gaussians in a range of rows that may touch the image or its chosen tiles."""
        rows = slice(*span)
        ids = np.empty(span[1] - span[0], np.int32)
        keep_rows = None if keep is None else keep[rows]
        count = projection.cull(
            splats.means[rows], splats.scales[rows], opacities[rows], keep_rows, corner_sums, camera, span[0], ids
        )
        return ids[:count].copy()

    ids = np.concatenate(parallel_map(cull, pieces(len(splats), threads)))
    m = len(ids)
    conics, depths = cache_line_rows(m, projection.CONIC), np.empty(m, np.float32)
    boxes = np.empty((m, 4), np.int16)

    def project(span: tuple[int, int]) -> None:
        """Write the conics, depths and boxes of a range of the Gaussians."""
        rows = slice(*span)
        projection.project(
            splats.means, splats.quats, splats.scales, opacities, ids[rows], camera,
            conics[rows], depths[rows], boxes[rows],
        )  # fmt: skip

    parallel_map(project, pieces(m, threads))
    return ids, conics, depths, boxes


def hides_most(num_intersections: int, num_visible: int) -> bool:
    """Return whether a view has so many intersections that most of its Gaussians are hidden behind others."""
    return num_intersections > max(CROWDED, CROWDED_EACH * num_visible)


def _list_by_tile(order: Array, boxes: Array, conics: Array, wanted: Array, threads: int) -> tuple[Array, Array]:
    """List the Gaussians of each tile in their ``order`` of depth.

    Returns all lists in one array, and their starts. Only ``wanted [tile_height,tile_width]`` tiles get a list, except
    in crowded views, see :func:`hides_most`, where all tiles get a list.
    """
    # Boxes are sorted first, each as one number, because the loops below read neighbours in memory faster
    boxes = boxes.view(np.uint64).reshape(-1).take(order).view(np.int16).reshape(-1, 4)
    spans = pieces(len(order), threads)
    counts = np.stack(parallel_map(lambda part: count_tiles(boxes[slice(*part)], *wanted.shape), spans))
    if hides_most(int(counts.sum()), len(order)):
        return _list_open_tiles(
            order, boxes, conics=conics, tile_height=wanted.shape[0], tile_width=wanted.shape[1], threads=threads
        )
    totals = counts.sum(0)
    is_wanted = wanted.reshape(-1)
    isect_offsets = np.concatenate([[0], np.cumsum(totals * is_wanted)])
    # The lists of unwanted tiles are written behind the lists of wanted tiles, and then cut off
    ends = np.where(is_wanted, isect_offsets[1:], isect_offsets[-1] + np.cumsum(totals * ~is_wanted))
    cursors = ends - totals + np.cumsum(counts, 0) - counts
    flatten_ids = np.empty(totals.sum(), np.int32)

    def deal(piece: tuple[tuple[int, int], Array]) -> None:
        """Append a range of Gaussians to the lists, from the position of each tile's cursor on."""
        (start, end), tile_cursors = piece
        deal_tiles(order[start:end], boxes[start:end], wanted.shape[1], tile_cursors, flatten_ids)

    parallel_map(deal, zip(spans, cursors, strict=True))
    return flatten_ids[: isect_offsets[-1]], isect_offsets


def _list_open_tiles(
    order: Array, boxes: Array, conics: Array, tile_height: int, tile_width: int, threads: int
) -> tuple[Array, Array]:
    """Return lists like :func:`_list_by_tile`, but without the Gaussians behind the last visible one of a tile."""
    num = min(tile_height, 4 * threads)
    spans = [(tile_height * i // num, tile_height * (i + 1) // num) for i in range(num)]

    def deal(cursors: Array, flatten_ids: Array) -> None:
        """Append Gaussians to the lists and advance the cursors, or only the cursors if there are no lists."""
        bounds = np.ones(len(cursors), np.float32)  # upper bounds of the transmittance of each tile
        parallel_map(
            lambda lines: deal_open_tiles(order, boxes, conics, tile_width, *lines, bounds, cursors, flatten_ids), spans
        )

    counts = np.zeros(tile_height * tile_width, np.int64)
    deal(counts, np.empty(0, np.int32))
    isect_offsets = np.concatenate([[0], np.cumsum(counts)])
    flatten_ids = np.empty(isect_offsets[-1], np.int32)
    deal(isect_offsets[:-1].copy(), flatten_ids)
    return flatten_ids, isect_offsets


def _check_view(viewmat: Array, K: Array, width: int, height: int) -> None:
    """Raise ValueError if matrices have another shape, or if the image size or a focal length is out of range."""
    if viewmat.shape != (4, 4) or K.shape != (3, 3):
        raise ValueError(f"expected a [4,4] view matrix and [3,3] K, got {list(viewmat.shape)} and {list(K.shape)}")
    if not (0 < width <= projection.MAX_SIZE and 0 < height <= projection.MAX_SIZE):
        most = projection.MAX_SIZE
        raise ValueError(f"expected an image size from 1 to {most} pixels per side, got {width} x {height}")
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        raise ValueError(f"expected positive focal lengths, got {K[0, 0]} and {K[1, 1]}")


def tile_view(
    splats: Splats,
    viewmat: ArrayLike,
    K: ArrayLike,
    width: int,
    height: int,
    *,
    eps2d: float = EPS2D,
    antialiased: bool = False,
    near: float = WORLD_NEAR_PLANE,
    far: float = FAR_PLANE,
    opacities: Array | None = None,
    keep: Array | None = None,
    tiles: Array | None = None,
    band: tuple[int, int] | None = None,
    columns: tuple[int, int] | None = None,
) -> TiledView:
    """Project Gaussians into one view, sort them by depth and bin them into tiles.

    ``viewmat [4,4]`` is world to camera, and ``K [3,3]`` is in pixels without skew. ``near`` and ``far`` are exclusive,
    in world units. ``eps2d`` is the dilation in the image, square pixels. ``antialiased`` lowers the opacity of a
    Gaussian to compensate for the dilation (the 2D filter of Mip-Splatting). ``opacities [n]`` replace the opacities of
    the Gaussians. Gaussians with a False ``keep [n]`` are left out.

    Tiles have 16 x 16 pixels. Only tiles with a True ``tiles [tile_height,tile_width]`` have to be complete. ``band``
    is the first line of tiles to draw and the line after the last. If ``band`` is given, the result is a view of the
    lines in the band alone. ``columns`` is the first column of tiles and the column after the last. Tiles outside of
    ``band`` and ``columns`` are empty.

    The size of the result depends on the number of visible Gaussians, not on n. Raises ValueError if a size or a number
    is out of range.
    """
    viewmat = np.asarray(viewmat, np.float64).copy()
    K = np.asarray(K, np.float64)
    _check_view(viewmat, K, width, height)
    if not (0 < near < far and eps2d >= 0):
        raise ValueError(f"expected 0 < near < far and eps2d >= 0, got {near}, {far} and {eps2d}")
    opacities = splats.opacities if opacities is None else np.ascontiguousarray(opacities, np.float32)
    keep = None if keep is None else np.ascontiguousarray(keep, bool).view(np.uint8)
    num_flags = len(splats) if keep is None else len(keep)
    if opacities.shape != (len(splats),) or num_flags != len(splats):
        raise ValueError(f"expected {len(splats)} opacities and keep flags, got {len(opacities)} and {num_flags}")
    local_viewmat = viewmat.copy()  # from the coordinates of the splats, whose zero is at `splats.origin`
    local_viewmat[:3, 3] += matmul(local_viewmat[:3, :3], splats.origin)
    camera = camera_numbers(
        local_viewmat, K, width=width, height=height, eps2d=eps2d, antialiased=antialiased, near=near, far=far
    )
    tile_width = -(-width // projection.TILE)
    tile_height = -(-height // projection.TILE)
    # tiles
    top, bottom = band or (0, tile_height)
    left, right = columns or (0, tile_width)
    is_part = band is not None or columns is not None
    if is_part:
        tiles = np.zeros((tile_height, tile_width), bool)
        tiles[top:bottom, left:right] = True
    if tiles is not None and tiles.shape != (tile_height, tile_width):
        raise ValueError(f"tiles: expected shape {[tile_height, tile_width]}, got {list(tiles.shape)}")
    with use_threads() as threads:
        ids, conics, depths, boxes = _project(splats, opacities, keep=keep, tiles=tiles, camera=camera, threads=threads)
        if is_part:
            boxes[:, :2] = boxes[:, :2].clip(left, right)
            boxes[:, 2:] = boxes[:, 2:].clip(top, bottom)
        order = depth_order(depths)
        wanted = np.ones((tile_height, tile_width), bool) if tiles is None else tiles
        flatten_ids, isect_offsets = _list_by_tile(order, boxes, conics, wanted, threads)
    eye = camera_centres(local_viewmat).astype(np.float32)
    first_row = top * projection.TILE
    return TiledView(
        splats, ids=ids, conics=conics, depths=depths, flatten_ids=flatten_ids, isect_offsets=isect_offsets, eye=eye,
        opacities=opacities, camera=camera, viewmat=viewmat, width=width,
        height=min(height, bottom * projection.TILE) - first_row, top=first_row,
    )  # fmt: skip
