"""Front-to-back blending of one view, tile by tile, and sums over its blending weights.

All kernels here walk the same lists with the same weights, see :mod:`gsmerge.kernels.raster.walk`. Gaussians are
gathered 32 at a time into a small local batch, with the rows of the tile in which they show.
"""

from __future__ import annotations

import numpy as np
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel
from gsmerge.kernels.raster.lanes import prefetch_row
from gsmerge.kernels.raster.project import LN_CUT, TILE
from gsmerge.kernels.raster.walk import (
    BATCH,
    COLOR,
    DECAY,
    FIRST,
    LAST,
    LNOP,
    MY,
    PLANE,
    PLANES,
    RATE,
    SLOPE,
    blend_rows,
    weigh_rows,
)

CHANNELS = 4  # channels that one walk of weighted_sums adds up

P1, P2, P3, P4, P5 = (np.uint64(PLANE * plane) for plane in range(1, 6))
SPARE = f4(0.02)  # rows beside those in which a Gaussian shows, for rounding


@kernel(part=True)
def new_batch():
    """Return a batch of Gaussians without effect: lanes that are not filled are calculated with, too."""
    batch = np.empty(PLANES * BATCH, np.float32)
    for i in range(batch.shape[0]):
        batch[i] = f4(1.0)
    return batch


@kernel
def _into_tile(x):
    """Clamp a column to those of a tile."""
    x = x if x < f4(TILE - 1) else f4(TILE - 1)
    return x if x > f4(0.0) else f4(0.0)


@kernel
def _tighten(batch):
    """Narrow first and last row of the Gaussians of a batch to where a column of the tile reaches the cut.

    With ``q`` the ln opacity above the cut, a Gaussian shows where ``decay y^2 + rate^2 (x - slope y)^2 <= q``. The
    highest point of this ellipse lies at ``y = sqrt(q / decay)``; where that is outside the tile, the ellipse is
    highest at the tile's column next to it.
    """
    for lane in range(BATCH):
        i = np.uint64(lane)
        mx, my, slope, decay = batch[i], batch[i + MY], batch[i + SLOPE], batch[i + DECAY]
        q = batch[i + LNOP] - LN_CUT
        q = q if q > f4(0.0) else f4(0.0)
        squared = batch[i + RATE] * batch[i + RATE]
        a = decay + squared * slope * slope
        reach = np.sqrt(q / decay)
        spare = SPARE + f4(1e-5) * reach
        right, left = _into_tile(mx + slope * reach) - mx, _into_tile(mx - slope * reach) - mx
        high = f4(1.00001) * a * q - decay * squared * right * right
        low = f4(1.00001) * a * q - decay * squared * left * left
        last = my + (squared * slope * right + np.sqrt(high if high > f4(0.0) else f4(0.0))) / a + spare
        first = my + (squared * slope * left - np.sqrt(low if low > f4(0.0) else f4(0.0))) / a - spare
        last = f4(-1.0) if high < f4(0.0) else np.floor(last)
        last = f4(-1.0) if low < f4(0.0) else last
        first = np.ceil(first)
        first = first if first < f4(TILE) else f4(TILE)
        batch[i + LAST] = last if last < batch[i + LAST] else batch[i + LAST]
        batch[i + FIRST] = first if first > batch[i + FIRST] else batch[i + FIRST]


@kernel(part=True)
def gather(footprints, members, first, last, end, tile_x, tile_y, batch):
    """Copy footprints into the batch, relative to the tile's first pixel centre, and call for the next batch's."""
    left, top = f4(tile_x) + f4(0.5), f4(tile_y) + f4(0.5)
    for i in range(first, last):
        k = np.uint64(members[i])
        j = np.uint64(i - first)
        batch[j] = footprints[k, 0] - left
        batch[j + MY] = footprints[k, 1] - top
        batch[j + RATE], batch[j + SLOPE] = footprints[k, 2], footprints[k, 3]
        batch[j + DECAY], batch[j + LNOP] = footprints[k, 4], footprints[k, 5]
        batch[j + FIRST] = footprints[k, 6] - f4(tile_y)
        batch[j + LAST] = footprints[k, 7] - f4(tile_y)
    _tighten(batch)
    for i in range(last, min(end, last + BATCH)):
        prefetch_row(footprints, members[i])


