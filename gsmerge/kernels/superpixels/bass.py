"""Bayesian adaptive superpixel segmentation (Uziel et al. 2019), with a fixed number of superpixels or adaptively.

The method is hard expectation maximisation of Gaussians in colour (fixed standard deviation) and position
(normal-inverse-Wishart prior), with a Potts term on the borders. A pixel may change its label only if no region is
disconnected by that. Pixels at the picture's edge may change, too, and no region can become empty. The adaptive form
splits and merges superpixels between the rounds, by moves that are accepted by their Hastings ratio (Chang and Fisher
2013).

Splitting c into a and b has the ratio ``H = α Γ(n_a) f(a) Γ(n_b) f(b) / (Γ(n_c) f(c))``, and merging them its inverse.
Here α is the concentration of a Dirichlet process, and ``f`` is the marginal likelihood of a superpixel's n pixels.
Moves with H > 1 are made. ``f`` is the likelihood of colours with unknown mean and variance (normal-inverse-gamma)
times ``n^-n`` for positions anywhere in the superpixel's area. Without that factor Γ would favour few large superpixels
in every picture, since the density of positions grows as a superpixel shrinks.

The authors' own code differs. It has neither α nor Γ nor positions in a split. It overwrites a_0 by a_n, so that Γ(a_n)
is lost. It sets b_0 to a_0 times a standard deviation instead of a variance. And it accepts log H > -2 in both
directions.
"""

from __future__ import annotations

import math

import numpy as np

from gsmerge.kernels.signature import COUNT, STATUS, declare, f4, f8, i4, i8, native, u1
from gsmerge.kernels.superpixels.ward import adjacent_pairs

SUMS = 7  # columns of a region's sums: pixels, colours (3), squared colours (3)


_sum_regions = declare(
    "sum_regions", STATUS, labels=i4("padded_height", "padded_width"), colours=f4("height", "width", 3),
    marks=u1("height", "width"), sums=f8("count", SUMS, out=True),
)  # fmt: skip
COLOUR_DEVIATION = 0.018 / 2  # CIELAB / 100
NUM_PASSES = 4  # label passes per update of the parameters
NUM_ROUNDS = 12  # rounds of the adaptive form, which alternate between splits and merges
# Prior of the moves: the concentration, at the lower end of the authors' 0.01 to 100; the number of pseudo-observations
# of a colour's variance; and the standard deviation of mean colours in a picture, CIELAB / 100. The number is so large
# that the variance is almost fixed, as in the label passes. With 1e4 superpixels of large variance would not be split,
# which costs up to 0.2 dB
ALPHA, PRIOR_SHAPE, MEAN_DEVIATION = 0.01, 1e6, 0.5
ROW = 9  # columns of a region's parameters


def sum_regions(labels, colours, marks, count):
    """Sum the marked pixels of every region: ``[count,7]`` float64.

    Args:
        labels: Padded labels.
        count: Number of regions.
    """
    sums = np.zeros((count, SUMS))
    _sum_regions(labels, colours, marks.view(np.uint8), sums)
    return sums


@native(f8(), sums=f8(SUMS), prior=f8(4))
def log_evidence(sums, prior):
    """Compute the logarithm of ``Γ(n) f`` from a region's ``[7]`` sums.

    With ``m ~ N(0, v σ²)`` and ``σ² ~ IG(a, b)`` for each channel, its colours have the likelihood ``(2π)^(-n/2) (1 + n
    v)^(-1/2) Γ(a_n) / Γ(a) b^a / b_n^(a_n)``, where ``a_n = a + n / 2`` and ``b_n = b + (Σ c² - (Σ c)² v / (1 + n v)) /
    2`` (Murphy 2007, section 3).
    """


# sums are zero before
_mark_halves = declare(
    "mark_halves", STATUS, labels=i4("padded_height", "padded_width"), across=i4(), boxes=i8("count", 4, out=True),
    sums=f8("count", 3, out=True), offsets=f8("count", 2, out=True), ends=i8("count", 2, out=True),
    queue=i4("places", 2, out=True), halves=u1("height", "width", out=True),
)  # fmt: skip


def mark_halves(labels, count, across):
    """Mark the second half of every region, ``[h,w]`` bool; both halves are 4-connected.

    A region has two ends: the middle of its top and of its bottom, or with ``across`` of its left and of its right.
    Each pixel belongs to the end that is nearer in steps inside the region. A region of one pixel has no second half.
    """
    height, width = labels.shape[0] - 2, labels.shape[1] - 2
    halves, queue = np.empty((height, width), np.uint8), np.empty((height * width, 2), np.int32)
    boxes, ends = np.empty((count, 4), np.int64), np.empty((count, 2), np.int64)
    _mark_halves(labels, across, boxes, np.zeros((count, 3)), np.empty((count, 2)), ends, queue, halves)
    return halves == 1


# ratios of regions that cannot be split do not change
_weigh_splits = declare(
    "weigh_splits", whole=f8("count", SUMS), second=f8("count", SUMS), prior=f8(4), ratios=f8("count", out=True)
)


def weigh_splits(whole, second, prior):
    """Compute log H ``[count]`` of splitting every region; -inf for regions that cannot be split.

    Args:
        whole: ``[count,7]`` sums of the regions.
        second: ``[count,7]`` sums of their second halves.
        prior: ``[4]`` float64, log α, a, b and v.
    """
    ratios = np.full(len(whole), -np.inf)
    _weigh_splits(whole, second, prior, ratios)
    return ratios


