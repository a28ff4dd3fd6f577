"""Ward merging of neighbouring regions down to an exact number.

Each round every region finds its cheapest neighbour, and mutual choices merge. Edges dearer than a ceiling are
parked meanwhile, so that a round looks only at the few edges that matter; the ceiling rises when the cheap ones run
dry. Rounds merge a few pairs out of order and too many, so the merges are recorded as a tree with heights, and the
tree is cut where exactly the wanted number of regions is left.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.jit import kernel
from gsmerge.kernels.superpixels.regions import NUM_PIXELS, region_rows

INVERSE, HEIGHT = 6, 7  # columns of a region's row: 1 / n, and the cost at which it came to be
CEILING_GROWTH = 1.5
NUM_SAMPLES = 4096  # edges whose costs tell where to put the first ceiling
RETURN_MARGIN = 1.5  # a parked edge comes back when its old cost is at most this far above the ceiling
TIE_BREAK = 1e-7  # squared colour; spreads equal costs, so that flat pictures do not merge one pair a round


@kernel(part=True)
def merge_cost(rows, u, v):
    """Growth of the squared error if u and v become one: n_u n_v / (n_u + n_v) |mean_u - mean_v|²."""
    d0, d1, d2 = rows[u, 0] - rows[v, 0], rows[u, 1] - rows[v, 1], rows[u, 2] - rows[v, 2]
    d3, d4 = rows[u, 3] - rows[v, 3], rows[u, 4] - rows[v, 4]
    return (d0 * d0 + d1 * d1 + d2 * d2 + d3 * d3 + d4 * d4) / (rows[u, INVERSE] + rows[v, INVERSE])


@kernel(part=True)
def pair_tie(u, v):
    """A small number in (0, TIE_BREAK] that depends on the pair only."""
    mixed = np.uint32(u) * np.uint32(2654435761) ^ np.uint32(v) * np.uint32(40503)
    mixed ^= mixed >> np.uint32(15)
    return np.float32(TIE_BREAK / 1024) * np.float32((mixed & np.uint32(1023)) + np.uint32(1))


@kernel
def adjacent_pairs(labels):
    """``[e,2]`` int32: labels of neighbouring regions, about one row per straight piece of common border."""
    height, width = labels.shape[0] - 2, labels.shape[1] - 2
    pairs = np.empty((2 * height * width + 1, 2), np.int32)
    num_pairs = 0
    for y in range(1, height + 1):
        for x in range(1, width + 1):
            u, east, south = labels[y, x], labels[y, x + 1], labels[y + 1, x]
            # Written in any case and kept by the count: a branch here would be mispredicted half of the time.
            pairs[num_pairs, 0], pairs[num_pairs, 1] = u, east
            num_pairs += (east != u) & (east >= 0) & ((labels[y - 1, x] != u) | (labels[y - 1, x + 1] != east))
            pairs[num_pairs, 0], pairs[num_pairs, 1] = u, south
            num_pairs += (south != u) & (south >= 0) & ((labels[y, x - 1] != u) | (labels[y + 1, x - 1] != south))
    return pairs[:num_pairs]


@kernel
def _sample_costs(pairs, rows, step):
    costs = np.empty(len(pairs) // step, np.float32)
    for i in range(len(costs)):
        costs[i] = merge_cost(rows, pairs[i * step, 0], pairs[i * step, 1])
    return costs


def _first_ceiling(pairs, rows, share):
    """A little above the dearest merge that will be needed when ``share`` of the regions are to vanish.

    Measured on photos, the share of the edges that are cheaper at the start than that merge is close to the share
    of the regions that vanish, when the start is an over-split by 1.5 to 3.
    """
    costs = _sample_costs(pairs, rows, max(1, len(pairs) // NUM_SAMPLES))
    rank = min(int(share * len(costs)), len(costs) - 1)
    return np.float32(max(1.1 * np.partition(costs, rank)[rank], 2 * TIE_BREAK))


@kernel
def _join(rows, parents, u, v, node, height):
    """Make ``node`` the parent of u and v."""
    n_u, n_v = rows[u, NUM_PIXELS], rows[v, NUM_PIXELS]
    total = n_u + n_v
    share = n_u / total
    for i in range(5):
        rows[node, i] = rows[v, i] + share * (rows[u, i] - rows[v, i])
    rows[node, NUM_PIXELS] = total
    rows[node, INVERSE] = np.float32(1) / total
    rows[node, HEIGHT] = max(height, rows[u, HEIGHT], rows[v, HEIGHT])
    parents[u] = parents[v] = node


@kernel
def _weigh(pairs, costs, num_pairs, parked, parked_costs, num_parked, rows, parents, ceiling, best_costs):
    """Cost of every edge and each region's lowest; drops inner edges and parks dear ones on the way.

    Edges are written to both lists and kept by the counts: branches here would be mispredicted half of the time.
    """
    kept, never = 0, np.float32(np.inf)
    for e in range(num_pairs):
        u, v = pairs[e, 0], pairs[e, 1]
        u = parents[u] if parents[u] >= 0 else u
        v = parents[v] if parents[v] >= 0 else v
        cost = merge_cost(rows, u, v) + pair_tie(u, v)
        outer, cheap = u != v, cost <= ceiling
        parked[num_parked, 0], parked[num_parked, 1], parked_costs[num_parked] = u, v, cost
        num_parked += outer & (not cheap)
        pairs[kept, 0], pairs[kept, 1], costs[kept] = u, v, cost
        kept += outer & cheap
        bid = cost if outer & cheap else never
        best_costs[u] = min(best_costs[u], bid)
        best_costs[v] = min(best_costs[v], bid)
    return kept, num_parked


@kernel
def _join_mutual(pairs, costs, num_pairs, rows, parents, num_nodes, best_costs):
    """Merge the two regions of every edge that is the cheapest of both; returns the number of nodes."""
    for e in range(num_pairs):
        u, v, cost = pairs[e, 0], pairs[e, 1], costs[e]
        if (cost == best_costs[u]) & (cost == best_costs[v]) and parents[u] < 0 and parents[v] < 0:
            _join(rows, parents, u, v, num_nodes, cost)
            num_nodes += 1
    for e in range(num_pairs):
        best_costs[pairs[e, 0]] = np.inf
        best_costs[pairs[e, 1]] = np.inf
    return num_nodes


@kernel
def _unpark(pairs, num_pairs, parked, parked_costs, num_parked, parents, ceiling):
    """Bring back the parked edges that the new ceiling may admit."""
    left = 0
    for e in range(num_parked):
        u, v = parked[e, 0], parked[e, 1]
        while parents[u] >= 0:
            u = parents[u]
        while parents[v] >= 0:
            v = parents[v]
        if u == v:
            continue
        if parked_costs[e] <= ceiling * RETURN_MARGIN:
            pairs[num_pairs, 0], pairs[num_pairs, 1] = u, v
            num_pairs += 1
        else:
            parked[left, 0], parked[left, 1], parked_costs[left] = u, v, parked_costs[e]
            left += 1
    return num_pairs, left


@kernel
def merge_tree(pairs, rows, num_leaves, num_merges, ceiling):
    """Merge until at least ``num_merges`` pairs are joined.

    Args:
        pairs: From :func:`adjacent_pairs`; overwritten.
        rows: ``[2·leaves,8]`` rows of the leaves; those of the merged regions are filled in.
        num_merges: Merges wanted; the regions must be connected.
        ceiling: First ceiling of the cost, squared colour times pixels.

    Returns:
        (parents, num_nodes): ``parents[i]`` is -1 at a root; children come before their parents.
    """
    num_pairs, num_parked, num_nodes = len(pairs), 0, num_leaves
    parents, best_costs = np.empty(2 * num_leaves, np.int32), np.empty(2 * num_leaves, np.float32)
    for i in range(2 * num_leaves):
        parents[i], best_costs[i] = -1, np.inf
    costs, parked_costs = np.empty(num_pairs, np.float32), np.empty(num_pairs + 1, np.float32)
    parked = np.empty((num_pairs + 1, 2), np.int32)
    while True:
        num_pairs, num_parked = _weigh(
            pairs, costs, num_pairs, parked, parked_costs, num_parked, rows, parents, ceiling, best_costs
        )
        before = num_nodes
        num_nodes = _join_mutual(pairs, costs, num_pairs, rows, parents, num_nodes, best_costs)
        if num_nodes == before:
            if num_nodes - num_leaves >= num_merges or num_parked == 0:
                return parents, num_nodes
            ceiling *= np.float32(CEILING_GROWTH)
            num_pairs, num_parked = _unpark(pairs, num_pairs, parked, parked_costs, num_parked, parents, ceiling)


@kernel
def _cut_labels(parents, keep, num_leaves):
    """Labels of the leaves, dense from 0, when only the merges in ``keep`` are made."""
    num_nodes, count = len(parents), 0
    labels = np.empty(num_nodes, np.int32)
    for node in range(num_nodes - 1, -1, -1):
        if parents[node] >= 0 and keep[parents[node]]:
            labels[node] = labels[parents[node]]
        elif keep[node] or node < num_leaves:
            labels[node] = count
            count += 1
    return labels[:num_leaves]


def merge_regions(labels, pixels, num_regions, count, spread):
    """Merge the regions of a padded label picture down to ``count``, cheapest first.

    Args:
        labels: Padded labels 0 to ``num_regions - 1``, each region 4-connected.
        count: Regions wanted, 1 to ``num_regions``.
        spread: Square root of the weight of squared pixels against squared colours, float32.

    Returns:
        Padded labels 0 to ``count - 1``.
    """
    num_merges = num_regions - count
    if num_merges == 0:
        return labels
    rows = region_rows(labels, pixels, num_regions, 2 * num_regions, spread)
    rows[:num_regions, INVERSE] = 1 / rows[:num_regions, NUM_PIXELS]
    pairs = adjacent_pairs(labels)
    ceiling = _first_ceiling(pairs, rows, num_merges / num_regions)
    parents, num_nodes = merge_tree(pairs, rows, num_regions, num_merges, ceiling)
    heights = rows[:num_nodes, HEIGHT]
    merges = heights[num_regions:]
    cut = np.partition(merges, num_merges - 1)[num_merges - 1]
    keep = heights < cut
    ties = np.flatnonzero(merges == cut) + num_regions
    # Children come before their parents, so the first of the equal ones never lack a child.
    keep[ties[: num_merges - np.count_nonzero(merges < cut)]] = True
    of_leaf = _cut_labels(parents[:num_nodes], keep, num_regions)
    return np.append(of_leaf, np.int32(-1))[labels]  # the frame's -1 reads the last entry
