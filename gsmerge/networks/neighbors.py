"""Nearest Feature Gaussians in space, for matching and for the refiner."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.gaussians.nearest import LEAF, build_tree, nearest_of_others
from gsmerge.render.plan import pieces
from gsmerge.runtime.threads import parallel_map, use_threads

MOST = 64  # points that are looked at for each neighbour that is asked for


def nearest_of_other_views(means: np.ndarray, views: np.ndarray, count: int) -> np.ndarray:
    """``[g,count]`` int64 nearest points of other views than the own (paper section 4.4), nearest first.

    -1 where there are fewer, or where ``MOST`` times as many points, most of them of the own view, are nearer: what
    lies behind those overlaps nothing.

    Args:
        means: ``[g,3]`` float64, finite.
        views: ``[g]`` int64; points of views below 0 belong to none, and count as of another one.
        count: Neighbours of each.
    """
    num = len(means)
    num_nodes = 4 << (num // LEAF).bit_length()
    order, neighbors = np.arange(num), np.empty((num, count), np.int64)
    axes, splits = np.empty(num_nodes, np.int8), np.empty(num_nodes)
    means = np.ascontiguousarray(means)
    build_tree(means, order, axes, splits)
    with use_threads() as threads:
        parallel_map(
            lambda span: nearest_of_others(means, views, order, axes, splits, *span, MOST * count, neighbors),
            pieces(num, threads),
        )
    return neighbors


def nearest_points(means: np.ndarray, count: int) -> np.ndarray:
    """``[n,count]`` int64 nearest other points of ``means [n,3]``, nearest first; -1 where there are fewer."""
    return nearest_of_other_views(means, np.full(len(means), -1, np.int64), count)
