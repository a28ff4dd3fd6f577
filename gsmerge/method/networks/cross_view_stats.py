"""Measure how well Feature Gaussians agree with the Gaussians of other views, and find neighbours in other views."""

from __future__ import annotations

import math

import numpy as np

from gsmerge.method.geometry.pooling import Members
from gsmerge.method.geometry.transforms import camera_distances, order_others
from gsmerge.method.kernels.elementary import log
from gsmerge.method.kernels.gaussians.cross_view import SUM_COLUMNS, make_tree, nearest_of_others, sum_cross_view
from gsmerge.method.raster.tiled_view import pieces
from gsmerge.runtime.threads import parallel_map, use_threads
from gsmerge.types import SH_C0, Cameras

NUM_STATS = SUM_COLUMNS + 1
NEAR_LOG = 0.03  # largest difference of the logarithms of two depths on the same surface
FAR_LOG = 0.3  # differences of the logarithms of depths are clipped to at most this
MIN_SURFACE_OPACITY = 1 / 255  # a fainter Gaussian is no surface
STATS_ROWS = 8192  # points per task
# The search compares MAX_COMPARED points for each wanted neighbour, or for MIN_NEIGHBORS neighbours if fewer are wanted
MAX_COMPARED = 64
MIN_NEIGHBORS = 16


def cross_view_stats(
    means: np.ndarray, sh0: np.ndarray, views: np.ndarray, members: Members, cameras: Cameras, most: int | None = None
) -> np.ndarray:
    """Measure how well points agree with the Gaussians that they project onto in every other view.

    The points ``means [g,3]`` have base colours ``sh0 [g,1,3]`` and belong to ``views [g]`` int64. A point is compared
    with the ``most`` views nearest to the view of the point, by default with all other views.

    Returns statistics ``[g,7]`` float32, scaled to about 1. Column 0 is the logarithm of the number of views that see
    the point. Of the views that see the point, columns 1 to 3 are the shares with a surface at the point, behind the
    point, and in front of it. Columns 4 and 5 are the mean differences of colours and of relative depths, and column 6
    is the logarithm of the number of all views.
    """
    stats = np.zeros((len(means), NUM_STATS), np.float32)
    stats[:, -1] = math.log(len(cameras)) / 4
    if len(means) == 0:
        return stats
    points, colors = np.ascontiguousarray(means, np.float64), np.ascontiguousarray(SH_C0 * sh0[:, 0])
    viewmats, Ks = (np.ascontiguousarray(array, np.float64) for array in (cameras.viewmats, cameras.Ks))
    size = (cameras.width, cameras.height)
    limits = (SH_C0, NEAR_LOG, FAR_LOG, MIN_SURFACE_OPACITY)
    sums = np.zeros((len(points), SUM_COLUMNS))
    m = members
    neighbors = np.sort(order_others(camera_distances(cameras))[:, :most], 1).astype(np.int32)

    def add_sums(begin: int) -> None:
        """Compare the points from ``begin`` on with the views, and add the results to ``sums``."""
        end = min(begin + STATS_ROWS, len(points))
        sum_cross_view(
            points, colors, views, neighbors, viewmats, Ks, *size, m.fronts, m.means, m.opacities, m.sh0, *limits,
            begin, end, sums,
        )  # fmt: skip

    parallel_map(add_sums, range(0, len(points), STATS_ROWS))
    seen, same, behind, in_front, color_differences, depth_differences = sums.T
    num_seen = np.maximum(seen, 1)
    num_same = np.maximum(same, 1)
    shares = [same / num_seen, behind / num_seen, in_front / num_seen, color_differences / num_same]
    stats[:, :-1] = np.stack([log(1 + seen) / 3, *shares, depth_differences / num_seen / FAR_LOG], 1)
    return stats


def nearest_of_other_views(means: np.ndarray, views: np.ndarray, count: int) -> np.ndarray:
    """Return, for each point, the nearest points of other views ``[g,count]`` int64, the nearest first.

    The finite points ``means [g,3]`` float64 belong to ``views [g]``. If a number in ``views`` is negative, the point
    belongs to no view, and all other points count as points of other views. Rows with fewer than ``count`` points end
    with -1. The search for a point ends after ``MAX_COMPARED`` times ``count`` comparisons, at least 1,024. The search
    is limited because most compared points are of the point's own view, and Gaussians farther away do not overlap. The
    paper matches neighbours of other views in section 4.4.
    """
    num = len(means)
    neighbors, means = np.empty((num, count), np.int64), np.ascontiguousarray(means)
    max_compared = MAX_COMPARED * max(count, MIN_NEIGHBORS)
    order, axes, splits = make_tree(means)
    with use_threads() as threads:
        parallel_map(
            lambda span: nearest_of_others(means, views, order, axes, splits, *span, max_compared, neighbors),
            pieces(num, threads),
        )
    return neighbors
