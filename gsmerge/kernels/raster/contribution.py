"""The superpixel of one view that every Gaussian adds most to (paper, supplement on non-pixel-aligned backbones).

Blending weights are summed per pair of Gaussian and superpixel while the tiles are walked. The pairs of one row of
tiles are kept, chained by Gaussian; at its end every Gaussian that does not reach into the next row is decided, and
the rest is carried over. So memory goes with a row of tiles, not with the view.
"""

from __future__ import annotations

import numpy as np
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel
from gsmerge.kernels.raster.blend import P1, batch_rows, gather, live_rows, new_batch, open_tile
from gsmerge.kernels.raster.list_weights import batch_columns
from gsmerge.kernels.raster.project import TILE
from gsmerge.kernels.raster.walk import BATCH, PLANE, weigh_rows

LAST_ROW = 7  # column of a footprint
LABEL, SUM, NEXT, PAIR = 0, 1, 2, 3  # columns of a pair, the last the next pair of the same Gaussian, -1 for none


@kernel
def _chain(pairs, at, heads, k, label, value):
    """Write a pair and put it in front of its Gaussian's chain."""
    pairs[at, LABEL], pairs[at, SUM], pairs[at, NEXT] = label, value, heads[k]
    heads[k] = at


@kernel
def _number_labels(labels, left, top, num_x, num_y, stamps, lanes, names):
    """Number the superpixels of a tile from 0: ``lanes`` gets each pixel's number, ``names`` each number's label.

    ``stamps [labels]`` is -1 everywhere before and after.
    """
    count = 0
    for y in range(num_y):
        for x in range(num_x):
            label = labels[top + y, left + x]
            if stamps[label] < 0:
                stamps[label] = count
                names[count] = label
                count += 1
            lanes[y * TILE + x] = stamps[label]
    for i in range(count):
        stamps[names[i]] = -1


@kernel
def _sum_tile(state, batch, j, y0, y1, num_x, lanes, sums, touched):
    """Sum one Gaussian's weights by the tile's superpixels -> how many of them are ``touched``."""
    x0, x1 = batch_columns(batch, j, num_x)
    count = 0
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            i = np.uint64(y * TILE + x)
            w, label = state[i + P1], lanes[i]
            touched[count] = label
            # no branch: it would be mispredicted at every border
            count += 1 if (w > f4(0.0)) & (sums[label] == f4(0.0)) else 0
            sums[label] += w
    return count


@kernel
def add_row(footprints, members, offsets, columns, line, labels, heads, pairs, num_pairs, active, num_active, stamps):
    """Append the pairs of a row of tiles.

    Args:
        line: The row.
        labels: ``[h,w]`` int32.
        heads: ``[m]`` int32, each Gaussian's last pair, -1 for none; updated.
        pairs: ``[room,PAIR]`` float64, appended to.
        num_pairs: Pairs there are already.
        active: ``[m+1]`` int32: the Gaussians that have pairs, appended to.
        num_active: How many there are already.
        stamps: ``[labels]`` int32, -1 everywhere before and after.

    Returns:
        The pairs, in a larger array if they needed one, their number, and that of the Gaussians that have some.
    """
    height, width = labels.shape
    state, batch = np.empty(2 * PLANE, np.float32), new_batch()
    lanes, names = np.zeros(PLANE, np.int32), np.empty(PLANE, np.int32)
    sums, touched = np.zeros(PLANE, np.float32), np.empty(PLANE + 1, np.int32)
    for tile in range(line * columns, (line + 1) * columns):
        left, top = tile % columns * TILE, line * TILE
        num_x, num_y = min(TILE, width - left), min(TILE, height - top)
        start, end = offsets[tile], offsets[tile + 1]
        _number_labels(labels, left, top, num_x, num_y, stamps, lanes, names)
        open_tile(state, num_x, num_y)
        y_low, y_high = 0, num_y - 1
        while start < end and y_low <= y_high:
            stop = min(end, start + BATCH)
            gather(footprints, members, start, stop, end, left, top, batch)
            if num_pairs + BATCH * PLANE > pairs.shape[0]:
                more = np.empty((2 * pairs.shape[0], PAIR))
                more[:num_pairs] = pairs[:num_pairs]
                pairs = more
            for j in range(stop - start):
                y0, y1 = batch_rows(batch, j, y_low, y_high)
                weigh_rows(state, batch, j, y0, y1)
                count, k = _sum_tile(state, batch, j, y0, y1, num_x, lanes, sums, touched), members[start + j]
                active[num_active] = k
                num_active += 1 if (count > 0) & (heads[k] < 0) else 0
                for i in range(count):
                    _chain(pairs, num_pairs + i, heads, k, names[touched[i]], sums[touched[i]])
                    sums[touched[i]] = f4(0.0)
                num_pairs += count
            start = stop
            y_low, y_high = live_rows(state, y_low, y_high)
    return pairs, num_pairs, num_active


@kernel
def settle_row(bottom, footprints, heads, pairs, room, active, num_active, totals, seen, out_values, out_labels):
    """Add up the pairs of every Gaussian; decide on those that end above ``bottom``, carry over the others' sums.

    Of equal sums the superpixel with the smallest label counts.

    Args:
        bottom: First row of pixels that is still to come.
        heads: ``[m]`` int32, each Gaussian's last pair, -1 for none; updated.
        pairs: ``[room,PAIR]`` float64.
        room: Rows of the array of pairs to begin with, at least as many as there are superpixels.
        active: ``[m+1]`` int32: the Gaussians that have pairs; then those that are not decided on.
        num_active: How many there are.
        totals: ``[labels]`` float64, zero before and after.
        seen: ``[labels]`` int32, anything.
        out_values: ``[m]`` float32, written for those that are decided on: the largest sum.
        out_labels: ``[m]`` int32, likewise: its superpixel.

    Returns:
        The pairs carried over, their number, and that of the Gaussians that are not decided on.
    """
    carried, num_carried, num_staying = np.empty((room, PAIR)), 0, 0
    for a in range(num_active):
        k = active[a]
        count, pair = 0, heads[k]
        while pair >= 0:
            label = int(pairs[pair, LABEL])
            if totals[label] == 0.0:
                seen[count] = label
                count += 1
            totals[label] += pairs[pair, SUM]
            pair = int(pairs[pair, NEXT])
        heads[k] = -1
        final = footprints[k, LAST_ROW] < f4(bottom)
        if num_carried + count > carried.shape[0]:  # the room of one Gaussian's fits, so twice it fits one more
            more = np.empty((2 * carried.shape[0], PAIR))
            more[:num_carried] = carried[:num_carried]
            carried = more
        best = seen[0]
        for i in range(count):
            label, total = seen[i], totals[seen[i]]
            best = label if (total > totals[best]) | ((total == totals[best]) & (label < best)) else best
            if not final:
                _chain(carried, num_carried, heads, k, label, total)
                num_carried += 1
        if final:
            out_values[k], out_labels[k] = f4(totals[best]), best
        for i in range(count):
            totals[seen[i]] = 0.0
        active[num_staying] = k
        num_staying += 0 if final else 1
    return carried, num_carried, num_staying