@kernel(part=True)
def batch_rows(batch, j, y_low, y_high):
    """First and last of the rows ``y_low`` to ``y_high`` in which Gaussian j of a batch shows."""
    i = np.uint64(j)
    return max(y_low, int(batch[i + FIRST])), min(y_high, int(batch[i + LAST]))


@kernel(part=True)
def gather_colors(colors, members, first, last, end, batch):
    """Copy colours into the batch and call for the next batch's."""
    for i in range(first, last):
        k = np.uint64(members[i])
        j = np.uint64(i - first)
        for c in range(3):
            batch[j + COLOR + np.uint64(BATCH * c)] = colors[k, c]
    for i in range(last, min(end, last + BATCH)):
        prefetch_row(colors, members[i])


@kernel(part=True)
def tile_box(tile, columns, height, width):
    """First column and row of a tile, and its columns and rows inside the image."""
    left, top = tile % columns * TILE, tile // columns * TILE
    return left, top, min(TILE, width - left), min(TILE, height - top)


@kernel(part=True)
def open_tile(state, columns, lines):
    """Reset the planes of a tile: all light passes, the others are zero; lanes outside the image have stopped."""
    for i in range(PLANE, state.shape[0]):
        state[i] = f4(0.0)
    for y in range(TILE):
        for x in range(TILE):
            state[y * TILE + x] = f4(1.0) if (x < columns) & (y < lines) else f4(-1.0)


@kernel
def _row_is_live(state, y):
    live = False
    for x in range(TILE):
        live |= state[y * TILE + x] > f4(0.0)
    return live


@kernel(part=True)
def live_rows(state, y_low, y_high):
    """Narrow the range of rows to those where a pixel still goes on."""
    while y_low <= y_high and not _row_is_live(state, y_low):
        y_low += 1
    while y_high >= y_low and not _row_is_live(state, y_high):
        y_high -= 1
    return y_low, y_high


@kernel
def blend(footprints, colors, members, offsets, columns, first, last, background, image, transmittance):
    """Blend a range of tiles over ``background [3]`` into ``image [h,w,3]`` and ``transmittance [h,w]``."""
    height, width = transmittance.shape
    state = np.empty(4 * PLANE, np.float32)
    batch = new_batch()
    for tile in range(first, last):
        left, top, num_x, num_y = tile_box(tile, columns, height, width)
        open_tile(state, num_x, num_y)
        y_low, y_high = 0, num_y - 1
        start, end = offsets[tile], offsets[tile + 1]
        while start < end and y_low <= y_high:
            stop = min(end, start + BATCH)
            gather(footprints, members, start, stop, end, left, top, batch)
            gather_colors(colors, members, start, stop, end, batch)
            for j in range(stop - start):
                blend_rows(state, batch, j, *batch_rows(batch, j, y_low, y_high))
            start = stop
            y_low, y_high = live_rows(state, y_low, y_high)
        for y in range(num_y):
            for x in range(num_x):
                i = np.uint64(y * TILE + x)
                t = abs(state[i])
                image[top + y, left + x, 0] = state[i + P1] + t * background[0]
                image[top + y, left + x, 1] = state[i + P2] + t * background[1]
                image[top + y, left + x, 2] = state[i + P3] + t * background[2]
                transmittance[top + y, left + x] = t


@kernel
def _sum_weights(state, batch, count, y_low, y_high, slots, start):
    """Per Gaussian of a batch: weights times planes 2 to 5, summed over the tile."""
    for j in range(count):
        y0, y1 = batch_rows(batch, j, y_low, y_high)
        weigh_rows(state, batch, j, y0, y1)
        s1, s2, s3, s4 = f4(0.0), f4(0.0), f4(0.0), f4(0.0)
        first = np.uint64(y0 * TILE)
        for x in range((y1 - y0 + 1) * TILE):
            i = first + np.uint64(x)
            w = state[i + P1]
            s1 += w * state[i + P2]
            s2 += w * state[i + P3]
            s3 += w * state[i + P4]
            s4 += w * state[i + P5]
        slots[start + j, 0], slots[start + j, 1], slots[start + j, 2], slots[start + j, 3] = s1, s2, s3, s4


