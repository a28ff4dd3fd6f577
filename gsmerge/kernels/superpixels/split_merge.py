"""Split and merge moves of superpixels, accepted by their Hastings ratio (Uziel et al. 2019; Chang and Fisher 2013).

Splitting c into a and b has the ratio ``H = α Γ(n_a) f(a) Γ(n_b) f(b) / (Γ(n_c) f(c))``, merging them its inverse, with
the concentration α of a Dirichlet process and the marginal likelihood ``f`` of a superpixel's n pixels. Moves with
H > 1 are made. ``f`` is that of colours of unknown mean and variance (normal-inverse-gamma) times ``n^-n`` for
positions anywhere in the superpixel's area: without it Γ would favour few large superpixels in every picture, as the
density of positions grows as a superpixel shrinks.

The authors' CUDA code differs: it has neither α nor Γ nor positions in a split, overwrites a_0 by a_n (so that Γ(a_n)
is lost), sets b_0 to a_0 times a deviation instead of a variance, and accepts log H > -2 in both directions.
"""

from __future__ import annotations

import math

import numpy as np

from gsmerge.kernels.jit import kernel
from gsmerge.kernels.superpixels.ward import adjacent_pairs, pair_tie

SUMS = 7  # columns of a region's sums: pixels, colours (3), squared colours (3)
LOG_ALPHA, SHAPE, SCALE, SPREAD = 0, 1, 2, 3  # of a prior: log α, a and b of the inverse gamma, v


@kernel
def sum_regions(labels, colours, marks, count):
    """``[count,7]`` float64 sums over the marked pixels of every region.

    Args:
        labels: Padded labels.
        colours: ``[h,w,3]`` float32.
        marks: ``[h,w]`` bool.
        count: Number of regions.
    """
    height, width, _ = colours.shape
    sums = np.zeros((count, SUMS))
    for y in range(height):
        for x in range(width):
            if marks[y, x]:
                label = labels[y + 1, x + 1]
                sums[label, 0] += 1.0
                for i in range(3):
                    colour = np.float64(colours[y, x, i])
                    sums[label, 1 + i] += colour
                    sums[label, 4 + i] += colour * colour
    return sums


@kernel(part=True)
def log_evidence(sums, prior):
    """Logarithm of ``Γ(n) f`` of a region's ``[7]`` sums.

    With ``m ~ N(0, v σ²)`` and ``σ² ~ IG(a, b)`` for each channel, its colours have the likelihood ``(2π)^(-n/2)
    (1 + n v)^(-1/2) Γ(a_n) / Γ(a) b^a / b_n^(a_n)``, where ``a_n = a + n / 2`` and ``b_n = b + (Σ c² - (Σ c)² v /
    (1 + n v)) / 2`` (Murphy 2007, section 3).
    """
    n, a, b, v = sums[0], prior[SHAPE], prior[SCALE], prior[SPREAD]
    shape = a + 0.5 * n
    value = math.lgamma(n) - n * np.log(n)
    value += 3.0 * (math.lgamma(shape) - math.lgamma(a) - 0.5 * np.log(1.0 + n * v) - 0.5 * n * np.log(2.0 * np.pi * b))
    for i in range(3):
        error = sums[4 + i] - sums[1 + i] * sums[1 + i] * v / (1.0 + n * v)
        value -= shape * np.log(1.0 + 0.5 * max(error, 0.0) / b)
    return value


@kernel
def _region_ends(labels, count, across):
    """``[count,4]`` y and x of a first and a last pixel of every region, different ones where it has two.

    They are in the region's first and last row, or where ``across`` column, next to the middle of its pixels. A region
    of one row or column is taken along it.
    """
    height, width = labels.shape[0] - 2, labels.shape[1] - 2
    boxes, sums = np.empty((count, 4), np.int64), np.zeros((count, 3))
    boxes[:, :2], boxes[:, 2:] = height + width, -1
    for y in range(height):
        for x in range(width):
            label = labels[y + 1, x + 1]
            boxes[label, 0], boxes[label, 2] = min(boxes[label, 0], y), max(boxes[label, 2], y)
            boxes[label, 1], boxes[label, 3] = min(boxes[label, 1], x), max(boxes[label, 3], x)
            sums[label, 0] += y
            sums[label, 1] += x
            sums[label, 2] += 1.0
    ends, offsets = np.empty((count, 4), np.int64), np.full((count, 2), np.inf)
    for y in range(height):
        for x in range(width):
            label = labels[y + 1, x + 1]
            sideways = boxes[label, 1] < boxes[label, 3] and (across or boxes[label, 0] == boxes[label, 2])
            place, other, axis = (x, y, 1) if sideways else (y, x, 0)
            offset = abs(other - sums[label, 1 - axis] / sums[label, 2])
            for end in range(2):
                if place == boxes[label, 2 * end + axis] and offset < offsets[label, end]:
                    offsets[label, end] = offset
                    ends[label, 2 * end], ends[label, 2 * end + 1] = y, x
    return ends


