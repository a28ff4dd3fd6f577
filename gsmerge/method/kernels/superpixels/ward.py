"""Merge neighbouring regions by Ward's method down to an exact number.

An edge is a pair of neighbouring regions. In each round every region chooses its cheapest neighbour, and two regions
that choose each other are merged. Edges that cost more than a ceiling are put aside, so that a round reads only few
edges. The ceiling is raised when no cheaper edges are left. Rounds merge too many pairs, and some pairs out of order.
For this reason merges are recorded as a tree with heights, and the tree is cut where exactly the wanted number of
regions is left.
"""

from __future__ import annotations

import numpy as np

from gsmerge.method.kernels.signature import COUNT, STATUS, declare, f4, i4, i8, u1
from gsmerge.method.kernels.superpixels.regions import NUM_PIXELS, ROW_COLUMNS, region_rows

# columns of 1 / number of pixels, and of the height of the merge that made a region
INVERSE = 6
MERGE_HEIGHT = 7


# Returns the number of pairs
_adjacent_pairs = declare("adjacent_pairs", COUNT, labels=i4("rows", "columns"), pairs=i4("capacity", 2, out=True))


def adjacent_pairs(labels):
    """Return the labels ``[e,2]`` int32 of all pairs of neighbouring regions of padded ``labels``.

    Pairs may be repeated. There is about one pair for each straight piece of a common border.
    """
    # Each pixel makes at most two pairs, one with the pixel to its right and one with the pixel below
    pairs = np.empty((2 * (labels.shape[0] - 2) * (labels.shape[1] - 2) + 1, 2), np.int32)
    return pairs[: _adjacent_pairs(labels, pairs)]


# Writes the growth of the squared error if two regions merge, n_u n_v / (n_u + n_v) |mean_u - mean_v|²
merge_costs = declare(
    "merge_costs", rows=f4("capacity", ROW_COLUMNS), pairs=i4("count", 2, least=0, below="capacity"),
    costs=f4("count", out=True),
)  # fmt: skip


# Returns the number of nodes
_merge_tree = declare(
    "merge_tree", COUNT, num_leaves=i8(least=0), num_merges=i8(), ceiling=f4(),
    pairs=i4("num_pairs", 2, least=0, below="num_leaves", out=True), costs=f4("num_pairs", out=True),
    parked_pairs=i4("capacity", 2, out=True), parked_costs=f4("capacity", out=True),
    rows=f4("num_nodes", ROW_COLUMNS, out=True), parents=i4("num_nodes", out=True),
    best_costs=f4("num_nodes", out=True),
)  # fmt: skip


def merge_tree(pairs, rows, num_leaves, num_merges, ceiling):
    """Merge neighbouring regions until at least ``num_merges`` pairs are merged, or no pair with a finite cost is left.

    Args:
        pairs: Result of :func:`adjacent_pairs`, which is overwritten.
        rows: ``[2·leaves,8]`` rows of the leaves, behind which the rows of merged regions are written.
        num_leaves: Number of regions at the start.
        num_merges: Wanted number of merges, for which enough regions have to be connected.
        ceiling: First ceiling of costs, which are squared differences of colours times pixels.

    Returns:
        The parent of each leaf and merge, which is -1 at a root, and the number of leaves and merges. Children come
        before their parents.
    """
    parents = np.empty(len(rows), np.int32)
    best_costs = np.empty(len(rows), np.float32)
    # Costs of the edges, and the edges above the ceiling with their costs
    costs = np.empty(len(pairs), np.float32)
    parked_costs = np.empty(len(pairs) + 1, np.float32)
    parked = np.empty((len(pairs) + 1, 2), np.int32)
    num_nodes = _merge_tree(
        num_leaves, num_merges, ceiling, pairs, costs, parked, parked_costs, rows, parents, best_costs
    )
    return parents, num_nodes


# Writes the labels of the leaves to `names`, from 0 without gaps, if only the merges in `keep` are made
_label_leaves = declare(
    "label_leaves", STATUS, parents=i4("num_nodes", below="num_nodes"), keep=u1("num_nodes"),
    names=i4("num_nodes", out=True), num_leaves=i8(),
)  # fmt: skip


def merge_regions(labels, pixels, num_regions, count, spread):
    """Merge the regions of a padded label picture until ``count`` are left, the cheapest pairs first.

    Args:
        labels: Padded labels 0 to ``num_regions - 1``, each region 4-connected.
        count: Wanted number of regions, 1 to ``num_regions``.
        spread: Square root of the weight of squared distances in pixels, float32.

    Returns:
        Padded labels 0 to ``count - 1``.

    Raises:
        ValueError: If labels are out of range, or colours are not finite.
    """
    num_merges = num_regions - count
    if num_merges == 0:
        return labels
    rows = region_rows(labels, pixels, num_regions, 2 * num_regions, spread)
    rows[:num_regions, INVERSE] = 1 / rows[:num_regions, NUM_PIXELS]
    pairs = adjacent_pairs(labels)
    # Edges above a ceiling are put aside at first. The ceiling estimates the cost of the last merge, slightly too high,
    # by a quantile of the costs of all edges, at the share of the regions that merging removes. The estimate is near
    # the cost of the last merge in photos with 1.5 to 3 times as many regions as wanted
    sample_edges = 4096  # the ceiling is estimated from the costs of about this many edges
    step = max(1, len(pairs) // sample_edges)
    costs = np.empty(len(pairs) // step, np.float32)
    merge_costs(rows, pairs[: len(costs) * step : step].copy(), costs)
    rank = min(int(num_merges / num_regions * len(costs)), len(costs) - 1)
    # The kernel adds at most tie_break to each cost, so that pairs of equal cost differ and a round merges many pairs
    # of a flat picture
    tie_break = 1e-7
    ceiling = np.float32(max(1.1 * np.partition(costs, rank)[rank], 2 * tie_break))
    parents, num_nodes = merge_tree(pairs, rows, num_regions, num_merges, ceiling)
    if num_nodes - num_regions < num_merges:
        raise ValueError(f"expected finite colours of regions that touch, to merge {num_regions} down to {count}")
    heights = rows[:num_nodes, MERGE_HEIGHT]
    merge_heights = heights[num_regions:]
    cut_height = np.partition(merge_heights, num_merges - 1)[num_merges - 1]
    keep = heights < cut_height
    ties = np.flatnonzero(merge_heights == cut_height) + num_regions
    # Of several merges at the height of the cut, only the first ones are kept. Children come before their parents, so
    # the children of a kept merge are kept as well
    keep[ties[: num_merges - np.count_nonzero(merge_heights < cut_height)]] = True
    leaf_labels = np.empty(num_nodes, np.int32)
    _label_leaves(parents[:num_nodes], keep.view(np.uint8), leaf_labels, num_regions)
    return np.append(leaf_labels[:num_regions], np.int32(-1))[labels]  # labels of -1, in the frame, read the last entry
