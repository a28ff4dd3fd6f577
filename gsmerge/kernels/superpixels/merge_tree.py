"""Merge the neighbouring regions of a view, one pair after another, cheapest first, down to a single region.

A region's row is float64: its mean colour and place, its number of pixels, the sums of the plane fitted to its depths,
the error of the plane, and its box. The plane is a x + b y + c for 1 / z, fitted with weights z². So the error is
relative to the depth. It is scale-free, additive over regions, and zero for any flat surface.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import STATUS, declare, f4, f8, i4, i8, u1

TREE_PIXELS, PLANE_ERROR, TREE_COLUMNS = 5, 15, 20  # columns of a row after the mean, and its length
OVERSIZE = 1e9  # added to the cost of a merge beyond the largest extent, so that such merges come last


_region_sums = declare(
    "region_sums", STATUS, labels=i4("padded_height", "padded_width"), pixels=f4("height", "width", 3),
    depths=f4("height", "width"), rows=f8("capacity", TREE_COLUMNS, out=True), boxes=i4("count", 4, out=True),
    squares=f8(1, out=True),
)  # fmt: skip


def region_sums(labels, pixels, depths, count, rows):
    """Fill the first ``count`` of ``rows [2·count,20]`` from padded labels; return their colour error.

    Pixels with a depth of 0 do not count. Plane coordinates are relative to the middle of the view.
    """
    squares = np.empty(1)
    _region_sums(labels, pixels, depths, rows, np.empty((count, 4), np.int32), squares)
    return float(squares[0])


# Writes the growth of the error if u and v merge: of colour and depth, and of position times the compactness.
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
    """Merge the regions of one view into a single one, each time the cheapest pair of neighbours.

    Args:
        pairs: ``[e,2]`` int32 neighbouring regions, repeats allowed; together they connect all regions.
        rows: ``[2·leaves,20]`` rows of the leaves first; those of the merged regions are filled in.
        depth_weight: Weight of squared relative depth errors against squared colours.
        compactness: Weight of squared pixels against squared colours.
        max_extent: Regions whose sides reach this many pixels are merged last.

    Returns:
        (parents, heights, growths): ``parents [2·leaves-1]`` int32, -1 at the root, children before parents. The height
        of a merge is its cost, or the largest height of its children if that is larger. The growth is the increase of
        the error of colour and depth by the merge.
    """
    num_nodes, num_pairs = len(rows), len(pairs)
    num_leaves, last = num_nodes // 2, max(num_nodes - 1, 0)
    parents, heads, marks = (np.empty(num_nodes, np.int32) for _ in range(3))
    heights, growths, costs = np.empty(num_nodes), np.empty(num_nodes), np.empty(num_pairs)
    nexts, ends = np.empty(2 * num_pairs, np.int32), np.empty(2 * num_pairs, np.int32)
    heap, places = np.empty(num_pairs, np.int32), np.empty(num_pairs, np.int32)
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
    """Label the leaves from 0, in order of their first leaf, when only the merges in ``keep`` are made."""
    labels, tops, names = np.empty(num_leaves, np.int32), np.empty_like(parents), np.empty_like(parents)
    _cut_labels(parents, keep.view(np.uint8), tops, names, labels)
    return labels
