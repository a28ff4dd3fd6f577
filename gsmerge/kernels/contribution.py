"""The superpixel of one view that every Gaussian adds most to (paper, supplement on non-pixel-aligned backbones).

Blending weights are summed per pair of Gaussian and superpixel while the tiles are walked. The pairs of one row of
tiles are kept, chained by Gaussian; at its end every Gaussian that does not reach into the next row is decided, and
the rest is carried over. So memory goes with a row of tiles, not with the view.
"""

from __future__ import annotations

import numpy as np
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel
from gsmerge.kernels.project import TILE
from gsmerge.kernels.raster import BATCH, P1, PLANE, _gather, _live_rows, _open_tile, _weights
from gsmerge.kernels.weights import _columns

FIRST_PAIRS = 1 << 16  # room for pairs to begin with
LAST_ROW = 7  # column of a footprint


@kernel
def _room_for_pairs(count):
    """Label, sum and next pair of the same Gaussian, for each of ``count`` pairs."""
    return np.empty(count, np.int32), np.empty(count, np.float64), np.empty(count, np.int32)


@kernel
def _grown(pairs, count):
    """Twice the room with the same pairs."""
    more = _room_for_pairs(2 * pairs[0].shape[0])
    more[0][:count], more[1][:count], more[2][:count] = pairs[0][:count], pairs[1][:count], pairs[2][:count]
    return more


@kernel
def _chain(pairs, heads, k, at, label, value):
    """Write a pair and put it in front of its Gaussian's chain."""
    pairs[0][at], pairs[1][at], pairs[2][at] = label, value, heads[k]
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
    x0, x1 = _columns(batch, j, num_x)
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
def _settle(k, final, heads, pairs, carried, num_carried, totals, seen, out_values, out_labels):
    """Add up the pairs of one Gaussian; decide if this is final, carry them over if not -> pairs carried."""
    count, pair = 0, heads[k]
    while pair >= 0:
        label = pairs[0][pair]
        if totals[label] == 0.0:
            seen[count] = label
            count += 1
        totals[label] += pairs[1][pair]
        pair = pairs[2][pair]
    heads[k] = -1
    best = seen[0]
    for i in range(count):
        label = seen[i]
        more = (totals[label] > totals[best]) | ((totals[label] == totals[best]) & (label < best))
        best = label if more else best
        if not final:
            _chain(carried, heads, k, num_carried, label, totals[label])
            num_carried += 1
    if final:
        out_values[k], out_labels[k] = f4(totals[best]), best
    for i in range(count):
        totals[seen[i]] = 0.0
    return num_carried


@kernel
def dominant_labels(footprints, members, offsets, columns, labels, num_labels, out_values, out_labels):
    """The superpixel that gets the largest sum of blending weights from each Gaussian, and that sum.

    Of equal sums the superpixel with the smallest label counts.

    Args:
        footprints: ``[m,FOOTPRINT]`` float32.
        members: ``[intersections]`` int32 tile lists.
        offsets: ``[tiles + 1]`` int64 starts of the lists.
        columns: Tiles per row.
        labels: ``[h,w]`` int32, 0 to ``num_labels - 1``.
        num_labels: Superpixels of the view.
        out_values: ``[m]`` float32, written: sum over the pixels, 0 where nothing is seen.
        out_labels: ``[m]`` int32, written: -1 where nothing is seen.
    """
    height, width = labels.shape
    state, batch = np.empty(2 * PLANE, np.float32), np.empty((BATCH, 12), np.float32)
    stamps, lanes, names = np.full(num_labels, -1, np.int32), np.zeros(PLANE, np.int32), np.empty(PLANE, np.int32)
    sums, touched = np.zeros(PLANE, np.float32), np.empty(PLANE + 1, np.int32)
    totals, seen = np.zeros(num_labels), np.empty(num_labels, np.int32)
    heads = np.full(footprints.shape[0], -1, np.int32)  # each Gaussian's last pair; -1: none
    room = max(FIRST_PAIRS, num_labels)  # at least one Gaussian's, so that twice the room always holds one more
    pairs, carried = _room_for_pairs(room), _room_for_pairs(room)
    active = np.empty(footprints.shape[0] + 1, np.int32)  # Gaussians with pairs
    num_pairs, num_active = 0, 0
    out_values[:], out_labels[:] = f4(0.0), -1
    for tile in range(offsets.shape[0] - 1):
        left, top = tile % columns * TILE, tile // columns * TILE
        num_x, num_y = min(TILE, width - left), min(TILE, height - top)
        start, end = offsets[tile], offsets[tile + 1]
        _number_labels(labels, left, top, num_x, num_y, stamps, lanes, names)
        _open_tile(state, num_x, num_y)
        y_low, y_high = 0, num_y - 1
        while start < end and y_low <= y_high:
            stop = min(end, start + BATCH)
            _gather(footprints, members, start, stop, end, left, top, batch)
            if num_pairs + BATCH * PLANE > pairs[0].shape[0]:
                pairs = _grown(pairs, num_pairs)
            for j in range(stop - start):
                y0, y1 = max(y_low, int(batch[j, 6])), min(y_high, int(batch[j, 7]))
                _weights(state, batch, j, y0, y1)
                count, k = _sum_tile(state, batch, j, y0, y1, num_x, lanes, sums, touched), members[start + j]
                active[num_active] = k
                num_active += 1 if (count > 0) & (heads[k] < 0) else 0
                for i in range(num_pairs, num_pairs + count):
                    label = touched[i - num_pairs]
                    _chain(pairs, heads, k, i, names[label], sums[label])
                    sums[label] = f4(0.0)
                num_pairs += count
            start = stop
            y_low, y_high = _live_rows(state, y_low, y_high)
        if tile % columns == columns - 1:  # the row is done
            num_carried, num_staying = 0, 0
            for a in range(num_active):
                k = active[a]
                final = (footprints[k, LAST_ROW] < f4(top + TILE)) | (top + TILE >= height)
                if num_carried + num_labels > carried[0].shape[0]:
                    carried = _grown(carried, num_carried)
                num_carried = _settle(
                    k, final, heads, pairs, carried, num_carried, totals, seen, out_values, out_labels
                )
                active[num_staying] = k
                num_staying += 0 if final else 1
            pairs, carried, num_pairs, num_active = carried, pairs, num_carried, num_staying
