"""Merge neighbouring regions of a view, the cheapest pair first, down to a single region.

A region has a row of float64 numbers: its mean colour and position, its number of pixels, the sums from which a plane
is fitted, the error of this plane, and a box. The plane is 1 / z = a x + b y + c, where z are the depths. The plane is
fitted with weights z², so its error is relative to the depth. The error of a plane does not depend on the scale of the
world, adds up over regions, and is zero for any flat surface.
"""

from __future__ import annotations

import numpy as np

from gsmerge.method.kernels.signature import STATUS, declare, f4, f8, i4, i8, u1

# columns of number of pixels and plane's error, row length
TREE_PIXELS = 5
PLANE_ERROR = 15
TREE_COLUMNS = 20
OVERSIZE = 1e9  # added to the cost of a merge that makes too large a region, so that such merges come last


_region_sums = declare(
    "region_sums", STATUS, labels=i4("padded_height", "padded_width"), pixels=f4("height", "width", 3),
    depths=f4("height", "width"), rows=f8("capacity", TREE_COLUMNS, out=True), boxes=i4("count", 4, out=True),
    squares=f8(1, out=True),
)  # fmt: skip


def region_sums(labels, pixels, depths, count, rows):
    """Describe the regions of padded labels in the first ``count`` rows, and return their colour error.

    ``rows`` are ``[2·count,20]``, to have room for merged regions. Pixels with a depth of 0 do not count. The
    coordinates x and y of planes are relative to the middle of the view.
    """
    squares = np.empty(1)
    _region_sums(labels, pixels, depths, rows, np.empty((count, 4), np.int32), squares)
    return float(squares[0])


# Writes by how much two errors grow if regions u and v merge. The first error is the error of colour and depth, and the
# second is the error of position times the compactness
merge_growth = declare(
    "merge_growth", rows=f8("capacity", TREE_COLUMNS), u=i8(least=0, below="capacity"), v=i8(least=0, below="capacity"),
    depth_weight=f8(), compactness=f8(), growth=f8(2, out=True),
)  # fmt: skip


_merge_order = declare(
    "merge_order", STATUS, num_leaves=i8(least=0), pairs=i4("num_pairs", 2, least=0, below="num_leaves"),
    rows=f8("num_nodes", TREE_COLUMNS, out=True), depth_weight=f8(), compactness=f8(), max_extent=f8(),
    parents=i4("num_nodes", out=True), heights=f8("num_nodes", out=True), growths=f8("num_nodes", out=True),
    heads=i4("num_nodes", out=True), marks=i4("num_nodes", out=True), nexts=i4("num_halves", out=True),
    ends=i4("num_halves", out=True), heap=i4("num_pairs", out=True), places=i4("num_pairs", out=True),
    costs=f8("num_pairs", out=True),
)  # fmt: skip


def merge_order(pairs, rows, depth_weight, compactness, max_extent):
    """Merge the regions of a view, the cheapest pair of neighbours first, into one region, and return the tree.

    Args:
        pairs: ``[e,2]`` int32 neighbouring regions, which connect all regions. A pair may be repeated.
        rows: ``[2·leaves,20]`` rows of the leaves, behind which the rows of merged regions are written.
        depth_weight: Weight of squared relative errors of depth, relative to squared differences of colours.
        compactness: Weight of squared distances in pixels, relative to squared differences of colours.
        max_extent: Merges come last if a side of the merged region has at least so many pixels.

    Returns:
        The parent ``[2·leaves-1]`` int32 of each leaf and merge, which is -1 at the root, and the height and the growth
        of each merge. Children come before their parents. The height of a merge is its cost, or the largest height of
        its children if that is larger. The growth is the increase of the error of colour and depth.
    """
    num_nodes = len(rows)
    num_pairs = len(pairs)
    num_leaves = num_nodes // 2
    last = max(num_nodes - 1, 0)
    parents, heads, marks = (np.empty(num_nodes, np.int32) for _ in range(3))
    heights = np.empty(num_nodes)
    growths = np.empty(num_nodes)
    costs = np.empty(num_pairs)
    # Scratch for the pairs of each region, and for a heap of all pairs by their costs
    nexts = np.empty(2 * num_pairs, np.int32)
    ends = np.empty(2 * num_pairs, np.int32)
    heap = np.empty(num_pairs, np.int32)
    places = np.empty(num_pairs, np.int32)
    _merge_order(
        num_leaves, pairs, rows, depth_weight, compactness, max_extent, parents, heights, growths, heads, marks,
        nexts, ends, heap, places, costs,
    )  # fmt: skip
    return parents[:last], heights[num_leaves:last], growths[num_leaves:last]


_cut_labels = declare(
    "cut_labels", STATUS, parents=i4("num_nodes"), keep=u1("num_merges"), tops=i4("num_nodes", out=True),
    names=i4("num_nodes", out=True), labels=i4("num_leaves", out=True),
)  # fmt: skip


def cut_labels(parents, keep, num_leaves):
    """Return the label of each leaf if only the merges in the mask ``keep`` are made.

    Labels are numbered from 0, in the order of the first leaf of each region.
    """
    labels = np.empty(num_leaves, np.int32)
    tops = np.empty_like(parents)
    names = np.empty_like(parents)
    _cut_labels(parents, keep.view(np.uint8), tops, names, labels)
    return labels