@kernel
def mark_halves(labels, count, across):
    """``[h,w]`` bool: the second half of every region, both halves 4-connected; none of a region of one pixel.

    A pixel goes with the nearer, in steps inside the region, of two ends in the middle of its top and bottom, or where
    ``across`` of its left and right.
    """
    height, width = labels.shape[0] - 2, labels.shape[1] - 2
    ends = _region_ends(labels, count, across)
    side = np.full((height, width), 2, np.uint8)
    queue = np.empty((height * width + count, 2), np.int64)
    tail = 0
    for label in range(count):
        for end in range(2):
            y, x = ends[label, 2 * end], ends[label, 2 * end + 1]
            if side[y, x] == 2:
                side[y, x] = end
                queue[tail, 0], queue[tail, 1] = y, x
                tail += 1
    head = 0
    while head < tail:
        y, x = queue[head, 0], queue[head, 1]
        head += 1
        for next_y, next_x in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
            if labels[next_y + 1, next_x + 1] == labels[y + 1, x + 1] and side[next_y, next_x] == 2:
                side[next_y, next_x] = side[y, x]
                queue[tail, 0], queue[tail, 1] = next_y, next_x
                tail += 1
    return side == 1


@kernel
def weigh_splits(whole, second, prior):
    """``[count]`` log H of splitting every region; -inf where there is nothing to split.

    Args:
        whole: ``[count,7]`` sums of the regions.
        second: The same of their second halves.
        prior: ``[4]`` float64, log α, a, b and v.
    """
    ratios = np.full(len(whole), -np.inf)
    for label in range(len(whole)):
        if second[label, 0] > 0:
            parts = log_evidence(whole[label] - second[label], prior) + log_evidence(second[label], prior)
            ratios[label] = prior[LOG_ALPHA] + parts - log_evidence(whole[label], prior)
    return ratios


@kernel
def choose_merges(pairs, sums, prior):
    """Every region's best neighbour ``[count]`` (-1: none) and log H ``[count]`` of merging with it."""
    count = len(sums)
    partners, ratios, own = np.full(count, -1, np.int32), np.full(count, -np.inf), np.empty(count)
    for label in range(count):
        own[label] = log_evidence(sums[label], prior)
    for e in range(len(pairs)):
        u, v = min(pairs[e, 0], pairs[e, 1]), max(pairs[e, 0], pairs[e, 1])
        ratio = log_evidence(sums[u] + sums[v], prior) - own[u] - own[v] - prior[LOG_ALPHA] + pair_tie(u, v)
        for label, other in ((u, v), (v, u)):
            if ratio > ratios[label] or (ratio == ratios[label] and other < partners[label]):
                ratios[label], partners[label] = ratio, other
    return partners, ratios


def split(labels, colours, areas, prior, across, most, least=0.0):
    """Split the regions whose log H is above ``least``, at most ``most`` of them, the highest first.

    Args:
        labels: Padded labels 0 to ``len(areas) - 1``, each region 4-connected and none empty; they stay so.
        colours: ``[h,w,3]`` float32.
        areas: ``[count]`` float64 expected area of every region, pixels; halves share it.
        prior: ``[4]`` float64, log α, a, b and v.
        across: Whether the halves are left and right, else top and bottom.
        most: Largest number of splits.
        least: log H.

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
    """Merge pairs of regions that are each other's best neighbour; arguments and result as of :func:`split`."""
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
