"""Quickselect of an order, for medians and k-d trees."""

from __future__ import annotations

from gsmerge.kernels.signature import STATUS, f8, i8, native


@native(STATUS, values=f8("n"), order=i8("m", out=True, least=0, below="n"), low=i8(least=0), high=i8(), place=i8())
def partition(values, order, low, high, place):
    """Reorder a run of an order so that one place holds the value that sorting would put there.

    No value before the place is above it, and none after it below.

    Args:
        values: ``[n]`` float64 numbers, left as they are.
        order: ``[m]`` int64 places in ``values``; those from ``low`` to before ``high`` are reordered.
        place: In ``order``, from ``low`` to before ``high``.
    """