@kernel
def weighted_sums(footprints, members, offsets, columns, first, last, image, slots):
    """Per intersection of a range of tiles: the weights times up to four channels of an image, summed.

    ``image [h,w,c]``, c <= CHANNELS; ``slots [intersections,CHANNELS]`` is written in the tiles' part.
    """
    height, width, channels = image.shape
    state = np.empty(6 * PLANE, np.float32)
    batch = new_batch()
    for tile in range(first, last):
        left, top, num_x, num_y = tile_box(tile, columns, height, width)
        open_tile(state, num_x, num_y)
        for y in range(num_y):
            for x in range(num_x):
                for c in range(channels):
                    state[(c + 2) * PLANE + y * TILE + x] = image[top + y, left + x, c]
        y_low, y_high = 0, num_y - 1
        start, end = offsets[tile], offsets[tile + 1]
        while start < end and y_low <= y_high:
            stop = min(end, start + BATCH)
            gather(footprints, members, start, stop, end, left, top, batch)
            _sum_weights(state, batch, stop - start, y_low, y_high, slots, start)
            start = stop
            y_low, y_high = live_rows(state, y_low, y_high)
        for i in range(start, end):
            for c in range(CHANNELS):
                slots[i, c] = f4(0.0)


@kernel
def add_slots(members, slots, ids, first, sums):
    """Add the intersections' ``slots [intersections,CHANNELS]`` to ``sums [n,c]`` from channel ``first`` on.

    They are added in the order of the lists.
    """
    num = min(CHANNELS, sums.shape[1] - first)
    last = members.shape[0] - 1
    for i in range(members.shape[0]):
        prefetch_row(sums, ids[members[min(i + BATCH, last)]])
        k = ids[members[i]]
        for c in range(num):
            sums[k, first + c] += slots[i, c]


@kernel
def _mass_and_peak(state, bits, batch, count, y_low, y_high, start, members, totals):
    """Add a batch's weights to the masses, raise the peaks. ``bits`` is ``state`` seen as integers."""
    for j in range(count):
        y0, y1 = batch_rows(batch, j, y_low, y_high)
        weigh_rows(state, batch, j, y0, y1)
        total, most = f4(0.0), np.int32(0)
        first = np.uint64(y0 * TILE)
        for x in range((y1 - y0 + 1) * TILE):
            i = first + np.uint64(x) + P1
            total += state[i]
            # as integers: floats that are not negative have the same order, and LLVM vectorises this maximum
            most = max(most, bits[i])
        bits[P2] = most
        k = np.uint64(members[start + j])
        totals[k, 0] += total
        totals[k, 1] = max(totals[k, 1], state[P2])


@kernel
def contributions(footprints, members, offsets, columns, height, width, totals):
    """Add every Gaussian's weights over the pixels to ``totals[:, 0]``; raise ``totals[:, 1]`` to the largest of them.

    ``totals [m,2]`` float32.
    """
    state = np.empty(3 * PLANE, np.float32)
    bits = state.view(np.int32)
    batch = new_batch()
    for tile in range(offsets.shape[0] - 1):
        left, top, num_x, num_y = tile_box(tile, columns, height, width)
        open_tile(state, num_x, num_y)
        y_low, y_high = 0, num_y - 1
        start, end = offsets[tile], offsets[tile + 1]
        while start < end and y_low <= y_high:
            stop = min(end, start + BATCH)
            gather(footprints, members, start, stop, end, left, top, batch)
            for i in range(start, stop):
                prefetch_row(totals, members[i])
            _mass_and_peak(state, bits, batch, stop - start, y_low, y_high, start, members, totals)
            start = stop
            y_low, y_high = live_rows(state, y_low, y_high)
