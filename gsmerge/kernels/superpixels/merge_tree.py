"""Merge the neighbouring regions of a view one pair after the other, cheapest first, down to a single one.

A region's row is float64: its mean colour and place, its number of pixels, ten sums of the plane fitted to its
depths, that plane's error, and its box. The plane is a x + b y + c for 1 / z, fitted with weights z², so that the
error is that of z relative to the plane: scale-free, additive over regions, and zero for any flat surface.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.jit import kernel

# Columns: 0-2 mean colour, 3-4 mean y and x (pixels), then these; nine from PLANE on are sums over the pixels of z²,
# z²x, z²y, z²xx, z²xy, z²yy, z, zx, zy
NUM_PIXELS, PLANE, PLANE_ERROR, BOX, ROW = 5, 6, 15, 16, 20
SLOPE_RIDGE = 1e-3  # square pixels; holds the slopes of planes through fewer than three points
NEVER = 1e18  # box of a region without pixels; sums of two of them still have finite squares
OVERSIZE = 1e9  # added to the cost of a merge beyond the largest extent: these come last, in their own order


@kernel
def _plane_error(n, w, wx, wy, wxx, wxy, wyy, z, zx, zy):
    """Least sum of (1 - z (a x + b y + c))² over n pixels, with a ridge on the slopes."""
    if w <= 0.0:
        return 0.0
    x, y = wx / w, wy / w
    ridge = SLOPE_RIDGE * w
    sxx, sxy, syy = wxx - wx * x + ridge, wxy - wx * y, wyy - wy * y + ridge
    bx, by = zx - x * z, zy - y * z
    explained = (syy * bx * bx - 2.0 * sxy * bx * by + sxx * by * by) / (sxx * syy - sxy * sxy)
    return max(n - z * z / w - explained, 0.0)


@kernel
def region_sums(labels, pixels, depths, count, rows):
    """Fill the first ``count`` of ``rows [2·count,20]`` from padded labels; returns their error of colour.

    Pixels with depth 0 count for nothing. Coordinates of the plane are those from the middle of the view.
    """
    height, width, _ = pixels.shape
    squares = 0.0
    rows[:count] = 0.0
    for i in range(count):
        rows[i, BOX], rows[i, BOX + 1], rows[i, BOX + 2], rows[i, BOX + 3] = NEVER, -NEVER, NEVER, -NEVER
    for v in range(height):
        y = v + 0.5 - 0.5 * height
        for u in range(width):
            z = np.float64(depths[v, u])
            if z <= 0.0:
                continue
            x = u + 0.5 - 0.5 * width
            row = rows[labels[v + 1, u + 1]]
            for c in range(3):
                row[c] += pixels[v, u, c]
                squares += np.float64(pixels[v, u, c]) ** 2
            row[3] += y
            row[4] += x
            row[NUM_PIXELS] += 1.0
            zz = z * z
            row[PLANE] += zz
            row[PLANE + 1] += zz * x
            row[PLANE + 2] += zz * y
            row[PLANE + 3] += zz * x * x
            row[PLANE + 4] += zz * x * y
            row[PLANE + 5] += zz * y * y
            row[PLANE + 6] += z
            row[PLANE + 7] += z * x
            row[PLANE + 8] += z * y
            row[BOX], row[BOX + 1] = min(row[BOX], y), max(row[BOX + 1], y)
            row[BOX + 2], row[BOX + 3] = min(row[BOX + 2], x), max(row[BOX + 3], x)
    for i in range(count):
        row = rows[i]
        n = row[NUM_PIXELS]
        if n > 0.0:
            for c in range(5):
                row[c] /= n
        squares -= n * (row[0] * row[0] + row[1] * row[1] + row[2] * row[2])
        s = row[PLANE:PLANE_ERROR]
        row[PLANE_ERROR] = _plane_error(n, s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], s[8])
    return max(squares, 0.0)


@kernel(part=True)
def merge_growth(rows, u, v, depth_weight, compactness):
    """Growth of the error if u and v become one: of colour and depth, and of place times ``compactness``."""
    a, b = rows[u], rows[v]
    n_a, n_b = a[NUM_PIXELS], b[NUM_PIXELS]
    if n_a == 0.0 or n_b == 0.0:
        return 0.0, 0.0
    d0, d1, d2, d3, d4 = a[0] - b[0], a[1] - b[1], a[2] - b[2], a[3] - b[3], a[4] - b[4]
    ward = n_a * n_b / (n_a + n_b)
    p = PLANE
    plane = _plane_error(
        n_a + n_b, a[p] + b[p], a[p + 1] + b[p + 1], a[p + 2] + b[p + 2], a[p + 3] + b[p + 3], a[p + 4] + b[p + 4],
        a[p + 5] + b[p + 5], a[p + 6] + b[p + 6], a[p + 7] + b[p + 7], a[p + 8] + b[p + 8],
    )  # fmt: skip
    bend = max(plane - a[PLANE_ERROR] - b[PLANE_ERROR], 0.0)
    return ward * (d0 * d0 + d1 * d1 + d2 * d2) + depth_weight * bend, ward * compactness * (d3 * d3 + d4 * d4)


@kernel
def _merge_cost(rows, u, v, depth_weight, compactness, max_extent):
    error, place = merge_growth(rows, u, v, depth_weight, compactness)
    a, b = rows[u], rows[v]
    extent = max(
        max(a[BOX + 1], b[BOX + 1]) - min(a[BOX], b[BOX]), max(a[BOX + 3], b[BOX + 3]) - min(a[BOX + 2], b[BOX + 2])
    )
    return error + place + (OVERSIZE if extent >= max_extent else 0.0)


@kernel
def _join(rows, u, v, node):
    """The row of the union of u and v."""
    a, b, row = rows[u], rows[v], rows[node]
    total = a[NUM_PIXELS] + b[NUM_PIXELS]
    share = a[NUM_PIXELS] / total if total > 0.0 else 0.5
    for i in range(NUM_PIXELS):
        row[i] = b[i] + share * (a[i] - b[i])
    for i in range(NUM_PIXELS, PLANE_ERROR):
        row[i] = a[i] + b[i]
    s = row[PLANE:PLANE_ERROR]
    row[PLANE_ERROR] = _plane_error(total, s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], s[8])
    row[BOX], row[BOX + 1] = min(a[BOX], b[BOX]), max(a[BOX + 1], b[BOX + 1])
    row[BOX + 2], row[BOX + 3] = min(a[BOX + 2], b[BOX + 2]), max(a[BOX + 3], b[BOX + 3])


@kernel
def _link(pairs, heads, nexts, ends):
    """Lists of the half-edges that leave each region, every pair once -> number of edges; edge e has 2e and 2e + 1."""
    num_edges = 0
    for i in range(pairs.shape[0]):
        u, v = pairs[i, 0], pairs[i, 1]
        half = heads[u]
        while half >= 0 and ends[half] != v:
            half = nexts[half]
        if half >= 0:
            continue
        for side in range(2):
            half = 2 * num_edges + side
            ends[half] = v if side == 0 else u
            owner = u if side == 0 else v
            nexts[half], heads[owner] = heads[owner], half
        num_edges += 1
    return num_edges


@kernel
def _before(costs, d, e):
    return costs[d] < costs[e] or (costs[d] == costs[e] and d < e)


@kernel
def _settle(heap, places, costs, size, edge):
    """Move an edge of the heap to where its cost belongs, up or down."""
    at = places[edge]
    while at > 0:
        above = (at - 1) // 2
        if not _before(costs, edge, heap[above]):
            break
        heap[at] = heap[above]
        places[heap[at]] = at
        at = above
    while True:
        below = 2 * at + 1
        if below >= size:
            break
        if below + 1 < size and _before(costs, heap[below + 1], heap[below]):
            below += 1
        if not _before(costs, heap[below], edge):
            break
        heap[at] = heap[below]
        places[heap[at]] = at
        at = below
    heap[at] = edge
    places[edge] = at


@kernel
def _remove(heap, places, costs, size, edge):
    """Take an edge out of the heap -> its new size."""
    at, last = places[edge], heap[size - 1]
    places[edge] = -1
    if last != edge:
        heap[at], places[last] = last, at
        _settle(heap, places, costs, size - 1, last)
    return size - 1


@kernel
def merge_order(pairs, rows, depth_weight, compactness, max_extent):
    """All merges of the regions of one view, each time the cheapest pair of neighbours.

    Args:
        pairs: ``[e,2]`` int32 neighbouring regions, repeats allowed; together they connect all regions.
        rows: ``[2·leaves,20]`` rows of the leaves first; those of the merged regions are filled in.
        depth_weight: Weight of squared relative depth errors against squared colours.
        compactness: Weight of squared pixels against squared colours.
        max_extent: Regions whose sides reach this many pixels are merged last.

    Returns:
        (parents, heights, growths): ``parents [2·leaves-1]`` int32, -1 at the root, children before parents; per
        merge its cost or that of its dearest child, and how much the error of colour and depth grows by it.
    """
    num_leaves, num_pairs = rows.shape[0] // 2, pairs.shape[0]
    parents = np.full(2 * num_leaves - 1, -1, np.int32)
    heights, growths = np.zeros(num_leaves - 1), np.zeros(num_leaves - 1)
    heads, marks = np.full(2 * num_leaves, -1, np.int32), np.full(2 * num_leaves, -1, np.int32)
    nexts, ends = np.empty(2 * num_pairs, np.int32), np.empty(2 * num_pairs, np.int32)
    size = _link(pairs, heads, nexts, ends)
    heap, places, costs = np.arange(size), np.arange(size), np.empty(size)
    for e in range(size):
        costs[e] = _merge_cost(rows, ends[2 * e], ends[2 * e + 1], depth_weight, compactness, max_extent)
        _settle(heap, places, costs, e + 1, e)
    node = num_leaves
    while size > 0:
        edge = heap[0]
        u, v, height = ends[2 * edge], ends[2 * edge + 1], costs[edge]
        size = _remove(heap, places, costs, size, edge)
        growths[node - num_leaves] = merge_growth(rows, u, v, depth_weight, compactness)[0]
        _join(rows, u, v, node)
        for child in (u, v):
            parents[child] = node
            if child >= num_leaves:
                height = max(height, heights[child - num_leaves])
            half = heads[child]
            while half >= 0:
                following, other, e = nexts[half], ends[half], half // 2
                if places[e] >= 0:
                    if marks[other] == node:  # both u and v had this neighbour: one edge is enough
                        size = _remove(heap, places, costs, size, e)
                    else:
                        marks[other] = node
                        ends[half ^ 1] = node
                        nexts[half], heads[node] = heads[node], half
                        costs[e] = _merge_cost(rows, node, other, depth_weight, compactness, max_extent)
                        _settle(heap, places, costs, size, e)
                half = following
        heights[node - num_leaves] = height
        node += 1
    return parents, heights, growths


@kernel
def cut_labels(parents, keep, num_leaves):
    """Labels of the leaves, dense from 0 in order of their first leaf, when only the merges in ``keep`` are made."""
    num_nodes = parents.shape[0]
    tops = np.arange(num_nodes)
    for node in range(num_nodes - 1, -1, -1):
        if parents[node] >= 0 and keep[parents[node] - num_leaves]:
            tops[node] = tops[parents[node]]
    names, labels, count = np.full(num_nodes, -1, np.int32), np.empty(num_leaves, np.int32), 0
    for leaf in range(num_leaves):
        if names[tops[leaf]] < 0:
            names[tops[leaf]] = count
            count += 1
        labels[leaf] = names[tops[leaf]]
    return labels
