"""Quickselect of an order, for medians and k-d trees."""

from __future__ import annotations

from gsmerge.kernels.jit import kernel


@kernel(part=True)
def partition(values, order, low, high, place):
    """Reorder a run of an order so that one place holds the value that sorting would put there.

    No value before the place is above it, and none after it below. (Numba's own sort compiles for a second.)

    Args:
        values: ``[n]`` numbers, left as they are.
        order: ``[m]`` int64 places in ``values``; those from ``low`` to before ``high`` are reordered.
        place: In ``order``, from ``low`` to before ``high``.
    """
    last = high - 1
    while low < last:
        pivot = values[order[(low + last) // 2]]
        i, j = low, last
        while i <= j:
            while values[order[i]] < pivot:
                i += 1
            while values[order[j]] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if place <= j:
            last = j
        elif place >= i:
            low = i
        else:
            break
