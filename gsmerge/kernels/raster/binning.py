"""Sort Gaussians by depth once, then append them in that order to the lists of their tiles."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.raster.project import CONIC
from gsmerge.kernels.signature import STATUS, f4, i2, i4, i8, native, u4, u8

MOST_TILES = 2**15 - 1  # per row and per column, since boxes have 16 bits


@native(bits=u4("m"), order=i4("m", out=True), keys=u8("m", out=True), spare=u8("m", out=True))
def sort_bits(bits, order, keys, spare):
    """Write the stable order of ``bits`` to ``order``; ``keys`` and ``spare`` are overwritten."""


def depth_order(bits):
    """Return the stable order of ``[m]`` uint32 bit patterns of positive floats, nearest first: ``[m]`` int32."""
    m = len(bits)
    order = np.empty(m, np.int32)
    sort_bits(bits, order, np.empty(m, np.uint64), np.empty(m, np.uint64))
    return order


@native(
    STATUS, boxes=i2("m", 4), tile_height=i8(least=0, most=MOST_TILES), tile_width=i8(least=0, most=MOST_TILES),
    corners=i8("num_corners", out=True), counts=i8("tiles", out=True),
)  # fmt: skip
def count_boxes(boxes, tile_height, tile_width, corners, counts):
    """Write the number of boxes over each tile; ``corners`` is scratch, zero before, an entry for each tile corner."""


def count_tiles(boxes, tile_height, tile_width):
    """Count the boxes over each tile: ``[tile_height * tile_width]`` int64.

    ``boxes [m,4]`` int16 are first and (exclusive) last tile column, first and last tile row.
    """
    counts = np.empty(tile_height * tile_width, np.int64)
    count_boxes(boxes, tile_height, tile_width, np.zeros((tile_height + 1) * (tile_width + 1), np.int64), counts)
    return counts


@native(
    STATUS, order=i4("m"), boxes=i2("m", 4), tile_width=i8(least=0, most=MOST_TILES), cursors=i8("tiles", out=True),
    flatten_ids=i4("intersections", out=True),
)  # fmt: skip
def deal_tiles(order, boxes, tile_width, cursors, flatten_ids):
    """Append Gaussians to the lists of the tiles under their boxes.

    Args:
        order: ``[m]`` int32 Gaussians in depth order.
        boxes: ``[m,4]`` int16 their boxes, in the same order.
        tile_width: Tiles per row.
        cursors: ``[tiles]`` int64 ends of the lists in ``flatten_ids``, advanced.
    """


@native(
    STATUS, order=i4("m"), boxes=i2("m", 4), conics=f4("m", CONIC), tile_width=i8(), first=i8(), last=i8(),
    left=f4("tiles", out=True), cursors=i8("tiles", out=True), flatten_ids=i4("intersections", out=True),
)  # fmt: skip
def deal_open_tiles(order, boxes, conics, tile_width, first, last, left, cursors, flatten_ids):
    """Append Gaussians to the lists of a range of tile lines, but leave out hidden Gaussians.

    The lists are those of :func:`deal_tiles`, but each ends with the Gaussian after which every pixel of the tile has
    stopped. So the pixels do not change.

    Args:
        order: ``[m]`` int32 Gaussians in depth order.
        boxes: ``[m,4]`` int16 their boxes, in the same order.
        conics: ``[m,CONIC]`` float32 of the Gaussians.
        tile_width: Tiles per row.
        first: First line of tiles.
        last: Last line of tiles, exclusive.
        left: ``[tiles]`` float32 upper bound of each tile's transmittance, 1 before; lowered.
        cursors: ``[tiles]`` int64 ends of the lists, advanced.
        flatten_ids: ``[intersections]`` int32, written; if it is empty, only the cursors are advanced.
    """
