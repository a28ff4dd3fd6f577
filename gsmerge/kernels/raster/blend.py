"""Front-to-back blending of one view, tile by tile, and sums over its blending weights.

All kernels here walk the same lists with the same weights: alpha clamped at 0.99, cut below 1/255, and a pixel
stops before the Gaussian that would take its transmittance to 1e-4 or below (gsplat's rules).

A tile's state lives in one flat buffer of 16 x 16 planes with constant offsets: with a single base pointer the
16-wide inner loop needs no run-time alias checks and becomes straight vector code. Plane 0 is the transmittance;
its sign bit marks pixels that have stopped. Gaussians are gathered 32 at a time into a small local array.
"""

from __future__ import annotations

import numpy as np
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel
from gsmerge.kernels.raster.prefetch import prefetch_row
from gsmerge.kernels.raster.project import LN_CUT, TILE

PLANE = TILE * TILE
BATCH = 32
MAX_ALPHA, MIN_TRANSMITTANCE = f4(0.99), f4(1e-4)
CHANNELS = 4  # channels that one walk of weighted_sums adds up

P1, P2, P3, P4, P5 = (np.uint64(PLANE * plane) for plane in range(1, 6))

# exp(p) = poly(p)^8 on [ln(1/255), 0]: minimax of relative error 8e-8 for exp(p / 8), coefficients scaled by 8^-k.
E0, E1, E2 = f4(0.99999992), f4(0.12499907), f4(0.0078106653)
E3, E4, E5 = f4(3.2416797e-4), f4(9.7100983e-6), f4(1.7842896e-7)


@kernel(inline=True)
def _alpha(p):
    """Opacity of a pixel from its exponent: exp, clamp and cut; any p <= 0 is safe, far ones are cut."""
    e = E0 + p * (E1 + p * (E2 + p * (E3 + p * (E4 + p * E5))))
    e = e * e
    e = e * e
    e = e * e
    a = e if e < MAX_ALPHA else MAX_ALPHA
    return a if p >= LN_CUT else f4(0.0)


@kernel(inline=True)
def _take(t, p):
    """A pixel's weight at exponent p, and what is left of its transmittance t; stopped pixels keep a negative one."""
    w = _alpha(p) * t
    left = t - w
    stop = left <= MIN_TRANSMITTANCE
    return f4(0.0) if stop else w, -abs(t) if stop else left


@kernel
def _gather(footprints, members, first, last, end, tile_x, tile_y, batch):
    """Copy footprints into the batch, relative to the tile's first pixel centre, and call for the next batch's."""
    left, top = f4(tile_x) + f4(0.5), f4(tile_y) + f4(0.5)
    for i in range(first, last):
        k = np.uint64(members[i])
        j = np.uint64(i - first)
        batch[j, 0] = footprints[k, 0] - left
        batch[j, 1] = footprints[k, 1] - top
        for q in range(2, 6):
            batch[j, q] = footprints[k, q]
        batch[j, 6] = footprints[k, 6] - f4(tile_y)
        batch[j, 7] = footprints[k, 7] - f4(tile_y)
    for i in range(last, min(end, last + BATCH)):
        prefetch_row(footprints, members[i])


@kernel
def _gather_colors(colors, members, first, last, end, batch):
    """Copy colours into the batch and call for the next batch's."""
    for i in range(first, last):
        k = np.uint64(members[i])
        j = np.uint64(i - first)
        batch[j, 8], batch[j, 9], batch[j, 10] = colors[k, 0], colors[k, 1], colors[k, 2]
    for i in range(last, min(end, last + BATCH)):
        prefetch_row(colors, members[i])


@kernel
def _tile_box(tile, columns, height, width):
    """First column and row of a tile, and its columns and rows inside the image."""
    left, top = tile % columns * TILE, tile // columns * TILE
    return left, top, min(TILE, width - left), min(TILE, height - top)


@kernel
def _open_tile(state, columns, lines):
    """All light passes, the other planes are zero; lanes outside the image have stopped."""
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


@kernel
def _live_rows(state, y_low, y_high):
    """Narrow the range of rows to those where a pixel still goes on."""
    while y_low <= y_high and not _row_is_live(state, y_low):
        y_low += 1
    while y_high >= y_low and not _row_is_live(state, y_high):
        y_high -= 1
    return y_low, y_high


