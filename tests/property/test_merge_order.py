"""Merging does not depend on order, place, orientation or unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import make_features, random_rotation

from gsmerge.method.stages.match import match
from gsmerge.method.stages.merge import merge, take_features
from gsmerge.settings.stages import MatchOptions
from gsmerge.types import FeatureGaussians, Matches

FEW = settings(max_examples=20, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)


def random_features(rng: np.random.Generator, count: int) -> FeatureGaussians:
    return make_features(
        rng.uniform(0, 1, (count, 3)), sizes=rng.uniform(0.05, 0.15, (count, 3)), views=rng.integers(0, 4, count),
        colors=rng.uniform(0.45, 0.55, (count, 3)), opacities=rng.uniform(0.1, 0.9, count),
    )  # fmt: skip


def as_sets(actual: Matches, names: np.ndarray) -> set[frozenset[int]]:
    clusters = actual.clusters
    return {frozenset(names[clusters == c].tolist()) for c in range(actual.count)}


@FEW
@given(seeds, st.integers(1, 80), st.sampled_from(["overlap", "aabb"]))
def test_clusters_do_not_depend_on_the_order_of_features(seed: int, count: int, method: str) -> None:
    rng = np.random.default_rng(seed)
    features, options = random_features(rng, count), MatchOptions(match=method, overlap=0.3)
    order = rng.permutation(count)
    shuffled = take_features(features, order)
    one, other = match(features, options), match(shuffled, options)
    assert as_sets(one, np.arange(count)) == as_sets(other, order)
    a, b = merge(features, one), merge(shuffled, other)
    assert len(a) == len(b) == one.count
    for name in ("means", "covars", "weights", "extinctions", "masses"):
        x, y = (np.sort(getattr(f, name).reshape(len(f), -1), axis=0) for f in (a, b))
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-6, err_msg=name)


@FEW
@given(seeds, st.integers(2, 80), st.floats(-3, 3))
def test_clusters_do_not_depend_on_the_axes(seed: int, count: int, exponent: float) -> None:
    rng = np.random.default_rng(seed)
    features, turn, factor = random_features(rng, count), random_rotation(seed), 10.0**exponent
    moved = replace(
        features,
        means=(factor * features.means.astype(np.float64) @ turn.T).astype(np.float32),
        covars=(factor**2 * turn @ features.covars.astype(np.float64) @ turn.T).astype(np.float32),
    )
    options = MatchOptions(overlap=0.3)
    one, other = match(features, options), match(moved, options)
    assert as_sets(one, np.arange(count)) == as_sets(other, np.arange(count))


@FEW
@given(seeds, st.integers(1, 60))
def test_merging_keeps_sums_and_moments(seed: int, count: int) -> None:
    """Whatever the clusters, the weighted mean and the second moment of everything stay."""
    rng = np.random.default_rng(seed)
    features = random_features(rng, count)
    labels = np.unique(rng.integers(0, max(1, count // 3) + 1, count), return_inverse=True)[1].reshape(-1)
    merged = merge(features, Matches(labels, int(labels.max()) + 1))

    def totals(f: FeatureGaussians) -> np.ndarray:
        weights, means, covars = f.weights.astype(np.float64), f.means.astype(np.float64), f.covars.astype(np.float64)
        second = covars + means[:, :, None] * means[:, None]
        extinction = f.extinctions.sum(dtype=np.float64)
        return np.concatenate([[weights.sum(), extinction], weights @ means, weights @ second.reshape(len(f), 9)])

    np.testing.assert_allclose(totals(merged), totals(features), rtol=1e-5, atol=1e-6)
