"""Depth order and tile lists: every Gaussian is sorted once, then put into the lists of its tiles in that order."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import STATUS, i2, i4, i8, native, u4, u8


@native(bits=u4("m"), order=i4("m", out=True), keys=u8("m", out=True), spare=u8("m", out=True))
def sort_bits(bits, order, keys, spare):
    """Write the stable order of ``bits`` to ``order``; ``keys`` and ``spare`` are overwritten."""


def depth_order(bits):
    """Stable order by the bit patterns ``[m]`` uint32 of positive floats, nearest first: ``[m]`` int32 positions."""
    m = len(bits)
    order = np.empty(m, np.int32)
    sort_bits(bits, order, np.empty(m, np.uint64), np.empty(m, np.uint64))
    return order


@native(
    STATUS, boxes=i2("m", 4), lines=i8(least=0), columns=i8(least=0), corners=i8("num_corners", out=True),
    counts=i8("tiles", out=True),
)  # fmt: skip
def count_boxes(boxes, lines, columns, corners, counts):
    """Write the number of boxes over each tile; ``corners``, zero before, has a place for every corner of a tile."""


def count_tiles(boxes, lines, columns):
    """``[lines * columns]`` int64 boxes over each tile.

    ``boxes [m,4]`` int16: first and (exclusive) last tile column, first and last tile row.
    """
    counts = np.empty(lines * columns, np.int64)
    count_boxes(boxes, lines, columns, np.zeros((lines + 1) * (columns + 1), np.int64), counts)
    return counts


@native(
    STATUS, order=i4("m"), boxes=i2("m", 4), columns=i8(), cursors=i8("tiles", out=True),
    members=i4("intersections", out=True),
)  # fmt: skip
def deal_tiles(order, boxes, columns, cursors, members):
    """Append Gaussians to the lists of the tiles under their boxes.

    Args:
        order: ``[m]`` int32 Gaussians in depth order.
        boxes: ``[m,4]`` int16 their boxes, in the same order.
        columns: Tiles per row.
        cursors: ``[tiles]`` int64 where each list goes on, advanced.
        members: ``[intersections]`` int32, written.
    """
