"""The cheapest path through the views of rows that go pixel by pixel, the views of one pixel side by side."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import STATUS, declare, i1, i4, i8

BACK = 200.0  # cost of a step that goes back, in pixels
FAR = 50.0  # cost of any longer step forward: a stretch that was dropped costs no more


_find_path = declare(
    "find_path", STATUS, pixels=i4("n", "v", least=-1, below=(1 << 31) - 1), came_from=i1("n", "v", out=True),
    views=i8("n", out=True), back=i8(1, out=True),
)  # fmt: skip


def cheapest_views(pixels, came_from, views):
    """Find Viterbi's path through ``pixels [n,v]`` int32: the pixel of each row in each view, -1 outside.

    Returns how many of its steps go back. Overwritten: ``views [n]`` int64, the view of each row; ``came_from [n,v]``
    int8, the best view of the previous row. There are 1 to 127 views.
    """
    back = np.empty(1, np.int64)
    _find_path(pixels, came_from, views, back)
    return int(back[0])
