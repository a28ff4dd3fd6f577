"""Bayesian adaptive superpixel segmentation (Uziel et al. 2019), with a fixed number of superpixels or adaptively.

Hard expectation maximisation of Gaussians in colour (fixed deviation) and position (normal-inverse-Wishart prior),
with a Potts term on the borders. A pixel may change its label only where no label is taken apart; the pixels at the
picture's edge take part, and no region can run empty. The adaptive form splits and merges between the rounds.
"""

from __future__ import annotations

import math

import numpy as np

from gsmerge.kernels.signature import COUNT, STATUS, declare, f4, f8, i4, native, u1
from gsmerge.kernels.superpixels.split_merge import merge, split

COLOUR_DEVIATION = 0.018 / 2  # CIELAB / 100
NUM_PASSES = 4  # label passes per update of the parameters
NUM_ROUNDS = 12  # of the adaptive form: splits and merges in turn
# Prior of the moves. The concentration, at the lower end of the authors' 0.01 to 100. Pseudo-observations of a colour's
# variance, so many that it is all but fixed, as in the label passes (with 1e4 a superpixel of much variance would
# rather keep it than pay for it twice, at up to 0.2 dB). The deviation of mean colours in a picture, CIELAB / 100.
ALPHA, PRIOR_SHAPE, MEAN_DEVIATION = 0.01, 1e6, 0.5
ROW = 9  # columns of a region's parameters


def simple_point_table():
    """``[256]`` uint8: 1 where walking round the ring meets one arc with the label and one without, each with an edge.

    Bit i of the index is set if neighbour i (N, NE, E, SE, S, SW, W, NW) has the label.
    """
    cells = (np.arange(256)[:, None] >> np.arange(8)) & 1
    changes = (cells != np.roll(cells, 1, axis=1)).sum(1)
    edges = cells[:, 0::2].sum(1)
    return ((changes == 2) & (edges > 0) & (edges < 4)).astype(np.uint8)


# sums are zero before
_fit_regions = declare(
    "fit_regions", STATUS, labels=i4("padded_height", "padded_width"), colours=f4("height", "width", 3),
    areas=f8("count"), sums=f8("count", 9, out=True), rows=f4("count", ROW, out=True),
)  # fmt: skip


def fit_regions(labels, colours, areas):
    """``[count,9]`` float32 parameters of every region: means, inverse covariance and its determinant's logarithm.

    The covariance is ``(A² I + S) / (n + 50 A - 3)`` with the scatter S of n positions and the area A of ``areas``
    ``[count]`` float64 that the region is expected to have, pixels.
    """
    rows = np.empty((len(areas), ROW), np.float32)
    _fit_regions(labels, colours, areas, np.zeros((len(areas), 9)), rows)
    return rows


@native(
    COUNT, labels=i4("padded_height", "padded_width", out=True), colours=f4("height", "width", 3),
    rows=f4("count", ROW), table=u1(256), foreign=f4(256), precision=f4(),
)  # fmt: skip
def label_pass(labels, colours, rows, table, foreign, precision):
    """One pass over all border pixels, in four grids of pixels that do not touch; returns how many changed.

    No two pixels of a grid are neighbours, so their order does not matter.
    """


def infer_labels(labels, colours, count):
    """Improve padded labels in place, as many rounds as a superpixel's side has pixels; returns them.

    Each of the ``count`` regions is 4-connected and not empty, and stays so. ``colours [h,w,3]`` are CIELAB / 100.
    """
    height, width, _ = colours.shape
    areas = np.full(count, height * width / count)
    for _ in range(max(1, round((height * width / count) ** 0.5))):
        improve_labels(labels, colours, areas)
    return labels


def improve_labels(labels, colours, areas):
    """Fit the regions' parameters and pass over the labels, in place; ``areas`` as of :func:`fit_regions`."""
    table = simple_point_table()
    foreign = 8 - ((np.arange(256)[:, None] >> np.arange(8)) & 1).sum(1).astype(np.float32)
    precision = np.float32(1 / COLOUR_DEVIATION**2)
    rows = fit_regions(labels, colours, areas)
    for _ in range(NUM_PASSES):
        if label_pass(labels, colours, rows, table, foreign, precision) == 0:
            break


def move_prior():
    """``[4]`` float64 log α, a, b and v of the moves, whose colours deviate as much as those of the label passes."""
    variance = COLOUR_DEVIATION**2
    return np.array([math.log(ALPHA), PRIOR_SHAPE, PRIOR_SHAPE * variance, MEAN_DEVIATION**2 / variance])


def adapt_labels(labels, colours, count, factor, share):
    """Improve padded labels while superpixels split and merge by the Hastings ratio.

    Args:
        labels: Padded labels 0 to ``count - 1``, each region 4-connected and none empty; overwritten.
        colours: ``[h,w,3]`` float32, CIELAB / 100.
        count: Regions at the start.
        factor: Most times that their number grows or falls, an integer; there is never more than one per pixel.
        share: Of the number that they come to, the part that is left in the end; None: exactly ``count``. It is met by
            the moves of the highest ratios.

    Returns:
        (labels, count): padded labels, dense from 0, each region 4-connected and none empty, and how many there are.
    """
    height, width, _ = colours.shape
    areas, prior = np.full(count, height * width / count), move_prior()
    least, most = -(-count // factor), min(height * width, count * factor)
    improve_labels(labels, colours, areas)
    for i in range(NUM_ROUNDS):
        if i % 2 == 0:
            labels, areas = split(labels, colours, areas, prior, across=i % 4 == 2, most=most - len(areas))
        else:
            labels, areas = merge(labels, colours, areas, prior, most=len(areas) - least)
        improve_labels(labels, colours, areas)
    target = count if share is None else max(1, round(share * len(areas)))
    if len(areas) != target:
        labels, areas = _meet_count(labels, colours, areas, prior, target)
        improve_labels(labels, colours, areas)
    return labels, len(areas)


def _meet_count(labels, colours, areas, prior, count):
    """Merge or split, the highest ratios first, to exactly ``count`` regions, at most one per pixel."""
    across = False
    while len(areas) > count:
        labels, areas = merge(labels, colours, areas, prior, most=len(areas) - count, least=-np.inf)
    while len(areas) < count:
        labels, areas = split(labels, colours, areas, prior, across, count - len(areas), least=-np.inf)
        across = not across
    return labels, areas
