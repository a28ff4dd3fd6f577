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
    _gather_colors,
    _live_rows,
    _open_tile,
    _tile_box,
)
from gsmerge.kernels.raster.lanes import FLOAT, LANES, VECTOR, Lanes, load, negative, store, total, totals, vector
from gsmerge.kernels.raster.prefetch import prefetch_row
from gsmerge.kernels.raster.project import LN_CUT, TILE

# Numbers per Gaussian: the sums of w g (3), of v = d loss / d exponent, and of v times x, y, xx, xy, yy, where x, y
# is the pixel less the Gaussian's mean.
SUMS = 9
STATE = 5 * PLANE  # transmittance, rest, gradient of the colour (3)


def _take_back(t: Lanes, rest: Lanes, g: list[Lanes], color: list[Lanes], p: Lanes) -> list[Lanes]:
    """A Gaussian's share of sixteen pixels: transmittance and rest behind it, its weights, and v.

    The weights are those of :func:`gsmerge.kernels.raster.blend._take`.
    """
    e = E0 + p * (E1 + p * (E2 + p * (E3 + p * (E4 + p * E5))))
    e = e * e
    e = e * e
    e = e * e
    free = e.compare("<", MAX_ALPHA)
    a = e.where(free, MAX_ALPHA).where(p.compare(">=", LN_CUT), 0.0)
    w = a * t
    left = t - w
    goes = left.compare(">", MIN_TRANSMITTANCE)
    w = w.where(goes, 0.0)
    own = w * (color[0] * g[0] + color[1] * g[1] + color[2] * g[2])
    rest = rest - own
    v = own - a * rest / (1.0 - a)
    return [left.where(goes, negative(t)), rest, w, v.where(free, 0.0).where(goes, 0.0)]


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

        member, first, last, slot = (
            context.cast(builder, arguments[i], signature.args[i], types.intp) for i in (2, 3, 4, 6)
        )
        mx, my, rate, slope, decay, lnop, _, _, *color = (
            Lanes(builder, builder.load(address(1, member, index(q)))) for q in range(11)
        )
        columns = vector(builder, range(LANES))
        sums = [cgutils.alloca_once(builder, VECTOR) for _ in range(6)]
        for pointer in sums:
            builder.store(vector(builder, [0.0] * LANES).value, pointer)
        end = builder.add(last, index(1))
        with cgutils.for_range_slice(builder, first, end, index(1), first.type, inc=True) as (y, _):
            start = builder.mul(y, index(TILE))
            planes = [address(0, builder.add(start, index(PLANE * plane))) for plane in range(5)]
            t, rest, *g = (load(builder, plane) for plane in planes)
            dy = Lanes(builder, builder.sitofp(y, FLOAT)) - my
            d = rate * columns - rate * (mx + slope * dy)
            left, rest, w, v = _take_back(t, rest, g, color, (lnop - decay * dy * dy) - d * d)
            store(left, planes[0])
            store(rest, planes[1])
            vy = v * dy
            for pointer, more in zip(sums, (w * g[0], w * g[1], w * g[2], v, vy, vy * dy), strict=True):
                builder.store((Lanes(builder, builder.load(pointer)) + more).value, pointer)
        # x is the same in all rows of a lane, so its moments wait until here
        red, green, blue, v, vy, vyy = (Lanes(builder, builder.load(pointer)) for pointer in sums)
        dx = columns - mx
        vx = v * dx
        store(totals([red, green, blue, v, vx, vy, vx * dx, vy * dx]), address(5, slot, index(0)))
        builder.store(total(vyy).value, address(5, slot, index(8)))
        return context.get_dummy_value()

    return types.void(state, batch, j, y0, y1, slots, row), generate


@kernel
def _open_back(state, left, top, columns, lines, image, transmittance, grad_image, grad_left):
    """The planes of a tile before its first Gaussian."""
    _open_tile(state, columns, lines)
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
    batch = np.empty((BATCH, 12), np.float32)
    for tile in range(first, last):
        left, top, num_x, num_y = _tile_box(tile, columns, height, width)
        _open_back(state, left, top, num_x, num_y, image, transmittance, grad_image, grad_left)
        y_low, y_high = 0, num_y - 1
        start, end = offsets[tile], offsets[tile + 1]
        while start < end and y_low <= y_high:
            stop = min(end, start + BATCH)
            _gather(footprints, members, start, stop, end, left, top, batch)
            _gather_colors(colors, members, start, stop, end, batch)
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
    """Add the ``slots [intersections,SUMS]`` of some Gaussians to ``sums [m,SUMS]``, in the order of the lists."""
    num = members.shape[0]
    for i in range(num):
        k = members[i]
        prefetch_row(sums, members[min(i + BATCH, num - 1)])
        if (k >= first) & (k < last):
            for c in range(SUMS):
                sums[k, c] += slots[i, c]
