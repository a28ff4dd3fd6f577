"""Describe regions of a picture by padded labels and a row of numbers each, and move pixels between them.

Label pictures are padded: ``[h+2,w+2]`` int32 with a frame of -1, so that no kernel has to check for the border. A
region's row has all numbers of its cost in half a cache line of float32: its mean feature, its number of pixels, and
two columns for the algorithm that uses it. The feature is r, g, b, y·spread and x·spread, where spread² is the weight
of squared pixels against squared colours. With means in place of sums, float32 is exact enough for pictures of any
size.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import COUNT, STATUS, declare, f4, f8, i4, i8, native, u1

NUM_PIXELS, ROW_COLUMNS = 5, 8  # column after the five of the mean, and the length of a row
LEAVE, JOIN = 6, 7  # columns of a region's row: n / (n - 1) for removing a pixel, n / (n + 1) for adding one


def pad_labels(labels):
    """Pad a label picture ``[h,w]`` with the frame that the kernels expect."""
    return np.pad(np.ascontiguousarray(labels, np.int32), 1, constant_values=-1)


# sums are zero before; the first ``count`` rows are written
_region_rows = declare(
    "region_rows", STATUS, labels=i4("padded_height", "padded_width"), pixels=f4("height", "width", 3), spread=f4(),
    sums=f8("count", 6, out=True), rows=f4("capacity", ROW_COLUMNS, out=True),
)  # fmt: skip


def region_rows(labels, pixels, count, capacity, spread):
    """Fill the first ``count`` of ``[capacity,8]`` float32 rows with the regions of a picture, summed in float64.

    Raises ValueError if padded labels are not from 0 to ``count - 1``.
    """
    rows = np.zeros((capacity, ROW_COLUMNS), np.float32)
    _region_rows(labels, pixels, spread, np.zeros((count, 6)), rows)
    return rows


def connectivity_table() -> np.ndarray:
    """Make a table ``[256]`` uint8 that is 1 for rings with which a pixel may leave its region without splitting it.

    Bit i of the index is set if neighbour i (N, NE, E, SE, S, SW, W, NW) has the pixel's label. An entry is 1 if the
    neighbours with the label form one 4-connected part that touches the pixel by an edge. The number of parts is the
    number of edge neighbours minus the number of corner neighbours that join two edge neighbours (Yokoi's connectivity
    number). In a closed ring both numbers are equal.
    """
    cells = (np.arange(256)[:, None] >> np.arange(8)) & 1
    edges, corners = cells[:, 0::2], cells[:, 1::2]
    joined = edges * corners * np.roll(edges, -1, axis=1)
    return ((edges.sum(1) - joined.sum(1) == 1) | cells.all(1)).astype(np.uint8)


@native(COUNT, labels=i4("rows", "columns"), y=i8(), x=i8(), label=i4())
def ring_mask(labels, y, x, label):
    """Return the bits of the eight neighbours (N, NE, E, SE, S, SW, W, NW) that have ``label``."""


@native(
    COUNT, labels=i4("padded_height", "padded_width", out=True), pixels=f4("height", "width", 3),
    rows=f4("count", ROW_COLUMNS, out=True), table=u1(256), spread=f4(), backward=i4(),
)  # fmt: skip
def sweep(labels, pixels, rows, table, spread, backward):
    """Sweep once over the border pixels; each move lowers the total squared error, and updates the means at once.

    A pixel moves from region A to a 4-neighbour's region B if ``n_A/(n_A-1)·d_A² > n_B/(n_B+1)·d_B²`` and A stays
    connected without it. It needs a neighbour of its own label, so no region becomes empty.

    Args:
        labels: Padded labels 0 to ``count - 1``, changed.
        rows: ``[count,8]`` float32 rows of the regions with their last two columns, changed.
        table: From :func:`connectivity_table`.
        spread: Square root of the weight of squared pixels against squared colours.
        backward: Sweep from the last pixel to the first.

    Returns:
        Number of pixels that moved.
    """


CONNECTIVITY = connectivity_table()


def refine(labels, pixels, count, num_sweeps, spread):
    """Sweep in place, back and forth, until no pixel moves or ``num_sweeps`` are done; return the padded labels.

    Each of the ``count`` regions is 4-connected and not empty, before and after. ``spread`` is the square root of the
    weight of squared pixels against squared colours, float32.
    """
    rows = region_rows(labels, pixels, count, count, spread)
    num_pixels = rows[:, NUM_PIXELS]
    rows[:, LEAVE] = num_pixels / np.maximum(num_pixels - 1, 1)  # the pixel of a one-pixel region never leaves
    rows[:, JOIN] = num_pixels / (num_pixels + 1)
    for i in range(num_sweeps):
        if sweep(labels, pixels, rows, CONNECTIVITY, spread, i % 2 == 1) == 0:
            break
    return labels
