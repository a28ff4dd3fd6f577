"""Merging pair by pair matches slow, obvious numpy in float64."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from made_gaussians import random_gaussians
from messages import refuses

from gsmerge.method.geometry.transforms import covariances
from gsmerge.method.kernels.gaussians.pairs import CELL, agglomerate, gaussian_moments, merge_pairs

UPPER = np.triu_indices(3)
WEIGHT = 2.0


def cloud_of(count: int, seed: int = 0) -> dict[str, np.ndarray]:
    g = random_gaussians(count, seed)
    covars, masses = np.empty((count, 6), np.float32), np.empty(count, np.float32)
    gaussian_moments(g.quats, g.scales, g.opacities, 0.1, covars, masses)
    colors = np.ascontiguousarray(g.sh0[:, 0])
    weights = np.random.default_rng(seed).uniform(0.1, 1, count).astype(np.float32)
    return {
        "means": g.means.astype(np.float64),
        "covars": covars,
        "masses": masses,
        "weights": weights,
        "colors": colors,
    }


def merge_two(first: tuple, second: tuple) -> tuple:
    """Return the mean, covariance, mass, colour and weight of two."""
    share = second[2] / (first[2] + second[2])
    apart = second[0] - first[0]
    covar = (1 - share) * first[1] + share * second[1] + share * (1 - share) * np.outer(apart, apart)
    color = first[3] + share * (second[3] - first[3])
    return first[0] + share * apart, covar, first[2] + second[2], color, first[4] + second[4]


def cost_of(first: tuple, second: tuple) -> float:
    """Return Runnalls' bound per mass, and the distance of the colours, times both weights."""
    both = merge_two(first, second)
    logs = [np.linalg.slogdet(one[1])[1] for one in (both, first, second)]
    lost = 0.5 * (logs[0] - (first[2] * logs[1] + second[2] * logs[2]) / both[2])
    return (lost + WEIGHT * ((first[3] - second[3]) ** 2).sum()) * both[4]


def agglomerate_slowly(cloud: dict[str, np.ndarray], rows: np.ndarray, least: int) -> tuple[list, list[float]]:
    """Return pairs and costs of one cell; measure every pair anew before every merge."""
    means, masses = cloud["means"][rows], cloud["masses"][rows].astype(float)
    covars = np.zeros((len(rows), 3, 3))
    covars[:, UPPER[0], UPPER[1]] = covars[:, UPPER[1], UPPER[0]] = cloud["covars"][rows]
    size = np.trace(covars, axis1=1, axis2=2).mean()
    colors, weights = cloud["colors"].astype(float), cloud["weights"].astype(float)
    left = {
        int(row): (means[i] / np.sqrt(size), covars[i] / size, masses[i], colors[row], weights[row])
        for i, row in enumerate(rows)
    }
    members = {int(row): {int(row)} for row in rows}
    pairs, costs = [], [0.0]
    while len(left) > least:
        names = list(left)
        best = min((cost_of(left[a], left[b]), a, b) for i, a in enumerate(names) for b in names[i + 1 :])
        pairs.append({frozenset(members[best[1]]), frozenset(members[best[2]])})
        costs.append(max(best[0], costs[-1]))
        left[best[1]] = merge_two(left[best[1]], left.pop(best[2]))
        members[best[1]] |= members.pop(best[2])
    return pairs, costs[1:]


def run(cloud: dict[str, np.ndarray], order: np.ndarray, starts: np.ndarray, least_share: float) -> tuple:
    count = len(order)
    pairs, costs = np.full((count, 2), -1, np.int32), np.full(count, np.inf, np.float32)
    agglomerate(*cloud.values(), order, starts, WEIGHT, least_share, 0, len(starts) - 1, pairs, costs)
    return pairs, costs


def test_cheapest_pair_is_merged_until_the_wanted_share_is_left() -> None:
    cloud, order = cloud_of(33), np.random.default_rng(1).permutation(33)
    starts = np.array([0, 12, 13, 13, 33])
    pairs, costs = run(cloud, order, starts, 0.25)
    assert [int(np.isfinite(costs[a:b]).sum()) for a, b in pairwise(starts)] == [9, 0, 0, 15]
    for low, high, least in ((0, 12, 3), (13, 33, 5)):
        expected, expected_costs = agglomerate_slowly(cloud, order[low:high], least)
        made = slice(low, low + len(expected))
        np.testing.assert_allclose(costs[made], expected_costs, rtol=2e-3)
        members = {int(row): frozenset([int(row)]) for row in order[low:high]}
        for pair, (first, second) in zip(expected, pairs[made].tolist(), strict=True):
            assert {members[first], members[second]} == pair
            members[first] |= members.pop(second)


