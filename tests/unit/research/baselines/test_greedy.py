"""Pairwise merging matches loops over all pairs."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
from clouds import some

from gsmerge import Gaussians
from gsmerge.method.geometry.transforms import covariances
from gsmerge.research.baselines import greedy


def slow_area(covar: np.ndarray) -> float:
    """Return an area by Knud Thomsen's formula."""
    a, b, c = np.sqrt(np.linalg.eigvalsh(covar))
    p = 1.6075
    return float(4 * np.pi * (((a * b) ** p + (a * c) ** p + (b * c) ** p) / 3) ** (1 / p))


class Blob:
    """One Gaussian of the slow twin."""

    def __init__(self, mean: np.ndarray, covar: np.ndarray, mass: float, sh: np.ndarray) -> None:
        self.mean, self.covar, self.mass, self.sh = mean, covar, mass, sh

    def with_(self, other: Blob) -> Blob:
        p, q = self.mass / (self.mass + other.mass), other.mass / (self.mass + other.mass)
        mean = p * self.mean + q * other.mean
        covar = sum(
            w * (b.covar + np.outer(b.mean - mean, b.mean - mean)) for w, b in ((p, self), (q, other))
        )  # spread of the means and their own
        return Blob(mean, covar, self.mass + other.mass, p * self.sh + q * other.sh)

    def cost(self, other: Blob) -> float:
        p, q = self.mass / (self.mass + other.mass), other.mass / (self.mass + other.mass)
        logs = [float(np.linalg.slogdet(b.covar)[1]) for b in (self.with_(other), self, other)]
        return 0.5 * (logs[0] - p * logs[1] - q * logs[2]) + float(((self.sh - other.sh) ** 2).sum())


def slow_greedy(gaussians: Gaussians, count: int) -> list[Blob]:
    """Merge round after round, pair after pair."""
    covars = covariances(gaussians.quats.astype(np.float64), gaussians.scales.astype(np.float64))
    sh = np.concatenate([gaussians.sh0, gaussians.shN], 1).astype(np.float64).reshape(len(gaussians), -1)
    rows = zip(gaussians.means.astype(np.float64), covars, gaussians.opacities.astype(np.float64), sh, strict=True)
    blobs = [Blob(mean, covar, float(alpha) * slow_area(covar), color) for mean, covar, alpha, color in rows]
    while len(blobs) > count:
        pairs = set()
        for i, blob in enumerate(blobs):
            far = [float(np.linalg.norm(blob.mean - other.mean)) for other in blobs]
            nearest = [j for j in np.argsort(far, kind="stable") if j != i][: greedy.GREEDY_NEIGHBORS]
            pairs |= {(min(i, int(j)), max(i, int(j))) for j in nearest}
        limit = len(blobs) - count
        chosen: list[tuple[int, int]] = []
        for i, j in sorted(pairs, key=lambda pair: blobs[pair[0]].cost(blobs[pair[1]])):
            if len(chosen) < limit and not any({i, j} & set(pair) for pair in chosen):
                chosen.append((i, j))
        used = {i for pair in chosen for i in pair}
        blobs = [b for i, b in enumerate(blobs) if i not in used] + [blobs[i].with_(blobs[j]) for i, j in chosen]
    return blobs


@pytest.mark.parametrize("count", [1, 5, 20, 41, 59, 60])
@pytest.mark.parametrize("degree", [0, 1])
def test_greedy_merging_matches_a_slow_twin(count: int, degree: int) -> None:
    gaussians = some(60, seed=count, degree=degree)
    merged, slow = greedy.merge_greedily(gaussians, count), slow_greedy(gaussians, count)
    means = np.stack([blob.mean for blob in slow])
    places = np.linalg.norm(merged.means[:, None] - means, axis=2).argmin(1)
    assert sorted(places) == list(range(count))
    twins = [slow[place] for place in places]
    np.testing.assert_allclose(merged.means, means[places], atol=1e-5)
    covars = covariances(merged.quats.astype(np.float64), merged.scales.astype(np.float64))
    np.testing.assert_allclose(covars, [blob.covar for blob in twins], atol=1e-5)
    opacities = [min(0.999, blob.mass / slow_area(blob.covar)) for blob in twins]
    np.testing.assert_allclose(merged.opacities, opacities, rtol=1e-3)
    sh = np.concatenate([merged.sh0, merged.shN], 1).reshape(count, -1)
    np.testing.assert_allclose(sh, [blob.sh for blob in twins], atol=1e-5)


def slow_matching(left: np.ndarray, right: np.ndarray, costs: np.ndarray, limit: int) -> list[int]:
    taken: set[int] = set()
    chosen: list[int] = []
    for pair in np.argsort(costs, kind="stable").tolist():
        ends = {int(left[pair]), int(right[pair])}
        if len(chosen) < limit and not ends & taken:
            taken |= ends
            chosen.append(pair)
    return chosen


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("limit", [1, 7, 1000])
@pytest.mark.parametrize("equal", [False, True])
def test_matched_pairs_are_those_taken_one_by_one(seed: int, limit: int, equal: bool) -> None:
    """Equal costs too."""
    rng = np.random.default_rng(seed)
    left = rng.integers(0, 100, 400)
    right = left + rng.integers(1, 100, 400)
    costs = rng.integers(0, 5, 400).astype(float) if equal else rng.normal(size=400)
    actual = greedy.cheapest_disjoint(left, right, costs, limit)
    assert actual.tolist() == slow_matching(left, right, costs, limit)


@pytest.mark.parametrize("count", [1, 3, 30])
def test_coincident_flat_transparent_gaussians_merge_to_finite_ones(count: int) -> None:
    """All in one place, flat, of no opacity."""
    gaussians = some(60)
    stacked = Gaussians(
        np.zeros((60, 3), np.float32), gaussians.quats, gaussians.scales * np.array([1, 1, 0], np.float32),
        np.zeros(60, np.float32), gaussians.sh0, gaussians.shN,
    )  # fmt: skip
    merged = greedy.merge_greedily(stacked, count)
    assert len(merged) == count
    for name in scenes.FIELDS:
        assert np.isfinite(getattr(merged, name)).all(), name
