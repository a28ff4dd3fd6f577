"""The backward pass of blending: what a loss wants of every Gaussian's footprint and colour.

The tiles are walked front to back again, with the weights of :mod:`gsmerge.kernels.raster.blend`. With ``g`` the
gradient of a pixel's colour and ``h`` that of its transmittance, a pixel starts with the whole ``rest = g.C + h T``
(``C`` its final colour, ``T`` its final transmittance); every Gaussian takes its ``w (g.c)`` away, so what is left is
what lies behind it, and

    d loss / d ln alpha = w (g.c) - alpha / (1 - alpha) rest

needs no list of what was blended and no division of transmittances. Sums over a tile go to one row per intersection
and are then added up in the order of the lists: nothing is shared between threads, and no result depends on them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel
from gsmerge.kernels.raster.blend import (
    P1,
    batch_rows,
    gather,
    gather_colors,
    live_rows,
    new_batch,
    open_tile,
    tile_box,
)
from gsmerge.kernels.raster.lanes import LANES, VECTOR, Lanes, load, prefetch_row, store, total, totals, vector
from gsmerge.kernels.raster.project import TILE
from gsmerge.kernels.raster.walk import BATCH, PLANE, Walk, take_share

# Numbers per Gaussian: the sums of w g (3), of v = d loss / d exponent, and of v times x, y, xx, xy, yy, where x, y
# is the pixel less the Gaussian's mean.
SUMS = 9
STATE = 5 * PLANE  # transmittance, rest, gradient of the colour (3)


@intrinsic
def _walk_back(typing_context: Any, state: Any, batch: Any, j: Any, y0: Any, y1: Any, slots: Any, row: Any) -> Any:
    """Take Gaussian j of a batch off the pixels of rows y0 to y1 and write what they want of it to a row of slots."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        walk = Walk(context, builder, signature, arguments)
        sums = [cgutils.alloca_once(builder, VECTOR) for _ in range(6)]
        for pointer in sums:
            builder.store(vector(builder, [0.0] * LANES).value, pointer)
        with walk.rows(5) as (planes, dy, p):
            t, rest, *g = (load(builder, plane) for plane in planes)
            share = take_share(t, p)
            own = share.weight * (walk.color[0] * g[0] + walk.color[1] * g[1] + walk.color[2] * g[2])
            rest = rest - own
            v = own - share.alpha * rest / (1.0 - share.alpha)
            v = v.where(share.free, 0.0).where(share.goes, 0.0)
            store(share.left, planes[0])
            store(rest, planes[1])
            w, vy = share.weight, v * dy
            for pointer, more in zip(sums, (w * g[0], w * g[1], w * g[2], v, vy, vy * dy), strict=True):
                builder.store((Lanes(builder, builder.load(pointer)) + more).value, pointer)
        # x is the same in all rows of a lane, so its moments wait until here
        red, green, blue, v, vy, vyy = (Lanes(builder, builder.load(pointer)) for pointer in sums)
        dx, slot = walk.columns - walk.mx, walk.whole(6)
        vx = v * dx
        store(totals([red, green, blue, v, vx, vy, vx * dx, vy * dx]), walk.address(5, slot, walk.index(0)))
        builder.store(total(vyy).value, walk.address(5, slot, walk.index(8)))
        return context.get_dummy_value()

    return types.void(state, batch, j, y0, y1, slots, row), generate


@kernel
def _open_back(state, left, top, columns, lines, image, transmittance, grad_image, grad_left):
    """The planes of a tile before its first Gaussian."""
    open_tile(state, columns, lines)
    for y in range(lines):
        for x in range(columns):
            i = np.uint64(y * TILE + x)
            rest = f4(0.0)
            if grad_left.shape[0] > 0:
                rest = grad_left[top + y, left + x] * transmittance[top + y, left + x]
            for c in range(3):
                g = grad_image[top + y, left + x, c]
                state[i + np.uint64((2 + c) * PLANE)] = g
                rest += g * image[top + y, left + x, c]
            state[i + P1] = rest


@kernel
def blend_backward(
    footprints, colors, members, offsets, columns, first, last, image, transmittance, grad_image, grad_left, slots
):
    """Gradient sums of a range of tiles, one row per intersection.

    Args:
        image: ``[h,w,3]`` float32, the blended image, background included.
        transmittance: ``[h,w]`` float32, what is left of it.
        grad_image: ``[h,w,3]`` float32, gradient with respect to ``image``.
        grad_left: ``[h,w]`` float32, gradient with respect to ``transmittance``; an empty array for none.
        slots: ``[intersections,SUMS]`` float32, written in the tiles' part.
    """
    height, width = transmittance.shape
    state = np.empty(STATE, np.float32)
    batch = new_batch()
    for tile in range(first, last):
        left, top, num_x, num_y = tile_box(tile, columns, height, width)
        _open_back(state, left, top, num_x, num_y, image, transmittance, grad_image, grad_left)
        y_low, y_high = 0, num_y - 1
        start, end = offsets[tile], offsets[tile + 1]
        while start < end and y_low <= y_high:
            stop = min(end, start + BATCH)
            gather(footprints, members, start, stop, end, left, top, batch)
            gather_colors(colors, members, start, stop, end, batch)
            for j in range(stop - start):
                _walk_back(state, batch, j, *batch_rows(batch, j, y_low, y_high), slots, start + j)
            start = stop
            y_low, y_high = live_rows(state, y_low, y_high)
        for i in range(start, end):
            for c in range(SUMS):
                slots[i, c] = f4(0.0)


@kernel
def gather_slots(members, slots, first, last, sums):
    """Add the ``slots [intersections,SUMS]`` of some Gaussians to ``sums [m,SUMS]``, in the order of the lists."""
    num = members.shape[0]
    for i in range(num):
        k = members[i]
        prefetch_row(sums, members[min(i + BATCH, num - 1)])
        if (k >= first) & (k < last):
            for c in range(SUMS):
                sums[k, c] += slots[i, c]
