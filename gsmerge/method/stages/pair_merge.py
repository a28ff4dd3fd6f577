"""Gaussians -> fewer Gaussians: merge neighbours without pictures, for scenes without views.

Neighbours within a cell of a k-d tree are merged pair by pair, the cheapest pairs of all cells first. Each round has
other cells. A mass is opacity times visible area. Masses add up, so a surface stays as opaque as it was. If the opacity
of a merged Gaussian would exceed one, its scales grow instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmerge.arrays import to_float32
from gsmerge.method.geometry.pooling import FULL_MATRIX, MAX_OPACITY, principal_axes
from gsmerge.method.kernels.elementary import log
from gsmerge.method.kernels.elementary import power as power_of
from gsmerge.method.kernels.gaussians.cross_view import make_tree
from gsmerge.method.kernels.gaussians.pairs import CELL, agglomerate, gaussian_moments, merge_pairs
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Gaussians

# Chosen on training scenes by the PSNR of views from random cameras (docs/internals/decisions.md#bare-files)
COLOR_WEIGHT = 0.6  # weight of squared differences of sh0 in a cost, whose other part is a divergence in nats
# Costs of merging are multiplied by the masses to one of the POWERS. Power 1 keeps what is large in pictures, which
# suits scenes. Power 0.3 keeps detail, which suits objects
POWERS = 1.0, 0.3
FLATNESS = 0.01  # least scale as a share of the largest scale, so that the logarithm of the volume stays finite
MIN_OPACITY = 1e-4  # least opacity of Gaussians that are merged, so that masses stay positive
MOST_WIDENING = 0.05  # scales grow by at most this share for each doubling of the merged number, to close gaps
CELLS_PER_TASK = 256  # cells that a thread merges at a time
NEXT_AXIS = [1, 2, 0]  # each axis and its next axis give all three pairs of axes


@dataclass(eq=False)
class Cloud:
    """The moments of n Gaussians, which are what merging combines."""

    means: np.ndarray  # [n,3] float64
    covars: np.ndarray  # [n,6] float32 upper triangles of covariances
    masses: np.ndarray  # [n] float32
    weights: np.ndarray  # [n] float32 factors of the costs of merging
    sh: np.ndarray  # [n,3k] float32
    sizes: np.ndarray  # [n] int32, number of input Gaussians in each
    rows: np.ndarray  # [n] int64, row of the first of these input Gaussians

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, rows: np.ndarray) -> Cloud:
        return Cloud(**{name: column[rows] for name, column in vars(self).items()})


@stage("reduce")
def merge_neighbors(gaussians: Gaussians, count: int, power: float = POWERS[0]) -> Gaussians:
    """Merge finite Gaussians in any frame into ``count`` Gaussians, or into one if ``count`` is less.

    If there are at most ``count`` Gaussians, they are returned unchanged. Costs are weighted by the masses to the
    ``power``, see ``POWERS``.
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
    """Return the moments of Gaussians. Flat Gaussians get a little thickness, so that they have a volume."""
    count = len(g)
    covars = np.empty((count, 6), np.float32)
    masses = np.empty(count, np.float32)
    quats, scales = (np.ascontiguousarray(column, np.float32) for column in (g.quats, g.scales))
    gaussian_moments(quats, scales, g.opacities.astype(np.float32).clip(MIN_OPACITY, 1), FLATNESS, covars, masses)
    sh = np.concatenate([g.sh0, g.shN], 1, dtype=np.float32).reshape(count, -1)
    ones = np.ones(count, np.int32)
    return Cloud(
        g.means.astype(np.float64), covars=covars, masses=masses, weights=ones.astype(np.float32), sh=sh, sizes=ones,
        rows=np.arange(count),
    )  # fmt: skip


