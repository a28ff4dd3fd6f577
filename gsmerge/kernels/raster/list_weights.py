"""The blending weights of one view, written out: one (pixel, weight) entry after the other."""

from __future__ import annotations

import numpy as np
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel
from gsmerge.kernels.raster.blend import P1, batch_rows, gather, live_rows, new_batch, open_tile, tile_box
from gsmerge.kernels.raster.project import LN_CUT, TILE
from gsmerge.kernels.raster.walk import BATCH, DECAY, LNOP, PLANE, RATE, SLOPE, weigh_rows

LANES = 4  # channels of an image row: one vector register


@kernel(part=True)
def batch_columns(batch, j, width):
    """First and last column of the tile that a Gaussian of the batch can touch."""
    i = np.uint64(j)
    mx, rate, slope, decay, lnop = batch[i], batch[i + RATE], batch[i + SLOPE], batch[i + DECAY], batch[i + LNOP]
    reach = np.sqrt(max(lnop - LN_CUT, f4(0.0)) * (f4(1.0) / (rate * rate) + slope * slope / decay)) + f4(0.01)
    return int(max(mx - reach, f4(0.0))), int(min(mx + reach, f4(width - 1)))


@kernel
def _grown(lanes, weights, count):
    """Buffers of twice the size with the same entries."""
    more_lanes, more_weights = np.empty(2 * lanes.shape[0], np.uint8), np.empty(2 * lanes.shape[0], np.float32)
    more_lanes[:count], more_weights[:count] = lanes[:count], weights[:count]
    return more_lanes, more_weights


@kernel
def list_weights(footprints, members, offsets, columns, height, width):
    """All weights of a view that are not zero.

    Returns:
        ``starts [intersections + 1]`` int64, ``lanes`` uint8 (pixel within its tile, row-major), ``weights`` float32.
    """
    starts = np.zeros(members.shape[0] + 1, np.int64)
    lanes = np.empty(max(BATCH * PLANE, 40 * height * width), np.uint8)
    weights = np.empty(lanes.shape[0], np.float32)
    state, batch = np.empty(2 * PLANE, np.float32), new_batch()
    count = 0
    for tile in range(offsets.shape[0] - 1):
        left, top, num_x, num_y = tile_box(tile, columns, height, width)
        open_tile(state, num_x, num_y)
        y_low, y_high = 0, num_y - 1
        start, end = offsets[tile], offsets[tile + 1]
        while start < end and y_low <= y_high:
            stop = min(end, start + BATCH)
            gather(footprints, members, start, stop, end, left, top, batch)
            if count + BATCH * PLANE > lanes.shape[0]:
                lanes, weights = _grown(lanes, weights, count)
            for j in range(stop - start):
                y0, y1 = batch_rows(batch, j, y_low, y_high)
                weigh_rows(state, batch, j, y0, y1)
                x0, x1 = batch_columns(batch, j, num_x)
                for y in range(y0, y1 + 1):
                    for x in range(x0, x1 + 1):
                        lane = np.uint64(y * TILE + x)
                        w = state[lane + P1]
                        lanes[np.uint64(count)] = lane
                        weights[np.uint64(count)] = w
                        count += 1 if w > f4(0.0) else 0
                starts[start + j + 1] = count
            start = stop
            y_low, y_high = live_rows(state, y_low, y_high)
        starts[start + 1 : end + 1] = count
    return starts, lanes[:count].copy(), weights[:count].copy()


@kernel
def spread(starts, lanes, weights, members, offsets, columns, colors, image):
    """Sums of weights times ``colors [m,LANES]`` -> ``image [h,w,LANES]``, every pixel of it."""
    height, width = image.shape[:2]
    state = np.empty((PLANE, LANES), np.float32)
    for tile in range(offsets.shape[0] - 1):
        state[:] = f4(0.0)
        for i in range(offsets[tile], offsets[tile + 1]):
            k = np.uint64(members[i])
            a, b, c, d = colors[k, 0], colors[k, 1], colors[k, 2], colors[k, 3]
            for e in range(starts[i], starts[i + 1]):
                p, w = np.uint64(lanes[e]), weights[e]
                state[p, 0] += w * a
                state[p, 1] += w * b
                state[p, 2] += w * c
                state[p, 3] += w * d
        left, top, num_x, num_y = tile_box(tile, columns, height, width)
        for y in range(num_y):
            for x in range(num_x):
                image[top + y, left + x] = state[y * TILE + x]


@kernel
def collect(starts, lanes, weights, members, offsets, columns, image, sums):
    """Add weights times ``image [h,w,LANES]`` to ``sums [m,LANES]`` float64."""
    height, width = image.shape[:2]
    state = np.zeros((PLANE, LANES), np.float32)
    for tile in range(offsets.shape[0] - 1):
        left, top, num_x, num_y = tile_box(tile, columns, height, width)
        for y in range(num_y):
            for x in range(num_x):
                state[y * TILE + x] = image[top + y, left + x]
        for i in range(offsets[tile], offsets[tile + 1]):
            a, b, c, d = f4(0.0), f4(0.0), f4(0.0), f4(0.0)
            for e in range(starts[i], starts[i + 1]):
                p, w = np.uint64(lanes[e]), weights[e]
                a += w * state[p, 0]
                b += w * state[p, 1]
                c += w * state[p, 2]
                d += w * state[p, 3]
            k = members[i]
            sums[k, 0] += a
            sums[k, 1] += b
            sums[k, 2] += c
            sums[k, 3] += d
