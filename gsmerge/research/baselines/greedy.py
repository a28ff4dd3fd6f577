"""Pairwise greedy merging, the idea of NanoGS (2026) and of splat-transform's decimation.

Each round builds a graph of nearest neighbours, the cost of merging every two that are joined, disjoint pairs in the
order of their cost, and replaces each pair by the Gaussian with its moments. Weights are opacity times the area of the
ellipsoid, which adds up and so gives the opacity back in the end, at most 1 (as splat-transform has it). The cost is
Runnalls' bound on the Kullback-Leibler divergence (2007), per unit of weight, plus the squared distance of the
harmonics: it knows no size, a far pair costs what a near one does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsmerge.facts.prepare import Prepared
from gsmerge.geometry import covariances
from gsmerge.kernels.elementary import log, power
from gsmerge.plan import Plan
from gsmerge.pooling import MAX_OPACITY, principal_axes
from gsmerge.research.baselines.simple import own_gaussians
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import parallel_map, use_threads
from gsmerge.types import Gaussians

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

NEIGHBORS = 10  # 16 bring 0.03 dB on a real capture and take half as long again
COLOR_WEIGHT = 1.0  # of squared distances of harmonics against nats
MIN_FLATNESS = 0.01  # of the smallest scale over the largest, so that the logarithm of the volume stays finite
MIN_OPACITY = 1e-4  # of what is merged, so that masses stay positive
AREA_EXPONENT = 1.6075  # of Thomsen's formula for the area of an ellipsoid
CHUNK = 65536  # Gaussians per piece of work
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, eq=False)
class Cloud:
    """Moments of n Gaussians, the form in which they are merged."""

    means: Floats  # ``[n,3]``
    covars: Floats  # ``[n,6]`` upper triangles: xx, xy, xz, yy, yz, zz
    logdets: Floats  # ``[n]`` logarithms of their determinants
    masses: Floats  # ``[n]`` opacity times area; what merging adds
    sh: NDArray[np.float32]  # ``[n,3k]`` harmonics

    def __len__(self) -> int:
        return len(self.means)


def area(scales: Floats) -> Floats:
    """Compute the surface areas ``[n]`` of ellipsoids with half axes ``[n,3]``, within 1 % (Knud Thomsen's formula)."""
    a, b, c = power(scales, AREA_EXPONENT).T
    return np.asarray(4 * np.pi * power((a * b + a * c + b * c) / 3, 1 / AREA_EXPONENT))


def log_determinants(covars: Floats) -> Floats:
    """Compute the log-determinants ``[n]`` of symmetric matrices given as upper triangles ``[n,6]``."""
    xx, xy, xz, yy, yz, zz = covars.T
    values = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return np.asarray(log(np.maximum(values, 1e-300)))


def cloud_of(gaussians: Gaussians) -> Cloud:
    """Compute moments and masses of Gaussians; flat Gaussians get a little thickness."""
    scales = gaussians.scales.astype(np.float64)
    scales = np.maximum(scales, MIN_FLATNESS * scales.max(1, keepdims=True).clip(1e-12))
    full = covariances(gaussians.quats.astype(np.float64), scales)
    covars = np.stack([full[:, i, j] for i, j in UPPER], 1)
    opacities = gaussians.opacities.astype(np.float64).clip(MIN_OPACITY, 1)
    sh = np.concatenate([gaussians.sh0, gaussians.shN], 1, dtype=np.float32)
    sh = sh.reshape(len(sh), 3 * sh.shape[1])
    means = gaussians.means.astype(np.float64)
    return Cloud(means, covars, log_determinants(covars), opacities * area(scales), sh)


def gaussians_of(cloud: Cloud) -> Gaussians:
    """Convert moments to Gaussians; opacity is mass over area, clipped below 1."""
    scales, quats = principal_axes(cloud.covars[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3))
    sh = cloud.sh.reshape(len(cloud), -1, 3)
    return Gaussians(
        means=cloud.means.astype(np.float32),
        quats=quats.astype(np.float32),
        scales=scales.astype(np.float32),
        opacities=np.minimum(cloud.masses / area(scales), MAX_OPACITY).astype(np.float32),
        sh0=sh[:, :1],
        shN=sh[:, 1:],
    )


def merge_moments(cloud: Cloud, left: Ints, right: Ints) -> tuple[Floats, Floats, Floats]:
    """Compute weights ``[m]`` of the left members, means ``[m,3]`` and covariances ``[m,6]`` of merged pairs."""
    share = cloud.masses[left] / (cloud.masses[left] + cloud.masses[right])
    p, q = share[:, None], 1 - share[:, None]
    apart = cloud.means[left] - cloud.means[right]
    outer = np.stack([apart[:, i] * apart[:, j] for i, j in UPPER], 1)
    means = cloud.means[right] + p * apart
    return share, means, p * cloud.covars[left] + q * cloud.covars[right] + p * q * outer


def pair_costs(cloud: Cloud, left: Ints, right: Ints) -> Floats:
    """Compute the costs ``[m]`` of merging pairs: Runnalls' bound per weight plus the distance of harmonics."""
    share, _, covars = merge_moments(cloud, left, right)
    lost = log_determinants(covars) - share * cloud.logdets[left] - (1 - share) * cloud.logdets[right]
    return 0.5 * lost + COLOR_WEIGHT * ((cloud.sh[left] - cloud.sh[right]) ** 2).sum(1)


def neighbor_pairs(cloud: Cloud) -> tuple[Ints, Ints, Floats]:
    """List each pair of near neighbours once: lower row, higher row, cost."""
    from scipy.spatial import cKDTree

    with use_threads() as threads:
        tree = cKDTree(cloud.means, balanced_tree=False, compact_nodes=False)
        _, near = tree.query(cloud.means, min(NEIGHBORS + 1, len(cloud)), workers=threads)
    near = near.astype(np.int32)

    def piece(first: int) -> tuple[Ints, Ints, Floats]:
        chunk = near[first : first + CHUNK]
        rows = np.repeat(np.arange(first, first + len(chunk)), chunk.shape[1])
        neighbors = chunk.reshape(-1).astype(np.int64)
        candidates = (neighbors <= rows).nonzero()[0]  # itself, or a pair that the other one may list too
        twice = (near[neighbors[candidates]] == rows[candidates, None]).any(1)
        keep = np.ones(len(rows), bool)
        keep[candidates[twice | (neighbors[candidates] == rows[candidates])]] = False
        left, right = np.minimum(rows, neighbors)[keep], np.maximum(rows, neighbors)[keep]
        return left, right, pair_costs(cloud, left, right)

    parts = parallel_map(piece, range(0, len(cloud), CHUNK))
    left, right, costs = (np.concatenate(column) for column in zip(*parts, strict=True))
    return left, right, costs


def cheapest_disjoint(left: Ints, right: Ints, costs: Floats, limit: int) -> Ints:
    """Choose at most ``limit`` disjoint pairs greedily, by rising cost ``[m]``.

    A pair that is the cheapest of both its members is always taken, so all such pairs are taken at once, and again
    among the rest. Of equal costs the first pair counts as cheaper. Returns indices of pairs, by rising cost.
    """
    order = np.argsort(costs, kind="stable")
    left, right, ranks = left[order], right[order], np.arange(len(order))
    first = np.empty(1 + int(right.max(initial=0)), np.int64)
    taken, chosen = np.zeros(len(first), bool), np.empty(0, np.int64)
    while len(ranks):
        ends = np.stack([left[ranks], right[ranks]], 1)
        first[ends[::-1].reshape(-1)] = np.repeat(ranks[::-1], 2)  # the last that is written is the cheapest
        best = ranks[(first[ends] == ranks[:, None]).all(1)]
        taken[left[best]] = taken[right[best]] = True
        chosen = np.sort(np.concatenate([chosen, best]))[:limit]
        ranks = ranks[~taken[ends].any(1)]
        if len(chosen) == limit:
            ranks = ranks[ranks < chosen[-1]]
    return order[chosen]


def merge_pairs(cloud: Cloud, left: Ints, right: Ints) -> Cloud:
    """Merge pairs; put the results after the Gaussians in no pair, which keep their order."""
    share, means, covars = merge_moments(cloud, left, right)
    alone = np.ones(len(cloud), bool)
    alone[left] = alone[right] = False
    p = share[:, None].astype(np.float32)
    return Cloud(
        np.concatenate([cloud.means[alone], means]),
        np.concatenate([cloud.covars[alone], covars]),
        np.concatenate([cloud.logdets[alone], log_determinants(covars)]),
        np.concatenate([cloud.masses[alone], cloud.masses[left] + cloud.masses[right]]),
        np.concatenate([cloud.sh[alone], p * cloud.sh[left] + (1 - p) * cloud.sh[right]]),
    )


def reduce_to(cloud: Cloud, count: int) -> Cloud:
    """Merge pairs in rounds until at most ``count`` Gaussians are left.

    A round takes as many pairs as possible. Taking fewer lets cheap regions grow while the rest stays unmerged, and
    renders worse: on a real capture by 0.6 dB at a third of the Gaussians a round, by 1.6 dB at a sixth.
    """
    while len(cloud) > max(count, 1):
        left, right, costs = neighbor_pairs(cloud)
        chosen = cheapest_disjoint(left, right, costs, len(cloud) - count)
        cloud = merge_pairs(cloud, left[chosen], right[chosen])
    return cloud


def run(prepared: Prepared, plan: Plan, count: int) -> Gaussians:
    """Merge to exactly ``count`` Gaussians; return the input if it has no more than that."""
    gaussians = own_gaussians(prepared.scene)
    if len(gaussians) <= count:
        return gaussians
    with stage("reduce"):
        return gaussians_of(reduce_to(cloud_of(gaussians), count))
