"""Cut pictures into superpixels by BASS (Uziel, Ronen and Freifeld 2019), without its splits and merges.

Each region is a Gaussian in colour and in position. The colour has a fixed standard deviation, and the position has a
normal-inverse-Wishart prior. Each round fits the Gaussians of the regions, and then moves pixels to the most likely
regions (hard expectation maximisation). A Potts term keeps borders short. A pixel may change its label only if every
region stays connected, so no region becomes empty. Pixels at the border of the picture may change as well.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import COUNT, STATUS, declare, f4, f8, i4, native, u1

COLOUR_DEVIATION = 0.018 / 2  # standard deviation of colours, in CIELAB divided by 100
REGION_COLUMNS = 9  # number of a region's parameters


def simple_point_table():
    """Return a table ``[256]`` uint8 that is 1 for rings of eight neighbours with which a pixel may change its label.

    Bit i of the index is set if neighbour i (N, NE, E, SE, S, SW, W, NW) has the label of the pixel. The pixel may
    change if the ring consists of one arc of neighbours with this label and one arc of other neighbours. In each arc, a
    neighbour has to share a side with the pixel.
    """
    cells = (np.arange(256)[:, None] >> np.arange(8)) & 1
    changes = (cells != np.roll(cells, 1, axis=1)).sum(1)
    edges = cells[:, 0::2].sum(1)
    return ((changes == 2) & (edges > 0) & (edges < 4)).astype(np.uint8)


# `sums` are zero before
_fit_regions = declare(
    "fit_regions", STATUS, labels=i4("padded_height", "padded_width"), colours=f4("height", "width", 3),
    areas=f8("count"), sums=f8("count", 9, out=True), rows=f4("count", REGION_COLUMNS, out=True),
)  # fmt: skip


def fit_regions(labels, colours, areas):
    """Return the parameters ``[count,9]`` float32 of every region: means, inverse covariance, and its log-determinant.

    The covariance is ``(A² I + S) / (n + 50 A - 3)``. S is the scatter of the n positions of a region. A is the
    expected area of a region in pixels, from ``areas [count]`` float64.
    """
    rows = np.empty((len(areas), REGION_COLUMNS), np.float32)
    _fit_regions(labels, colours, areas, np.zeros((len(areas), 9)), rows)
    return rows


@native(
    COUNT, labels=i4("padded_height", "padded_width", out=True), colours=f4("height", "width", 3),
    rows=f4("count", REGION_COLUMNS), table=u1(256), foreign=f4(256), precision=f4(),
)  # fmt: skip
def label_pass(labels, colours, rows, table, foreign, precision):
    """Visit all pixels at borders between regions once, and return how many changed their label.

    The pixels are visited in four grids. No two pixels of a grid are neighbours, so their order has no effect.
    """


def infer_labels(labels, colours, count):
    """Improve padded labels in place, and return them.

    There are as many rounds as the side of a superpixel has pixels. Each of the ``count`` regions is 4-connected and
    not empty, and remains 4-connected and not empty. ``colours [h,w,3]`` are CIELAB values divided by 100.
    """
    height, width, _ = colours.shape
    areas = np.full(count, height * width / count)
    for _ in range(max(1, round((height * width / count) ** 0.5))):
        improve_labels(labels, colours, areas)
    return labels


def improve_labels(labels, colours, areas):
    """Fit the regions, and move pixels to their most likely regions; ``labels`` change in place.

    ``areas [count]`` float64 are the expected areas of the regions in pixels, see :func:`fit_regions`.
    """
    table = simple_point_table()
    # Number of neighbours with other labels, for each ring of `simple_point_table`
    foreign = 8 - ((np.arange(256)[:, None] >> np.arange(8)) & 1).sum(1).astype(np.float32)
    precision = np.float32(1 / COLOUR_DEVIATION**2)
    rows = fit_regions(labels, colours, areas)
    num_passes = 4  # most passes over the labels after each fit of the parameters
    for _ in range(num_passes):
        if label_pass(labels, colours, rows, table, foreign, precision) == 0:
            break
