"""Sort Gaussians by depth, and append them in this order to the lists of the tiles that they may touch."""

from __future__ import annotations

import numpy as np

from gsmerge.method.kernels.raster.project import CONIC
from gsmerge.method.kernels.signature import STATUS, f4, i2, i4, i8, native, u4, u8

MOST_TILES = 2**15 - 1  # most tiles in a row and in a column, because boxes have 16 bits


@native(bits=u4("m"), order=i4("m", out=True), keys=u8("m", out=True), spare=u8("m", out=True))
def sort_bits(bits, order, keys, spare):
    """Write the stable ascending order of ``bits`` to ``order``, with ``keys`` and ``spare`` as scratch."""


def depth_order(depths):
    """Return the order ``[m]`` int32 of ``depths [m]`` float32 above 0, nearest first. Equal depths stay in order."""
    m = len(depths)
    order = np.empty(m, np.int32)
    sort_bits(depths.view(np.uint32), order, np.empty(m, np.uint64), np.empty(m, np.uint64))
    return order


@native(
    STATUS, boxes=i2("m", 4), tile_height=i8(least=0, most=MOST_TILES), tile_width=i8(least=0, most=MOST_TILES),
    corners=i8("num_corners", out=True), counts=i8("tiles", out=True),
)  # fmt: skip
def count_boxes(boxes, tile_height, tile_width, corners, counts):
    """Write the number of boxes over each tile. ``corners`` is scratch for the corners of tiles, and zero before."""


def count_tiles(boxes, tile_height, tile_width):
    """Return the number of boxes over each tile, ``[tile_height * tile_width]`` int64.

    ``boxes [m,4]`` int16 are the first and last column of tiles, and the first and last row. Last ones are exclusive.
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
        boxes: ``[m,4]`` int16 boxes of the Gaussians, in the same order.
        tile_width: Number of tiles in a row.
        cursors: ``[tiles]`` int64 ends of the lists in ``flatten_ids``, which are advanced.
    """


@native(
    STATUS, order=i4("m"), boxes=i2("m", 4), conics=f4("m", CONIC), tile_width=i8(), first=i8(), last=i8(),
    left=f4("tiles", out=True), cursors=i8("tiles", out=True), flatten_ids=i4("intersections", out=True),
)  # fmt: skip
def deal_open_tiles(order, boxes, conics, tile_width, first, last, left, cursors, flatten_ids):
    """Append Gaussians to the lists of a range of rows of tiles, but leave out hidden Gaussians.

    A Gaussian is hidden if all pixels of the tile are already opaque in front of this Gaussian. The lists of
    :func:`deal_tiles` also have hidden Gaussians, and give the same picture.

    Args:
        order: ``[m]`` int32 Gaussians in depth order.
        boxes: ``[m,4]`` int16 boxes of the Gaussians, in the same order.
        conics: ``[m,CONIC]`` float32 conics of the Gaussians.
        tile_width: Number of tiles in a row.
        first: First row of tiles.
        last: Last row of tiles, exclusive.
        left: ``[tiles]`` float32 upper bounds of the transmittance of each tile, 1 before, which are lowered.
        cursors: ``[tiles]`` int64 ends of the lists, which are advanced.
        flatten_ids: ``[intersections]`` int32, written. If the array is empty, only the cursors are advanced.
    """
