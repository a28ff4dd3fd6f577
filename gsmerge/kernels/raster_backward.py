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

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy import float32 as f4

from gsmerge.kernels.jit import kernel
from gsmerge.kernels.lanes import FLOAT, LANES, VECTOR, Lanes, load, stopped, store, total, totals, vector
from gsmerge.kernels.prefetch import prefetch_row
from gsmerge.kernels.project import LN_CUT, TILE
from gsmerge.kernels.raster import (
    BATCH,
    E0,
    E1,
    E2,
    E3,
    E4,
    E5,
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    P1,
    PLANE,
    _gather,
    _live_rows,
    _open_tile,
)

# Numbers per Gaussian: the sums of w g (3), of v = d loss / d exponent, and of v times x, y, xx, xy, yy, where x, y
# is the pixel less the Gaussian's mean.
SUMS = 9
STATE = 5 * PLANE  # transmittance, rest, gradient of the colour (3)


def _alpha_lanes(p: Lanes) -> Lanes:
    """As :func:`gsmerge.kernels.raster._alpha`, but neither clamped nor cut."""
    e = E0 + p * (E1 + p * (E2 + p * (E3 + p * (E4 + p * E5))))
    e = e * e
    e = e * e
    return e * e


@intrinsic
def _walk_back(typing_context: Any, state: Any, batch: Any, j: Any, y0: Any, y1: Any, slots: Any, row: Any) -> Any:
    """Take Gaussian j of a batch off the pixels of rows y0 to y1 and write what they want of it to a row of slots."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def address(position: int, *indices: Any) -> Any:
            kind = signature.args[position]
            array = context.make_array(kind)(context, builder, arguments[position])
            return cgutils.get_item_pointer(context, builder, kind, array, indices, wraparound=False)

        def index(number: int) -> Any:
            return context.get_constant(types.intp, number)

        first, last, member, slot = (
            context.cast(builder, arguments[i], signature.args[i], types.intp) for i in (3, 4, 2, 6)
        )
        mx, my, rate, slope, decay, lnop, _, _, red, green, blue = (
            Lanes(builder, builder.load(address(1, member, index(q)))) for q in range(11)
        )
        columns = vector(builder, range(LANES))
        stretched = rate * columns
        names = ("red", "green", "blue", "v", "vy", "vyy")
        sums = {name: cgutils.alloca_once(builder, VECTOR) for name in names}
        for pointer in sums.values():
            builder.store(ir.Constant(VECTOR, [0.0] * LANES), pointer)

        with cgutils.for_range_slice(
            builder, first, builder.add(last, index(1)), index(1), first.type, inc=True
        ) as (y, _):
            dy = Lanes(builder, builder.sitofp(y, FLOAT)) - my
            start = builder.mul(y, index(TILE))
            planes = [address(0, builder.add(start, index(PLANE * plane))) for plane in range(5)]
            t, rest, *g = (load(builder, plane) for plane in planes)
            d = stretched - rate * (mx + slope * dy)
            p = (lnop - decay * dy * dy) - d * d
            a = _alpha_lanes(p)
            free = a.compare("<", MAX_ALPHA)
            a = a.where(free, MAX_ALPHA)
            a = a.where(p.compare(">=", LN_CUT), 0.0)
            w = a * t
            left = t - w
            goes = left.compare(">", MIN_TRANSMITTANCE)
            w = w.where(goes, 0.0)
            store(left.where(goes, stopped(t)), planes[0])
            own = w * (red * g[0] + green * g[1] + blue * g[2])
            rest = rest - own
            store(rest, planes[1])
            v = own - a * rest / (1.0 - a)
            v = v.where(builder.and_(free, goes), 0.0)
            vy = v * dy
            for name, lanes in zip(names, (w * g[0], w * g[1], w * g[2], v, vy, vy * dy), strict=True):
                builder.store((Lanes(builder, builder.load(sums[name])) + lanes).value, sums[name])

        red, green, blue, v, vy, vyy = (Lanes(builder, builder.load(sums[name])) for name in names)
        dx = columns - mx
        vx = v * dx
        store(totals([red, green, blue, v, vx, vy, vx * dx, vy * dx]), address(5, slot, index(0)))
        builder.store(total(vyy).value, address(5, slot, index(8)))
        return context.get_dummy_value()

    return types.void(state, batch, j, y0, y1, slots, row), generate


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
    state = np.empty(STATE, np.float32)
    batch = np.empty((BATCH, 12), np.float32)
    for tile in range(first, last):
        left, top = tile % columns * TILE, tile // columns * TILE
        num_x, num_y = min(TILE, width - left), min(TILE, height - top)
        _open_tile(state, num_x, num_y)
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
