"""Matched features merge with their moments and members."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from scenes import make_features

from gsmerge.method.geometry.pooling import feature_to_gaussians
from gsmerge.method.stages.merge import merge, take_features
from gsmerge.types import FeatureGaussians, Matches


def matches(*clusters: int) -> Matches:
    return Matches(np.array(clusters, np.int64), len(set(clusters)))


def assert_equal(a: FeatureGaussians, b: FeatureGaussians) -> None:
    for f in fields(FeatureGaussians):
        assert np.array_equal(getattr(a, f.name), getattr(b, f.name)), f.name


def with_members(features: FeatureGaussians, sizes: list[int]) -> FeatureGaussians:
    starts = np.cumsum([0, *sizes])
    return replace(features, starts=starts, members=np.arange(int(starts[-1])) + 100)


def test_merged_pair_has_the_values_computed_by_hand() -> None:
    features = make_features([[0, 0, 0], [7, 7, 7], [4, 0, 0]], sizes=1.0, opacities=[0.6, 0.5, 0.2], degree=1)
    features = replace(
        with_members(features, [2, 1, 3]),
        shN=np.array([0.0, 5.0, 1.0], np.float32)[:, None, None] * np.ones((3, 3), np.float32),
    )
    merged = merge(features, matches(0, 1, 0))
    assert len(merged) == 2
    assert_equal(take_features(merged, np.array([0])), take_features(features, np.array([1])))
    np.testing.assert_allclose(merged.means[1], [1, 0, 0], atol=1e-6)  # weights 3 to 1
    np.testing.assert_allclose(merged.covars[1], np.diag([4.0, 1, 1]), atol=1e-5)
    np.testing.assert_allclose(merged.shN[1], 0.25)
    assert float(merged.weights[1]) == pytest.approx(0.8)
    assert float(merged.masses[1]) == pytest.approx(float(features.masses[[0, 2]].sum()))
    assert float(merged.extinctions[1]) == pytest.approx(-np.log(0.4) - np.log(0.8), rel=1e-5)
    assert merged.views.tolist() == [1, -1]
    assert merged.starts.tolist() == [0, 1, 6]
    assert merged.members.tolist() == [102, 100, 101, 103, 104, 105]


def test_gains_weigh_means_and_scale_optical_depths() -> None:
    """A Gaussian that the photos distrust counts less in the mean; gained optical depths add up."""
    features = make_features([[0, 0, 0], [1, 0, 0]], opacities=0.5)
    features = replace(features, gains=np.array([3.0, 1.0], np.float32))
    merged = merge(features, matches(0, 0))
    np.testing.assert_allclose(merged.means[0], [0.25, 0, 0], atol=1e-6)
    gained = (features.extinctions * features.gains).sum()
    assert float(merged.extinctions[0] * merged.gains[0]) == pytest.approx(float(gained), rel=1e-5)


def test_latents_are_averaged_in_arrays_and_through_gradients(torch: Any) -> None:
    """With the weights of the means; those that are alone keep theirs. Arrays and tensors alike."""
    features = make_features(np.zeros((3, 3)), opacities=[0.6, 0.5, 0.2])
    latents = torch.tensor([[1.0, 2.0], [7.0, 8.0], [5.0, 0.0]], requires_grad=True)
    merged = merge(replace(features, latents=latents), matches(0, 1, 0))
    torch.testing.assert_close(merged.latents, torch.tensor([[7.0, 8.0], [2.0, 1.5]]))
    merged.latents.sum().backward()
    np.testing.assert_allclose(latents.grad, [[0.75, 0.75], [1, 1], [0.25, 0.25]], rtol=1e-5)
    again = merge(replace(features, latents=latents.detach().numpy()), matches(0, 1, 0))
    np.testing.assert_allclose(again.latents, merged.latents.detach(), rtol=1e-6)
    assert isinstance(merge(features, matches(0, 1, 0)).latents, np.ndarray)


def test_transparent_features_merge_without_nan() -> None:
    features = make_features([[0, 0, 0], [1, 0, 0]], opacities=0.0)
    merged = merge(features, matches(0, 0))
    for f in fields(FeatureGaussians):
        assert np.isfinite(getattr(merged, f.name)).all(), f.name
    np.testing.assert_allclose(merged.means[0], [0.5, 0, 0], atol=1e-6)
    assert feature_to_gaussians(merged).opacities.tolist() == [0]


def test_merged_covariance_is_exact_far_from_the_origin() -> None:
    features = make_features(np.array([[0, 0, 0], [0.02, 0, 0]]) + 1000.0, opacities=0.5)
    merged = merge(features, matches(0, 0))
    apart = float(features.means[1, 0] - features.means[0, 0])
    np.testing.assert_allclose(np.diag(merged.covars[0]), [1e-4 + (apart / 2) ** 2, 1e-4, 1e-4], rtol=1e-3)


def test_every_member_once_whatever_the_clusters() -> None:
    rng = np.random.default_rng(0)
    sizes = rng.integers(1, 5, 40).tolist()
    features = with_members(make_features(rng.normal(size=(40, 3))), sizes)
    labels = np.unique(rng.integers(0, 25, 40), return_inverse=True)[1]
    actual = Matches(labels.reshape(-1), int(labels.max()) + 1)
    merged = merge(features, actual)
    assert len(merged) == actual.count
    assert sorted(merged.members.tolist()) == features.members.tolist()
    assert float(merged.extinctions.sum()) == pytest.approx(float(features.extinctions.sum()), rel=1e-5)
    assert float(merged.masses.sum()) == pytest.approx(float(features.masses.sum()), rel=1e-5)


def test_taken_features_bring_their_members() -> None:
    features = with_members(make_features(np.eye(3)), [1, 2, 3])
    taken = take_features(features, np.array([2, 0]))
    assert taken.starts.tolist() == [0, 3, 4]
    assert taken.members.tolist() == [103, 104, 105, 100]
    assert taken.means.tolist() == features.means[[2, 0]].tolist()
    assert len(take_features(features, np.zeros(0, np.int64))) == 0
