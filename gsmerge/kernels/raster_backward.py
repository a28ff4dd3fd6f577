"""The backward pass of blending: what a loss wants of every Gaussian's footprint and colour.

The tiles are walked front to back again, with the weights of :mod:`gsmerge.kernels.raster`. With ``g`` the gradient
of a pixel's colour and ``h`` that of its transmittance, a pixel starts with the whole ``rest = g.C + h T`` (``C`` its
final colour, ``T`` its final transmittance); every Gaussian takes its ``w (g.c)`` away, so what is left is what lies
behind it, and

    d loss / d ln alpha = w (g.c) - alpha / (1 - alpha) rest

needs no list of what was blended and no division of transmittances. Sums over a tile go to one row per intersection
and are then added up in the order of the lists: nothing is shared between threads, and no result depends on them.
"""

from __future__ import annotations

import numpy as np
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel
from gsmerge.kernels.prefetch import prefetch_row
from gsmerge.kernels.project import TILE
from gsmerge.kernels.raster import (
    BATCH,
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    P1,
    P2,
    P3,
    P4,
    P5,
    PLANE,
    _alpha,
    _gather,
    _live_rows,
    _open_tile,
)

# Numbers per Gaussian: the sums of w g (3), of v = d loss / d exponent, and of v times x, y, xx, xy, yy, where x, y
# is the pixel less the Gaussian's mean.
SUMS = 9
P6 = np.uint64(6 * PLANE)


@kernel
def _walk_back(state, batch, j, y0, y1, slots, row):
    """Take one Gaussian off the pixels of rows y0 to y1 and sum up what they want of it."""
    mx, my, rate, slope, decay, lnop = batch[j, 0], batch[j, 1], batch[j, 2], batch[j, 3], batch[j, 4], batch[j, 5]
    red, green, blue = batch[j, 8], batch[j, 9], batch[j, 10]
    s0, s1, s2, s3, s4 = f4(0.0), f4(0.0), f4(0.0), f4(0.0), f4(0.0)
    s5, s6, s7, s8 = f4(0.0), f4(0.0), f4(0.0), f4(0.0)
    first = np.uint64(y0 * TILE)
    for lane in range((y1 - y0 + 1) * TILE):
        i = first + np.uint64(lane)
        dx, dy = state[i + P5] - mx, state[i + P6] - my
        d = rate * (dx - slope * dy)
        a = _alpha(lnop - decay * dy * dy - d * d)
        t = state[i]
        w = a * t
        left = t - w
        stop = left <= MIN_TRANSMITTANCE
        w = f4(0.0) if stop else w
        state[i] = -abs(t) if stop else left
        g0, g1, g2 = state[i + P2], state[i + P3], state[i + P4]
        own = w * (red * g0 + green * g1 + blue * g2)
        rest = state[i + P1] - own
        state[i + P1] = rest
        v = own - a * rest / (f4(1.0) - a)
        v = v if a < MAX_ALPHA else f4(0.0)
        v = f4(0.0) if stop else v
        s0 += w * g0
        s1 += w * g1
        s2 += w * g2
        vx, vy = v * dx, v * dy
        s3 += v
        s4 += vx
        s5 += vy
        s6 += vx * dx
        s7 += vx * dy
        s8 += vy * dy
    slots[row, 0], slots[row, 1], slots[row, 2] = s0, s1, s2
    slots[row, 3], slots[row, 4], slots[row, 5] = s3, s4, s5
    slots[row, 6], slots[row, 7], slots[row, 8] = s6, s7, s8


@kernel
def blend_backward(
    footprints, colors, members, offsets, columns, first, last, image, transmittance, grad_image, grad_left, slots
):
    """Gradient sums of a range of tiles, one row per intersection.

    Args:
        footprints: ``[m,FOOTPRINT]`` float32.
        colors: ``[m,3]`` float32.
        members: ``[intersections]`` int32 tile lists.
        offsets: ``[tiles + 1]`` int64 starts of the lists.
        columns: Tiles per row.
        first: First tile.
        last: Last tile, exclusive.
        image: ``[h,w,3]`` float32, the blended image, background included.
        transmittance: ``[h,w]`` float32, what is left of it.
        grad_image: ``[h,w,3]`` float32, gradient with respect to ``image``.
        grad_left: ``[h,w]`` float32, gradient with respect to ``transmittance``; an empty array for none.
        slots: ``[intersections,SUMS]`` float32, written in the tiles' part.
    """
    height, width = transmittance.shape
    state = np.empty(7 * PLANE, np.float32)
    batch = np.empty((BATCH, 12), np.float32)
    for tile in range(first, last):
        left, top = tile % columns * TILE, tile // columns * TILE
        num_x, num_y = min(TILE, width - left), min(TILE, height - top)
        _open_tile(state, num_x, num_y)
        for y in range(TILE):
            for x in range(TILE):
                i = np.uint64(y * TILE + x)
                state[i + P5], state[i + P6] = f4(x), f4(y)
        for y in range(num_y):
            for x in range(num_x):
                i = np.uint64(y * TILE + x)
                rest = f4(0.0)
                if grad_left.shape[0] > 0:
                    rest = grad_left[top + y, left + x] * transmittance[top + y, left + x]
                for c in range(3):
                    g = grad_image[top + y, left + x, c]
                    state[i + np.uint64((2 + c) * PLANE)] = g
                    rest += g * image[top + y, left + x, c]
                state[i + P1] = rest
        y_low, y_high = 0, num_y - 1
        start, end = offsets[tile], offsets[tile + 1]
        while start < end and y_low <= y_high:
            stop = min(end, start + BATCH)
            _gather(footprints, members, start, stop, end, left, top, batch)
            for i in range(start, stop):
                k = np.uint64(members[i])
                j = np.uint64(i - start)
                batch[j, 8], batch[j, 9], batch[j, 10] = colors[k, 0], colors[k, 1], colors[k, 2]
            for i in range(stop, min(end, stop + BATCH)):
                prefetch_row(colors, members[i])
            for j in range(stop - start):
                y0, y1 = max(y_low, int(batch[j, 6])), min(y_high, int(batch[j, 7]))
                _walk_back(state, batch, j, y0, y1, slots, start + j)
            start = stop
            y_low, y_high = _live_rows(state, y_low, y_high)
        for i in range(start, end):
            for c in range(SUMS):
                slots[i, c] = f4(0.0)


@kernel
def gather_slots(members, slots, first, last, sums):
    """Add up the rows of the Gaussians first to last, in the order of the lists.

    Args:
        members: ``[intersections]`` int32.
        slots: ``[intersections,SUMS]`` float32.
        first: First Gaussian.
        last: Last Gaussian, exclusive.
        sums: ``[m,SUMS]`` float32, added to.
    """
    num = members.shape[0]
    for i in range(num):
        k = members[i]
        prefetch_row(sums, members[min(i + BATCH, num - 1)])
        if (k >= first) & (k < last):
            for c in range(SUMS):
                sums[k, c] += slots[i, c]