def test_moments_of_gaussians_match_the_formulas() -> None:
    g = random_gaussians(50, 2)
    quats = (g.quats * 3).astype(np.float32)
    covars, masses = np.empty((50, 6), np.float32), np.empty(50, np.float32)
    gaussian_moments(quats, g.scales, g.opacities, 0.2, covars, masses)
    scales = np.maximum(g.scales, 0.2 * g.scales.max(1, keepdims=True)).astype(np.float64)
    full = covariances(g.quats.astype(np.float64), scales)
    np.testing.assert_allclose(covars, full[:, UPPER[0], UPPER[1]], rtol=1e-4, atol=1e-7 * full.max())
    areas = np.sqrt(((scales * scales[:, [1, 2, 0]]) ** 2).sum(1))
    np.testing.assert_allclose(masses, g.opacities * areas, rtol=1e-5)


def test_merged_rows_have_the_moments_of_all() -> None:
    cloud = cloud_of(6, 3)
    means, covars, masses, added = (cloud[name].copy() for name in ("means", "covars", "masses", "weights"))
    sh, sizes = np.random.default_rng(0).normal(size=(6, 12)).astype(np.float32), np.ones(6, np.int32)
    before = sh.copy()
    merge_pairs(np.array([[1, 4], [1, 2], [0, 5]], np.int32), means, covars, masses, added, sh, sizes)
    assert sizes[[0, 1, 3]].tolist() == [2, 3, 1]
    for row, members in ((0, [0, 5]), (1, [1, 4, 2])):
        weights = cloud["masses"][members].astype(float)
        mean = np.average(cloud["means"][members], axis=0, weights=weights)
        apart = cloud["means"][members] - mean
        spread = np.average(apart[:, UPPER[0]] * apart[:, UPPER[1]], axis=0, weights=weights)
        np.testing.assert_allclose(means[row], mean, atol=1e-6)
        np.testing.assert_allclose(masses[row], weights.sum(), rtol=1e-5)
        np.testing.assert_allclose(added[row], cloud["weights"][members].sum(), rtol=1e-5)
        covar = np.average(cloud["covars"][members], axis=0, weights=weights) + spread
        np.testing.assert_allclose(covars[row], covar, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(sh[row], np.average(before[members], axis=0, weights=weights), atol=1e-5)
    assert np.array_equal(sh[3], before[3])


def test_ranges_and_pairs_outside_are_refused() -> None:
    cloud, order = cloud_of(CELL + 1), np.arange(CELL + 1)
    with refuses(ValueError, "agglomerate", "indices"):
        run(cloud, order, np.array([0, CELL + 1]), 0.5)  # more than a cell holds
    with refuses(ValueError, "agglomerate", "indices"):
        run(cloud, order, np.array([0, CELL + 2]), 0.5)
    pairs, costs = np.zeros((CELL + 1, 2), np.int32), np.zeros(CELL + 1, np.float32)
    for first, last in ((0, -1), (0, -(2**62)), (1, 0), (0, 2)):
        with refuses(ValueError, "agglomerate", "indices"):
            agglomerate(*cloud.values(), order, np.array([0, CELL]), WEIGHT, 0.5, first, last, pairs, costs)
    sizes, sh = np.ones(CELL + 1, np.int32), np.zeros((CELL + 1, 3), np.float32)
    with refuses(ValueError, "merge_pairs", "indices"):
        moments = (cloud[name] for name in ("means", "covars", "masses", "weights"))
        merge_pairs(np.array([[0, -1]], np.int32), *moments, sh, sizes)


def test_cell_with_infinite_costs_ends() -> None:
    cloud = cloud_of(8)
    cloud["means"][3] = 1e300
    pairs, costs = run(cloud, np.arange(8), np.array([0, 8]), 0.1)
    assert (pairs[np.isfinite(costs)] >= 0).all()
