"""Depth order and tile lists: every Gaussian is sorted once, then put into the lists of its tiles in that order."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.jit import kernel

DIGIT = 11  # bits sorted per pass at most: 2048 counters and their streams stay in the first caches


@kernel
def depth_order(bits):
    """Stable order by the bit patterns ``[m]`` uint32 of positive floats, nearest first: ``[m]`` int32 positions.

    A least-significant-digit radix sort. Only the bits in which the range of values differs are sorted, in as few
    and as even passes as possible.
    """
    m = bits.shape[0]
    order = np.empty(m, np.int32)
    if m == 0:
        return order
    low, high = bits[0], bits[0]
    for i in range(m):
        low = min(low, bits[i])
        high = max(high, bits[i])
    span, width = np.int64(high) - np.int64(low), 1
    while span >> width:
        width += 1
    passes = (width + DIGIT - 1) // DIGIT
    digit = np.uint64((width + passes - 1) // passes)
    mask = np.uint64((1 << digit) - 1)
    counts = np.zeros((passes, 1 << digit), np.int64)
    keys, spare = np.empty(m, np.uint64), np.empty(m, np.uint64)
    for i in range(m):
        key = np.uint64(bits[i] - low)
        keys[i] = (key << np.uint64(32)) | np.uint64(i)
        for p in range(passes):
            counts[p, (key >> (np.uint64(p) * digit)) & mask] += 1
    for p in range(passes):
        total = 0
        for j in range(counts.shape[1]):
            count = counts[p, j]
            counts[p, j] = total
            total += count
        shift = np.uint64(32) + np.uint64(p) * digit
        for i in range(m):
            key = keys[i]
            j = (key >> shift) & mask
            slot = counts[p, j]
            counts[p, j] = slot + 1
            spare[slot] = key
        keys, spare = spare, keys
    for i in range(m):
        order[i] = np.int32(keys[i] & np.uint64(0xFFFFFFFF))
    return order


@kernel
def count_tiles(boxes, lines, columns):
    """``[lines * columns]`` int64 boxes over each tile.

    ``boxes [m,4]`` int16: first and (exclusive) last tile column, first and last tile row.
    """
    # Differences at the boxes' corners, then running sums: no loop over tiles, so nothing to mispredict.
    corners = np.zeros((lines + 1, columns + 1), np.int64)
    for i in range(boxes.shape[0]):
        x0, x1, y0, y1 = boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3]
        corners[y0, x0] += 1
        corners[y0, x1] -= 1
        corners[y1, x0] -= 1
        corners[y1, x1] += 1
    counts = np.zeros(lines * columns, np.int64)
    for line in range(lines):
        run = 0
        for column in range(columns):
            run += corners[line, column]
            tile = line * columns + column
            counts[tile] = run + (counts[tile - columns] if line > 0 else 0)
    return counts


@kernel
def deal_tiles(order, boxes, columns, cursors, members):
    """Append Gaussians to the lists of the tiles under their boxes.

    Args:
        order: ``[m]`` int32 Gaussians in depth order.
        boxes: ``[m,4]`` int16 their boxes, in the same order.
        cursors: ``[tiles]`` int64 where each list goes on, advanced.
        members: ``[intersections]`` int32, written.
    """
    for i in range(order.shape[0]):
        k = order[i]
        x0, y0 = np.int64(boxes[i, 0]), np.int64(boxes[i, 2])
        width, height = np.int64(boxes[i, 1]) - x0, np.int64(boxes[i, 3]) - y0
        tile, column = y0 * columns + x0, 0
        # One loop for both axes: most boxes hold a tile or two, and the end of a loop is mispredicted.
        for _ in range(width * height):
            slot = cursors[tile]
            cursors[tile] = slot + 1
            members[slot] = k
            column += 1
            wrap = column == width
            tile += columns - width + 1 if wrap else 1
            column = 0 if wrap else column
