"""Cut a picture into regions, describe them by padded labels and a row of numbers, and move pixels between regions.

The first regions are rectangles, from which merging starts. The best cut, by integral images, is made first.

Padded labels are ``[h+2,w+2]`` int32 with a frame of -1, so that no kernel has to check for the border. The row of a
region has its mean features (5), its number of pixels, and two columns for the algorithm that uses it. Costs are
computed from the eight float32 numbers of a row, which fill half a cache line. The features of a pixel are r, g, b,
y·spread and x·spread, where spread² is the weight of squared distances in pixels, relative to squared differences of
colours. Rows have means instead of sums, because means are exact enough in float32 for pictures of any size.
"""

from __future__ import annotations

import numpy as np

from gsmerge.method.kernels.signature import COUNT, STATUS, declare, f4, f8, i4, i8, native, u1

# column of the number of pixels, after the means, and length of a row
NUM_PIXELS = 5
ROW_COLUMNS = 8
# columns of n / (n - 1), for a pixel that leaves, and of n / (n + 1), for one that joins
LEAVE = 6
JOIN = 7
NUM_BUCKETS = 2048  # number of lists, each for cuts with about the same gain
NODE = 8  # columns of the row of a rectangle


def pad_labels(labels):
    """Return padded labels: the labels ``[h,w]`` with a frame of -1, as the kernels take them."""
    return np.pad(np.ascontiguousarray(labels, np.int32), 1, constant_values=-1)


_integral_image = declare("integral_image", STATUS, pixels=f4("height", "width", 3), integral=f8("places", 3, out=True))


def integral_image(pixels):
    """Return, for each corner of a pixel, the sum of all pixels above and to the left, ``[(h+1)·(w+1),3]`` float64."""
    height, width, _ = pixels.shape
    integral = np.empty(((height + 1) * (width + 1), 3))
    _integral_image(pixels, integral)
    return integral


# Finds the best cut of a rectangle across one of its sides. Writes the gain of the cut, which is the reduction of the
# squared error, and its position, 1 to side - 1. The gain is below 0 if the rectangle cannot be cut. Let the rectangle
# have n pixels whose colours sum to t. A cut at c of the side of length S makes parts with sums s and t - s. The cut
# lowers the colour error by |S s - c t|² / (n c (S - c)), and the position error by n c (S - c) / 4 times the
# compactness. near and far are indices in the integral image: near belongs to the rectangle's first corner, and far to
# the other end of the uncut side from this corner. step is the difference of indices of neighbours along the side that
# is cut.
cut_gain = declare(
    "cut_gain", STATUS, integral=f8("places", 3), near=i8(least=0), far=i8(least=0), step=i8(least=1), side=i8(least=0),
    num_pixels=f8(), compactness=f8(), found=f8(2, out=True),
)  # fmt: skip


# Returns the number of labels
_split_rectangles = declare(
    "split_rectangles", COUNT, integral=f8("places", 3), count=i8(least=0), block=i8(least=1), compactness=f8(),
    nodes=i4("capacity", NODE, out=True), heads=i8(NUM_BUCKETS, out=True),
    labels=i4("padded_height", "padded_width", out=True),
)  # fmt: skip


