"""What the segmentation kernels share: padded label pictures and the rows of their regions.

Label pictures are padded: ``[h+2,w+2]`` int32 with a frame of -1, so that no kernel asks where the picture ends.
A region's row holds what a cost needs in half a cache line of float32: its mean feature (r, g, b, y·spread,
x·spread; spread² is the weight of squared pixels against squared colours), its number of pixels, and two columns
that belong to the algorithm at work. Means, not sums, keep float32 exact enough for pictures of any size.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import STATUS, declare, f4, f8, i4

NUM_PIXELS, ROW = 5, 8  # column after the five of the mean, and the length of a row


def pad_labels(labels):
    """A label picture ``[h,w]`` with the frame that the kernels expect."""
    return np.pad(np.ascontiguousarray(labels, np.int32), 1, constant_values=-1)


# sums are zero before; the first ``count`` rows are written
_region_rows = declare(
    "region_rows", STATUS, labels=i4("padded_height", "padded_width"), pixels=f4("height", "width", 3), spread=f4(),
    sums=f8("count", 6, out=True), rows=f4("capacity", ROW, out=True),
)  # fmt: skip


def region_rows(labels, pixels, count, capacity, spread):
    """``[capacity,8]`` float32, of which the first ``count`` rows are filled; sums are float64.

    Raises ValueError where padded labels are not from 0 to ``count - 1``.
    """
    rows = np.zeros((capacity, ROW), np.float32)
    _region_rows(labels, pixels, spread, np.zeros((count, 6)), rows)
    return rows
