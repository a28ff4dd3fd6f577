"""Nearest points of other views: a balanced k-d tree in arrays, searched without recursion.

Node i of the tree is a run of ``order``; its children 2 i + 1 and 2 i + 2 are the halves of the run, which is sorted
about its middle along one axis.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.gaussians.select import partition
from gsmerge.kernels.jit import kernel

LEAF = 16  # points up to which a run is not divided
DEPTH = 64  # of the stack: the tree of 2^60 points


@kernel
def _widest_axis(points, order, low, high):
    """Axis along which the points of a run are spread farthest."""
    best, widest = 0, -1.0
    for axis in range(3):
        least = most = points[order[low], axis]
        for i in range(low + 1, high):
            value = points[order[i], axis]
            least, most = min(least, value), max(most, value)
        if most - least > widest:
            best, widest = axis, most - least
    return best


@kernel
def build_tree(points, order, axes, splits):
    """Build the tree of finite points ``[n,3]``.

    Args:
        order: ``[n]`` int64 rows of the points, in any order; reordered.
        axes: ``[nodes]`` int8, written: along which axis each node is divided.
        splits: ``[nodes]`` float64, written: where.
    """
    nodes, lows, highs = np.empty(DEPTH, np.int64), np.empty(DEPTH, np.int64), np.empty(DEPTH, np.int64)
    nodes[0], lows[0], highs[0] = 0, 0, order.shape[0]
    top = 1
    while top > 0:
        top -= 1
        node, low, high = nodes[top], lows[top], highs[top]
        if high - low <= LEAF:
            continue
        axis, middle = _widest_axis(points, order, low, high), (low + high) // 2
        partition(points[:, axis], order, low, high, middle)
        axes[node], splits[node] = axis, points[order[middle], axis]
        for side in range(2):
            nodes[top] = 2 * node + 1 + side
            lows[top], highs[top] = (middle, high) if side == 1 else (low, middle)
            top += 1


@kernel
def nearest_of_others(points, views, order, axes, splits, first, last, most, out):
    """Write the nearest points of other views than the own to rows ``first`` to ``last`` of ``out [n,k]``.

    Args:
        views: ``[n]`` int64; points of views below 0 belong to none, and are of another one to each other.
        order: As :func:`build_tree` left it, as are ``axes`` and ``splits``.
        most: Points that are looked at for each, whole leaves of the tree.
        out: ``[n,k]`` int64: nearest first, -1 where there are fewer.
    """
    count = out.shape[1]
    distances, near, query = np.empty(count), np.empty(3), np.empty(3)
    nodes, lows, highs = np.empty(DEPTH, np.int64), np.empty(DEPTH, np.int64), np.empty(DEPTH, np.int64)
    bounds, offsets = np.empty(DEPTH), np.empty((DEPTH, 3))
    for row in range(first, last):
        view = views[row]
        for axis in range(3):
            query[axis], offsets[0, axis] = points[row, axis], 0.0
        for i in range(count):
            distances[i], out[row, i] = np.inf, -1
        nodes[0], lows[0], highs[0], bounds[0] = 0, 0, order.shape[0], 0.0
        top, looked = 1, 0
        while top > 0 and looked < most:
            top -= 1
            node, low, high, bound = nodes[top], lows[top], highs[top], bounds[top]
            if bound >= distances[count - 1]:
                continue
            for axis in range(3):
                near[axis] = offsets[top, axis]
            while high - low > LEAF:  # to the leaf of this side; the other sides wait
                axis, middle = axes[node], (low + high) // 2
                away = query[axis] - splits[node]
                nodes[top] = 2 * node + (1 if away > 0 else 2)
                lows[top], highs[top] = (low, middle) if away > 0 else (middle, high)
                bounds[top] = bound - near[axis] * near[axis] + away * away
                for other in range(3):
                    offsets[top, other] = away if other == axis else near[other]
                top += 1
                node = 2 * node + (2 if away > 0 else 1)
                low, high = (middle, high) if away > 0 else (low, middle)
            looked += high - low
            for i in range(low, high):
                k = order[i]
                if k == row or (views[k] == view and view >= 0):
                    continue
                x, y, z = points[k, 0] - query[0], points[k, 1] - query[1], points[k, 2] - query[2]
                distance = x * x + y * y + z * z
                if distance < distances[count - 1]:
                    place = count - 1
                    while place > 0 and distances[place - 1] > distance:
                        distances[place], out[row, place] = distances[place - 1], out[row, place - 1]
                        place -= 1
                    distances[place], out[row, place] = distance, k
