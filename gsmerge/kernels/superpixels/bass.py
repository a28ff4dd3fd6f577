"""Cut pictures into superpixels by BASS (Uziel, Ronen and Freifeld 2019), without its splits and merges.

Rounds of hard expectation maximisation of Gaussians in colour (fixed standard deviation) and position
(normal-inverse-Wishart prior), with a Potts term on the borders. A pixel may change its label only if no region is
disconnected by that. Pixels at the picture's edge may change, too, and no region can become empty.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import COUNT, STATUS, declare, f4, f8, i4, native, u1

COLOUR_DEVIATION = 0.018 / 2  # CIELAB / 100
REGION_COLUMNS = 9  # columns of a region's parameters


def simple_point_table():
    """Make a table ``[256]`` uint8 that is 1 for rings of neighbours with which a pixel may change its label.

    Such a ring has one arc of pixels with the label and one arc without, each with an edge neighbour. Bit i of the
    index is set if neighbour i (N, NE, E, SE, S, SW, W, NW) has the label.
    """
    cells = (np.arange(256)[:, None] >> np.arange(8)) & 1
    changes = (cells != np.roll(cells, 1, axis=1)).sum(1)
    edges = cells[:, 0::2].sum(1)
    return ((changes == 2) & (edges > 0) & (edges < 4)).astype(np.uint8)


# sums are zero before
_fit_regions = declare(
    "fit_regions", STATUS, labels=i4("padded_height", "padded_width"), colours=f4("height", "width", 3),
    areas=f8("count"), sums=f8("count", 9, out=True), rows=f4("count", REGION_COLUMNS, out=True),
)  # fmt: skip


def fit_regions(labels, colours, areas):
    """Fit ``[count,9]`` float32 parameters of every region: means, inverse covariance and its log-determinant.

    The covariance is ``(A² I + S) / (n + 50 A - 3)`` with the scatter S of n positions and the expected area A of the
    region, pixels, from ``areas [count]`` float64.
    """
    rows = np.empty((len(areas), REGION_COLUMNS), np.float32)
    _fit_regions(labels, colours, areas, np.zeros((len(areas), 9)), rows)
    return rows


@native(
    COUNT, labels=i4("padded_height", "padded_width", out=True), colours=f4("height", "width", 3),
    rows=f4("count", REGION_COLUMNS), table=u1(256), foreign=f4(256), precision=f4(),
)  # fmt: skip
def label_pass(labels, colours, rows, table, foreign, precision):
    """Pass over all border pixels once, in four grids of pixels that do not touch; return how many pixels changed.

    No two pixels of a grid are neighbours, so their order does not matter.
    """


def infer_labels(labels, colours, count):
    """Improve padded labels in place, in as many rounds as a superpixel's side has pixels; return them.

    Each of the ``count`` regions is 4-connected and not empty, before and after. ``colours [h,w,3]`` are CIELAB / 100.
    """
    height, width, _ = colours.shape
    areas = np.full(count, height * width / count)
    for _ in range(max(1, round((height * width / count) ** 0.5))):
        improve_labels(labels, colours, areas)
    return labels


def improve_labels(labels, colours, areas):
    """Fit the parameters of the regions and pass over the labels in place; ``areas`` are as in :func:`fit_regions`."""
    table = simple_point_table()
    foreign = 8 - ((np.arange(256)[:, None] >> np.arange(8)) & 1).sum(1).astype(np.float32)
    precision = np.float32(1 / COLOUR_DEVIATION**2)
    rows = fit_regions(labels, colours, areas)
    num_passes = 4  # label passes per update of the parameters
    for _ in range(num_passes):
        if label_pass(labels, colours, rows, table, foreign, precision) == 0:
            break