def split_rectangles(pixels, count, block, compactness):
    """Cut a picture into ``count`` rectangles, or into more if there are more blocks.

    The picture is first divided into square blocks. Then rectangles are cut where a cut has the largest gain, which is
    the reduction of the squared error.

    Args:
        count: Wanted number of rectangles, at most h·w.
        block: Side of the blocks, pixels.
        compactness: Weight of squared distances in pixels, relative to squared differences of colours.

    Returns:
        Padded labels, and the number of rectangles.
    """
    height, width, _ = pixels.shape
    capacity = max(count, max(1, height // block) * max(1, width // block))
    nodes = np.empty((capacity, NODE), np.int32)
    heads = np.empty(NUM_BUCKETS, np.int64)
    labels = np.empty((height + 2, width + 2), np.int32)
    return labels, _split_rectangles(integral_image(pixels), count, block, compactness, nodes, heads, labels)


# `sums` are zero before. The first `count` rows are written
_region_rows = declare(
    "region_rows", STATUS, labels=i4("padded_height", "padded_width"), pixels=f4("height", "width", 3), spread=f4(),
    sums=f8("count", 6, out=True), rows=f4("capacity", ROW_COLUMNS, out=True),
)  # fmt: skip


def region_rows(labels, pixels, count, capacity, spread):
    """Return float32 rows ``[capacity,8]``, of which the first ``count`` describe the regions of a picture.

    Sums are taken in float64. Raises ValueError if the padded labels are not from 0 to ``count - 1``.
    """
    rows = np.zeros((capacity, ROW_COLUMNS), np.float32)
    _region_rows(labels, pixels, spread, np.zeros((count, 6)), rows)
    return rows


def connectivity_table() -> np.ndarray:
    """Return a table ``[256]`` uint8 that is 1 for rings of neighbours with which a pixel may leave its region.

    Bit i of the index is set if neighbour i (N, NE, E, SE, S, SW, W, NW) is in the pixel's region. The region stays in
    one piece if its neighbours at the sides are 4-connected within the ring. The number of parts is the number of
    neighbours at the sides minus the number of corner neighbours that join two of them (Yokoi's connectivity number).
    If the whole ring is in the region, the formula gives 0, although the ring is one part.
    """
    cells = (np.arange(256)[:, None] >> np.arange(8)) & 1
    edges = cells[:, 0::2]
    corners = cells[:, 1::2]
    joined = edges * corners * np.roll(edges, -1, axis=1)
    return ((edges.sum(1) - joined.sum(1) == 1) | cells.all(1)).astype(np.uint8)


@native(COUNT, labels=i4("rows", "columns"), y=i8(), x=i8(), label=i4())
def ring_mask(labels, y, x, label):
    """Return a number whose bit i is set if neighbour i (N, NE, E, SE, S, SW, W, NW) of a pixel has ``label``."""


@native(
    COUNT, labels=i4("padded_height", "padded_width", out=True), pixels=f4("height", "width", 3),
    rows=f4("count", ROW_COLUMNS, out=True), table=u1(256), spread=f4(), backward=i4(),
)  # fmt: skip
def sweep(labels, pixels, rows, table, spread, backward):
    """Visit the pixels at borders between regions once, and move each pixel if this lowers the total squared error.

    A pixel moves from region A to the region B of a 4-neighbour if ``n_A/(n_A-1)·d_A² > n_B/(n_B+1)·d_B²``, where n are
    numbers of pixels and d distances from the means. Region A must stay connected without the pixel. A pixel without a
    neighbour in its own region A stays, so no region becomes empty. The means are updated after each move.

    Args:
        labels: Padded labels 0 to ``count - 1``, changed.
        rows: ``[count,8]`` float32 rows of the regions with the columns LEAVE and JOIN, changed.
        table: Result of :func:`connectivity_table`.
        spread: Square root of the weight of squared distances in pixels.
        backward: 1 to visit the last pixel first, 0 to visit it last.

    Returns:
        Number of pixels that moved.
    """


CONNECTIVITY = connectivity_table()


def refine(labels, pixels, count, num_sweeps, spread):
    """Move pixels at borders between regions in place, if this lowers the squared error, and return the padded labels.

    Sweeps run forward and backward alternately, until no pixel moves or ``num_sweeps`` are done. Each of the ``count``
    regions is 4-connected and not empty, and remains 4-connected and not empty. ``spread`` is the square root of the
    weight of squared distances in pixels, float32.
    """
    rows = region_rows(labels, pixels, count, count, spread)
    num_pixels = rows[:, NUM_PIXELS]
    rows[:, LEAVE] = num_pixels / np.maximum(num_pixels - 1, 1)  # the pixel of a one-pixel region never leaves
    rows[:, JOIN] = num_pixels / (num_pixels + 1)
    for i in range(num_sweeps):
        if sweep(labels, pixels, rows, CONNECTIVITY, spread, i % 2 == 1) == 0:
            break
    return labels