@kernel
def _blend(state, batch, count, y_low, y_high):
    """Blend a batch over the live rows of a tile; planes 1 to 3 collect the colour."""
    for j in range(count):
        y0, y1 = max(y_low, int(batch[j, 6])), min(y_high, int(batch[j, 7]))
        mx, my, rate, slope, decay, lnop = batch[j, 0], batch[j, 1], batch[j, 2], batch[j, 3], batch[j, 4], batch[j, 5]
        red, green, blue = batch[j, 8], batch[j, 9], batch[j, 10]
        for y in range(y0, y1 + 1):
            dy = f4(y) - my
            top = lnop - decay * dy * dy
            centre = rate * (mx + slope * dy)
            row = np.uint64(y * TILE)
            for x in range(TILE):
                i = row + np.uint64(x)
                d = rate * f4(x) - centre
                w, state[i] = _take(state[i], top - d * d)
                state[i + P1] += w * red
                state[i + P2] += w * green
                state[i + P3] += w * blue


@kernel
def blend(footprints, colors, members, offsets, columns, first, last, background, image, transmittance):
    """Blend a range of tiles over ``background [3]`` into ``image [h,w,3]`` and ``transmittance [h,w]``."""
    height, width = transmittance.shape
    state = np.empty(4 * PLANE, np.float32)
    batch = np.empty((BATCH, 12), np.float32)
    for tile in range(first, last):
        left, top, num_x, num_y = _tile_box(tile, columns, height, width)
        _open_tile(state, num_x, num_y)
        y_low, y_high = 0, num_y - 1
        start, end = offsets[tile], offsets[tile + 1]
        while start < end and y_low <= y_high:
            stop = min(end, start + BATCH)
            _gather(footprints, members, start, stop, end, left, top, batch)
            _gather_colors(colors, members, start, stop, end, batch)
            _blend(state, batch, stop - start, y_low, y_high)
            start = stop
            y_low, y_high = _live_rows(state, y_low, y_high)
        for y in range(num_y):
            for x in range(num_x):
                i = np.uint64(y * TILE + x)
                t = abs(state[i])
                image[top + y, left + x, 0] = state[i + P1] + t * background[0]
                image[top + y, left + x, 1] = state[i + P2] + t * background[1]
                image[top + y, left + x, 2] = state[i + P3] + t * background[2]
                transmittance[top + y, left + x] = t


@kernel(inline=True)
def _weights(state, batch, j, y0, y1):
    """Blend one Gaussian over rows y0 to y1 of a tile; plane 1 receives its weights."""
    mx, my, rate, slope, decay, lnop = batch[j, 0], batch[j, 1], batch[j, 2], batch[j, 3], batch[j, 4], batch[j, 5]
    for y in range(y0, y1 + 1):
        dy = f4(y) - my
        top = lnop - decay * dy * dy
        centre = rate * (mx + slope * dy)
        row = np.uint64(y * TILE)
        for x in range(TILE):
            i = row + np.uint64(x)
            d = rate * f4(x) - centre
            state[i + P1], state[i] = _take(state[i], top - d * d)


@kernel
def _sum_weights(state, batch, count, y_low, y_high, slots, start):
    """Per Gaussian of a batch: weights times planes 2 to 5, summed over the tile."""
    for j in range(count):
        y0, y1 = max(y_low, int(batch[j, 6])), min(y_high, int(batch[j, 7]))
        _weights(state, batch, j, y0, y1)
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
    batch = np.empty((BATCH, 12), np.float32)
    for tile in range(first, last):
        left, top, num_x, num_y = _tile_box(tile, columns, height, width)
        _open_tile(state, num_x, num_y)
        for y in range(num_y):
            for x in range(num_x):
                for c in range(channels):
                    state[(c + 2) * PLANE + y * TILE + x] = image[top + y, left + x, c]
        y_low, y_high = 0, num_y - 1
        start, end = offsets[tile], offsets[tile + 1]
        while start < end and y_low <= y_high:
            stop = min(end, start + BATCH)
            _gather(footprints, members, start, stop, end, left, top, batch)
            _sum_weights(state, batch, stop - start, y_low, y_high, slots, start)
            start = stop
            y_low, y_high = _live_rows(state, y_low, y_high)
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
        y0, y1 = max(y_low, int(batch[j, 6])), min(y_high, int(batch[j, 7]))
        _weights(state, batch, j, y0, y1)
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
    batch = np.empty((BATCH, 12), np.float32)
    for tile in range(offsets.shape[0] - 1):
        left, top, num_x, num_y = _tile_box(tile, columns, height, width)
        _open_tile(state, num_x, num_y)
        y_low, y_high = 0, num_y - 1
        start, end = offsets[tile], offsets[tile + 1]
        while start < end and y_low <= y_high:
            stop = min(end, start + BATCH)
            _gather(footprints, members, start, stop, end, left, top, batch)
            for i in range(start, stop):
                prefetch_row(totals, members[i])
            _mass_and_peak(state, bits, batch, stop - start, y_low, y_high, start, members, totals)
            start = stop
            y_low, y_high = _live_rows(state, y_low, y_high)
