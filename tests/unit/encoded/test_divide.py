"""Kept children against the stage that pools them anew."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
from network_fixtures import Made, made

from gsmerge.encoded.encoded import Division
from gsmerge.encoded.to_gaussians import divide_all, pick_children
from gsmerge.moments import feature_to_gaussians
from gsmerge.stages.decode import divide, split_counts
from gsmerge.types import FeatureGaussians, Gaussians

MOST = 8


@pytest.fixture(scope="module")
def scene() -> Made:
    return made()


@pytest.fixture(scope="module")
def division(scene: Made) -> Division:
    return divide_all(scene.features, scene.members, MOST)


def picked(features: FeatureGaussians, division: Division, counts: np.ndarray) -> tuple[Gaussians, np.ndarray]:
    rows, parents = pick_children(division, counts)
    every = Gaussians.concat([feature_to_gaussians(features), division.children])
    return every[rows], parents


@pytest.mark.parametrize("k", range(1, MOST + 1))
def test_children_of_every_k_are_those_of_the_stage(k: int, scene: Made, division: Division) -> None:
    counts = np.full(len(scene.features), k)
    expected, wanted_parents = divide(scene.features, scene.members, counts)
    actual, parents = picked(scene.features, division, counts)
    np.testing.assert_array_equal(parents, wanted_parents)
    assert scenes.identical(actual, expected)


@pytest.mark.parametrize("seed", range(5))
def test_any_counts_give_the_stage_s_children(seed: int, scene: Made, division: Division) -> None:
    counts = np.random.default_rng(seed).integers(1, MOST + 3, len(scene.features))
    expected, _ = divide(scene.features, scene.members, np.minimum(counts, MOST))
    assert scenes.identical(picked(scene.features, division, counts)[0], expected)


@pytest.mark.parametrize("extra", [0, 1, 17, 10_000])
def test_deals_are_those_of_a_budget(extra: int, scene: Made, division: Division) -> None:
    dealt = np.bincount(division.growth_order[:extra], minlength=len(scene.features))
    np.testing.assert_array_equal(1 + dealt, split_counts(scene.features, scene.members, extra))


def test_groups_that_cannot_be_divided_are_whole(scene: Made, division: Division) -> None:
    single = np.flatnonzero(np.diff(scene.features.starts) == 1)
    assert len(single) > 3
    assert set(single) <= set(division.uniform.tolist())
    assert not division.splits[division.uniform].any()
    assert len(division.children) == 2 * len(division.slots) + len(division.uniform)


def test_one_child_keeps_nothing(scene: Made) -> None:
    division = divide_all(scene.features, scene.members, 1)
    sizes = [len(part) for part in (division.slots, division.uniform, division.children, division.growth_order)]
    assert sizes == [0, 0, 0, 0]
    assert not division.splits.any()


def test_no_groups(scene: Made) -> None:
    none = scenes.make_features(np.zeros((0, 3)))
    division = divide_all(none, scene.members, MOST)
    rows, parents = pick_children(division, np.zeros(0, np.int64))
    assert (len(rows), len(parents), len(division.children)) == (0, 0, 0)
