"""Gaussians -> fewer Gaussians by their positions and colours alone, for scenes without views.

Neighbours within a cell of a k-d tree are merged pair by pair, the cheapest pairs of all cells first, in rounds with
different cells. Masses, which are opacity times visible area, add up, so a surface stays as opaque as it was. If the
opacity would exceed one, scales grow instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmerge.geometry.pooling import FULL_MATRIX, MAX_OPACITY, principal_axes
from gsmerge.kernels.elementary import log
from gsmerge.kernels.elementary import power as power_of
from gsmerge.kernels.gaussians.cross_view import make_tree
from gsmerge.kernels.gaussians.pairs import CELL, agglomerate, gaussian_moments, merge_pairs
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Gaussians
from gsmerge.values.arrays import to_float32

# Chosen on training scenes by the PSNR of views from random cameras (docs/internals/notebook.md#bare-files)
COLOR_WEIGHT = 0.6  # weight of squared distances of harmonics of degree 0, relative to costs in nats
# Costs are multiplied by a power of the masses. The first power favours large parts of the pictures, for scenes; the
# second favours detail, for objects
POWERS = 1.0, 0.3
FLATNESS = 0.01  # least scale, relative to the largest, so that the logarithm of the volume stays finite
MIN_OPACITY = 1e-4  # least opacity of Gaussians that are merged, so that masses stay positive
MOST_WIDENING = 0.05  # most growth of scales for each doubling of the merged number; without it gaps would open
CELLS_PER_TASK = 256  # cells that a thread merges at a time
NEXT_AXIS = [1, 2, 0]  # the axis after each axis, so that products with it cover the three pairs of axes


@dataclass(eq=False)
class Cloud:
    """Moments of n Gaussians, the form in which they are merged."""

    means: np.ndarray  # [n,3] float64
    covars: np.ndarray  # [n,6] float32 upper triangles
    masses: np.ndarray  # [n] float32
    weights: np.ndarray  # [n] float32, weights of costs
    sh: np.ndarray  # [n,3k] float32
    sizes: np.ndarray  # [n] int32, number of input Gaussians that were merged into each
    rows: np.ndarray  # [n] int64, row of the first of them in the input

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, rows: np.ndarray) -> Cloud:
        return Cloud(**{name: column[rows] for name, column in vars(self).items()})


@stage("reduce")
def merge_neighbors(gaussians: Gaussians, count: int, power: float = POWERS[0]) -> Gaussians:
    """Merge finite Gaussians in any frame into ``count`` Gaussians, at least one; none is dropped.

    If there are at most ``count`` Gaussians, they are returned unchanged. Costs are weighted by the masses to the
    ``power``.
    """
    count = max(1, count)
    if len(gaussians) <= count:
        return gaussians
    cloud = cloud_of(gaussians)
    cloud.weights[:] = power_of(cloud.masses, power)
    round_share = 0.25  # least share of the Gaussians that remains after a round
    while len(cloud) > count:
        cloud = _merge_round(cloud, max(count, int(round_share * len(cloud))))
    return gaussians_of_cloud(cloud, gaussians, MOST_WIDENING)


def cloud_of(g: Gaussians) -> Cloud:
    """Compute the moments of Gaussians; flat Gaussians get a little thickness."""
    count = len(g)
    covars, masses = np.empty((count, 6), np.float32), np.empty(count, np.float32)
    quats, scales = (np.ascontiguousarray(column, np.float32) for column in (g.quats, g.scales))
    gaussian_moments(quats, scales, g.opacities.astype(np.float32).clip(MIN_OPACITY, 1), FLATNESS, covars, masses)
    sh = np.concatenate([g.sh0, g.shN], 1, dtype=np.float32).reshape(count, -1)
    ones = np.ones(count, np.int32)
    return Cloud(g.means.astype(np.float64), covars, masses, ones.astype(np.float32), sh, ones, np.arange(count))


def _merge_round(cloud: Cloud, count: int) -> Cloud:
    """Merge the cheapest pairs of all cells until ``count`` Gaussians remain, or until there are no pairs."""
    order, starts = _divide_into_cells(cloud.means)
    pairs, costs = np.zeros((len(cloud), 2), np.int32), np.full(len(cloud), np.inf, np.float32)
    colors = np.ascontiguousarray(cloud.sh[:, :3])

    def merge_cells(begin: int) -> None:
        end = min(begin + CELLS_PER_TASK, len(starts) - 1)
        # Least share of a cell's Gaussians that remains after a round; longer chains of merges make haze
        cell_share = 0.2
        agglomerate(
            cloud.means, cloud.covars, cloud.masses, cloud.weights, colors, order, starts, COLOR_WEIGHT, cell_share,
            begin, end, pairs, costs,
        )  # fills `pairs` and `costs`  # fmt: skip

    parallel_map(merge_cells, range(0, len(starts) - 1, CELLS_PER_TASK))
    cheapest_pairs = pairs[_cheapest(costs, len(cloud) - count)]
    if len(cheapest_pairs) == 0:  # no cost is a number: keep the Gaussians with the largest masses
        return cloud[np.sort(np.argsort(-cloud.masses, kind="stable")[:count])]
    return merge_rows(cloud, cheapest_pairs)


def merge_rows(cloud: Cloud, pairs: np.ndarray) -> Cloud:
    """Merge disjoint pairs of rows ``[m,2]`` int32; the merged Gaussian takes the place of the first row."""
    merge_pairs(pairs, cloud.means, cloud.covars, cloud.masses, cloud.weights, cloud.sh, cloud.sizes)
    remains = np.ones(len(cloud), bool)
    remains[pairs[:, 1]] = False
    return cloud[remains]


def _divide_into_cells(means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide means ``[n,3]`` into cells of neighbours; return their order ``[n]`` and the cell starts ``[c+1]``."""
    count = len(means)
    starts = np.array([0, count])
    while (starts[1:] - starts[:-1]).max() > CELL:  # halves runs as the k-d tree does
        starts = np.sort(np.concatenate([starts, (starts[1:] + starts[:-1]) // 2]))
    return make_tree(means)[0], starts


def _cheapest(costs: np.ndarray, count: int) -> np.ndarray:
    """Return the indices, ascending, of the ``count`` lowest finite costs ``[n]``; among equal costs the first."""
    finite = np.isfinite(costs)
    count = min(count, int(finite.sum()))
    if count == 0:
        return np.zeros(0, np.int64)
    highest = np.partition(costs, count - 1)[count - 1]
    below, equal = np.flatnonzero(costs < highest), np.flatnonzero(costs == highest)
    return np.sort(np.concatenate([below, equal[: count - len(below)]]))


def gaussians_of_cloud(cloud: Cloud, source: Gaussians, wider: float = 0.0) -> Gaussians:
    """Convert moments to Gaussians; Gaussians that were not merged are copied from ``source``.

    If a mass would need an opacity above one, scales grow instead, at most by the share ``wider`` for each doubling of
    the merged number.
    """
    scales, quats = principal_axes(cloud.covars[:, FULL_MATRIX].reshape(-1, 3, 3))
    squares = scales * scales
    opacities = cloud.masses / np.sqrt((squares * squares[:, NEXT_AXIS]).sum(1))
    max_growth = 1 + wider * log(cloud.sizes.astype(np.float64)) / float(log(2.0))
    scales *= np.sqrt(opacities).clip(1, max_growth)[:, None]
    opacities = np.minimum(opacities, MAX_OPACITY)
    sh = cloud.sh.reshape(len(cloud), -1, 3)
    means, quats, scales = to_float32(cloud.means), to_float32(quats), to_float32(scales)
    out = Gaussians(means, quats, scales, to_float32(opacities), sh[:, :1].copy(), sh[:, 1:].copy())
    unmerged = np.flatnonzero(cloud.sizes == 1)
    for name, column in vars(out).items():
        column[unmerged] = getattr(source, name)[cloud.rows[unmerged]]
    return out
