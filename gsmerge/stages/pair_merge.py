"""Gaussians -> fewer Gaussians by their positions and colours alone: for scenes without known views.

Cells of a k-d tree are merged pair by pair, the cheapest pairs of all cells first, in rounds whose cells differ. Masses
add up, opacity times the area that is seen, so a surface stays as opaque as it was; scales grow where opacity cannot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmerge.arrays import to_float32
from gsmerge.kernels.elementary import log
from gsmerge.kernels.elementary import power as power_of
from gsmerge.kernels.gaussians.cross_view import make_tree
from gsmerge.kernels.gaussians.pairs import CELL, agglomerate, gaussian_moments, merge_pairs
from gsmerge.pooling import MAX_OPACITY, principal_axes
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Gaussians

LEFT = 0.25  # share of the Gaussians that a round leaves, at least
LEAST_LEFT = 0.2  # the same in each cell: longer chains of merges end in haze
# Chosen on training scenes by the PSNR of views from cameras at random (docs/internals/notebook.md#bare-files)
COLOR_WEIGHT = 0.6  # of squared distances of harmonics of degree 0 against nats
# Powers of masses that costs are multiplied by: what fills the pictures of a scene, or the detail of an object
POWERS = 1.0, 0.3
FLATNESS = 0.01  # least scale over the largest, so that the logarithm of the volume stays finite
MIN_OPACITY = 1e-4  # of what is merged, so that masses stay positive
WIDER = 0.05  # by how much scales grow at most for each doubling of what was merged: fewer Gaussians leave more gaps
CELLS_PER_TASK = 256


@dataclass(eq=False)
class Cloud:
    """Moments of n Gaussians, the form in which they are merged."""

    means: np.ndarray  # [n,3] float64
    covars: np.ndarray  # [n,6] float32 upper triangles
    masses: np.ndarray  # [n] float32
    weights: np.ndarray  # [n] float32, of costs
    sh: np.ndarray  # [n,3k] float32
    sizes: np.ndarray  # [n] int32, Gaussians merged
    rows: np.ndarray  # [n] int64, of the first of them in the input

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, rows: np.ndarray) -> Cloud:
        return Cloud(**{name: column[rows] for name, column in vars(self).items()})


@stage("reduce")
def merge_neighbors(gaussians: Gaussians, count: int, power: float = POWERS[0]) -> Gaussians:
    """Merge finite Gaussians in any frame into ``count``, at least one; none is dropped.

    Returns all if there are no more than ``count``. ``power``: of the masses, by which costs are weighed.
    """
    count = max(1, count)
    if len(gaussians) <= count:
        return gaussians
    cloud = cloud_of(gaussians)
    cloud.weights[:] = power_of(cloud.masses, power)
    while len(cloud) > count:
        cloud = _merge_round(cloud, max(count, int(LEFT * len(cloud))))
    return gaussians_of(cloud, gaussians, WIDER)


def cloud_of(g: Gaussians) -> Cloud:
    """Compute the moments of Gaussians; flat ones get a little thickness."""
    count = len(g)
    covars, masses = np.empty((count, 6), np.float32), np.empty(count, np.float32)
    quats, scales = (np.ascontiguousarray(column, np.float32) for column in (g.quats, g.scales))
    gaussian_moments(quats, scales, g.opacities.astype(np.float32).clip(MIN_OPACITY, 1), FLATNESS, covars, masses)
    sh = np.concatenate([g.sh0, g.shN], 1, dtype=np.float32).reshape(count, -1)
    ones = np.ones(count, np.int32)
    return Cloud(g.means.astype(np.float64), covars, masses, ones.astype(np.float32), sh, ones, np.arange(count))


def _merge_round(cloud: Cloud, count: int) -> Cloud:
    """Merge the cheapest pairs of all cells until ``count`` Gaussians are left, or until no pairs are left."""
    order, starts = _divide(cloud.means)
    pairs, costs = np.zeros((len(cloud), 2), np.int32), np.full(len(cloud), np.inf, np.float32)
    colors = np.ascontiguousarray(cloud.sh[:, :3])

    def work(first: int) -> None:
        last = min(first + CELLS_PER_TASK, len(starts) - 1)
        agglomerate(
            cloud.means, cloud.covars, cloud.masses, cloud.weights, colors, order, starts, COLOR_WEIGHT, LEAST_LEFT,
            first, last, pairs, costs,
        )  # fmt: skip

    parallel_map(work, range(0, len(starts) - 1, CELLS_PER_TASK))
    chosen = pairs[_cheapest(costs, len(cloud) - count)]
    if len(chosen) == 0:  # costs that are no numbers: what weighs most stays
        return cloud[np.sort(np.argsort(-cloud.masses, kind="stable")[:count])]
    return merge_rows(cloud, chosen)


def merge_rows(cloud: Cloud, pairs: np.ndarray) -> Cloud:
    """Merge disjoint pairs of rows ``[m,2]`` int32, each into its first one, whose place it has."""
    merge_pairs(pairs, cloud.means, cloud.covars, cloud.masses, cloud.weights, cloud.sh, cloud.sizes)
    left = np.ones(len(cloud), bool)
    left[pairs[:, 1]] = False
    return cloud[left]


def _divide(means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide means ``[n,3]`` into cells of neighbours: their order ``[n]`` and where each cell starts ``[c+1]``."""
    count = len(means)
    starts = np.array([0, count])
    while (starts[1:] - starts[:-1]).max() > CELL:  # as the tree halves its runs
        starts = np.sort(np.concatenate([starts, (starts[1:] + starts[:-1]) // 2]))
    return make_tree(means)[0], starts


def _cheapest(costs: np.ndarray, count: int) -> np.ndarray:
    """Return the rising indices of the ``count`` lowest finite costs ``[n]``; among equal costs the first."""
    finite = np.isfinite(costs)
    count = min(count, int(finite.sum()))
    if count == 0:
        return np.zeros(0, np.int64)
    highest = np.partition(costs, count - 1)[count - 1]
    below, equal = np.flatnonzero(costs < highest), np.flatnonzero(costs == highest)
    return np.sort(np.concatenate([below, equal[: count - len(below)]]))


def gaussians_of(cloud: Cloud, source: Gaussians, wider: float = 0.0) -> Gaussians:
    """Convert moments to Gaussians; those that were not merged stay the same.

    Masses that would need an opacity above one make scales larger instead, at most by ``wider`` for each doubling.
    """
    scales, quats = principal_axes(cloud.covars[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3))
    squares = scales * scales
    opacities = cloud.masses / np.sqrt((squares * squares[:, [1, 2, 0]]).sum(1))
    most = 1 + wider * log(cloud.sizes.astype(np.float64)) / float(log(2.0))
    scales *= np.sqrt(opacities).clip(1, most)[:, None]
    opacities = np.minimum(opacities, MAX_OPACITY)
    sh = cloud.sh.reshape(len(cloud), -1, 3)
    means, quats, scales = to_float32(cloud.means), to_float32(quats), to_float32(scales)
    out = Gaussians(means, quats, scales, to_float32(opacities), sh[:, :1].copy(), sh[:, 1:].copy())
    alone = np.flatnonzero(cloud.sizes == 1)
    for name, column in vars(out).items():
        column[alone] = getattr(source, name)[cloud.rows[alone]]
    return out