def _merge_round(cloud: Cloud, count: int) -> Cloud:
    """Merge the cheapest pairs of all cells, at most until ``count`` Gaussians remain, and return the new cloud.

    If no pair has a finite cost, the Gaussians with the largest masses are kept.
    """
    starts = np.array([0, len(cloud)])
    while (starts[1:] - starts[:-1]).max() > CELL:  # halve all cells, as the k-d tree halves its nodes
        starts = np.sort(np.concatenate([starts, (starts[1:] + starts[:-1]) // 2]))
    order = make_tree(cloud.means)[0]  # rows in the order of the cells
    pairs, costs = np.zeros((len(cloud), 2), np.int32), np.full(len(cloud), np.inf, np.float32)
    colors = np.ascontiguousarray(cloud.sh[:, :3])

    def plan_merges(begin: int) -> None:
        """Write the pairs to merge in the cells from ``begin`` on, and their costs, to ``pairs`` and ``costs``."""
        end = min(begin + CELLS_PER_TASK, len(starts) - 1)
        # Least share of a cell's Gaussians that remains after a round. If fewer Gaussians remained after a round,
        # merged Gaussians would look like haze
        cell_share = 0.2
        agglomerate(
            cloud.means, cloud.covars, masses=cloud.masses, weights=cloud.weights, colors=colors, order=order,
            starts=starts, color_weight=COLOR_WEIGHT, least_share=cell_share, first=begin, last=end, pairs=pairs,
            costs=costs,
        )  # fmt: skip

    parallel_map(plan_merges, range(0, len(starts) - 1, CELLS_PER_TASK))
    num_pairs = min(len(cloud) - count, int(np.isfinite(costs).sum()))
    if num_pairs == 0:
        return cloud[np.sort(np.argsort(-cloud.masses, kind="stable")[:count])]
    highest = np.partition(costs, num_pairs - 1)[num_pairs - 1]
    below = np.flatnonzero(costs < highest)
    equal = np.flatnonzero(costs == highest)
    cheapest = np.concatenate([below, equal[: num_pairs - len(below)]])  # of equal costs, the first ones
    return merge_rows(cloud, pairs[np.sort(cheapest)])


def merge_rows(cloud: Cloud, pairs: np.ndarray) -> Cloud:
    """Merge pairs of rows ``[m,2]`` int32, one after another, into the first row of each pair.

    Changes ``cloud``, and returns it without the second row of each pair.
    """
    merge_pairs(pairs, cloud.means, cloud.covars, cloud.masses, cloud.weights, cloud.sh, cloud.sizes)
    remains = np.ones(len(cloud), bool)
    remains[pairs[:, 1]] = False
    return cloud[remains]


def gaussians_of_cloud(cloud: Cloud, source: Gaussians, wider: float = 0.0) -> Gaussians:
    """Convert moments to Gaussians, but copy unmerged Gaussians from ``source``, the input of the merging.

    If a mass would need an opacity above one, scales grow instead. The scales grow at most by the share ``wider`` for
    each doubling of the number of input Gaussians that a Gaussian was merged from.
    """
    scales, quats = principal_axes(cloud.covars[:, FULL_MATRIX].reshape(-1, 3, 3))
    squares = scales * scales
    opacities = cloud.masses / np.sqrt((squares * squares[:, NEXT_AXIS]).sum(1))
    max_growth = 1 + wider * log(cloud.sizes.astype(np.float64)) / float(log(2.0))
    scales *= np.sqrt(opacities).clip(1, max_growth)[:, None]
    opacities = np.minimum(opacities, MAX_OPACITY)
    sh = cloud.sh.reshape(len(cloud), -1, 3)
    means = to_float32(cloud.means)
    quats = to_float32(quats)
    scales = to_float32(scales)
    out = Gaussians(
        means, quats=quats, scales=scales, opacities=to_float32(opacities), sh0=sh[:, :1].copy(), shN=sh[:, 1:].copy()
    )
    unmerged = np.flatnonzero(cloud.sizes == 1)
    for name, column in vars(out).items():
        column[unmerged] = getattr(source, name)[cloud.rows[unmerged]]
    return out