# partners are -1 and ratios -inf before
_choose_merges = declare(
    "choose_merges", sums=f8("count", SUMS), pairs=i4("num_pairs", 2, least=0, below="count"), prior=f8(4),
    own=f8("count", out=True), partners=i4("count", out=True), ratios=f8("count", out=True),
)  # fmt: skip


def choose_merges(pairs, sums, prior):
    """Choose every region's best neighbour ``[count]``, -1 without any; also return log H ``[count]`` of the merge."""
    count = len(sums)
    partners, ratios = np.full(count, -1, np.int32), np.full(count, -np.inf)
    _choose_merges(sums, pairs, prior, np.empty(count), partners, ratios)
    return partners, ratios


def split(labels, colours, areas, prior, across, most, least=0.0):
    """Split the regions with log H above ``least``, at most ``most`` of them, highest log H first.

    Args:
        labels: Padded labels 0 to ``len(areas) - 1``, each region 4-connected and not empty, before and after.
        areas: ``[count]`` float64 expected area of every region, pixels; each half gets a part of it.
        prior: ``[4]`` float64, log α, a, b and v.
        across: Split into left and right halves; otherwise into top and bottom.
        most: Largest number of splits.
        least: Least log H of a split.

    Returns:
        (labels, areas) with the new regions at the end.
    """
    count = len(areas)
    marks = mark_halves(labels, count, across)
    whole = sum_regions(labels, colours, np.ones_like(marks), count)
    ratios = weigh_splits(whole, sum_regions(labels, colours, marks, count), prior)
    order = np.argsort(-ratios, kind="stable")[: max(0, most)]
    order = order[ratios[order] > least]
    news = np.arange(count, dtype=np.int32)
    news[order] = count + np.arange(len(order))
    labels = labels.copy()
    inner = labels[1:-1, 1:-1]
    inner[marks] = news[inner[marks]]
    areas = areas.copy()
    areas[order] /= 2
    return labels, np.append(areas, areas[order])


def merge(labels, colours, areas, prior, most, least=0.0):
    """Merge pairs of regions that are each other's best neighbour; arguments and result as in :func:`split`."""
    count = len(areas)
    sums = sum_regions(labels, colours, np.ones(colours.shape[:2], np.bool_), count)
    partners, ratios = choose_merges(adjacent_pairs(labels), sums, prior)
    first = np.flatnonzero((partners > np.arange(count)) & (ratios > least))
    first = first[partners[partners[first]] == first]
    first = first[np.argsort(-ratios[first], kind="stable")[: max(0, most)]]
    targets = np.arange(count, dtype=np.int32)
    targets[partners[first]] = first
    kept = targets == np.arange(count)
    news = (np.cumsum(kept) - 1).astype(np.int32)[targets]
    return np.append(news, np.int32(-1))[labels], np.bincount(news, areas)


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
    areas=f8("count"), sums=f8("count", 9, out=True), rows=f4("count", ROW, out=True),
)  # fmt: skip


def fit_regions(labels, colours, areas):
    """Fit ``[count,9]`` float32 parameters of every region: means, inverse covariance and its log-determinant.

    The covariance is ``(A² I + S) / (n + 50 A - 3)`` with the scatter S of n positions and the expected area A of the
    region, pixels, from ``areas [count]`` float64.
    """
    rows = np.empty((len(areas), ROW), np.float32)
    _fit_regions(labels, colours, areas, np.zeros((len(areas), 9)), rows)
    return rows


@native(
    COUNT, labels=i4("padded_height", "padded_width", out=True), colours=f4("height", "width", 3),
    rows=f4("count", ROW), table=u1(256), foreign=f4(256), precision=f4(),
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
    for _ in range(NUM_PASSES):
        if label_pass(labels, colours, rows, table, foreign, precision) == 0:
            break


def move_prior():
    """Return the prior of splits and merges: ``[4]`` float64 log α, a, b and v.

    The standard deviation of colours is that of the label passes.
    """
    variance = COLOUR_DEVIATION**2
    return np.array([math.log(ALPHA), PRIOR_SHAPE, PRIOR_SHAPE * variance, MEAN_DEVIATION**2 / variance])


def adapt_labels(labels, colours, count, factor, share):
    """Improve padded labels, and split and merge superpixels by the Hastings ratio.

    Args:
        labels: Padded labels 0 to ``count - 1``, each region 4-connected and none empty; overwritten.
        colours: ``[h,w,3]`` float32, CIELAB / 100.
        count: Number of regions at the start.
        factor: Largest factor, an integer, by which their number grows or falls; there is at most one per pixel.
        share: Share of the resulting number of regions that remains in the end; None: exactly ``count`` remain. The
            moves with the highest ratios are made to reach it.

    Returns:
        (labels, count): padded labels, dense from 0, each region 4-connected and not empty, and the number of regions.
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
    """Merge or split regions, highest ratios first, until there are exactly ``count``, at most one per pixel."""
    across = False
    while len(areas) > count:
        labels, areas = merge(labels, colours, areas, prior, most=len(areas) - count, least=-np.inf)
    while len(areas) < count:
        labels, areas = split(labels, colours, areas, prior, across, count - len(areas), least=-np.inf)
        across = not across
    return labels, areas
