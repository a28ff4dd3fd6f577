"""Features of several views that overlap and agree in colour match."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scenes import make_features

from gsmerge.method.stages.match import match
from gsmerge.settings.stages import MatchOptions
from gsmerge.types import FeatureGaussians

METHODS = ["overlap", "aabb"]


def sets(features: FeatureGaussians, **settings: object) -> set[frozenset[int]]:
    actual = match(features, MatchOptions(**settings))
    assert actual.clusters.dtype == np.int64
    assert sorted(set(actual.clusters.tolist())) == list(range(actual.count))
    return {frozenset(np.nonzero(actual.clusters == c)[0].tolist()) for c in range(actual.count)}


def alone(count: int) -> set[frozenset[int]]:
    return {frozenset([i]) for i in range(count)}


@pytest.mark.parametrize("method", METHODS)
def test_twins_of_two_views_match(method: str) -> None:
    twins = make_features([[0, 0, 0], [0, 0, 1e-4], [1, 0, 0]])
    assert sets(twins, match=method) == {frozenset([0, 1]), frozenset([2])}


@pytest.mark.parametrize("method", METHODS)
def test_twins_of_one_view_do_not_match(method: str) -> None:
    assert sets(make_features([[0, 0, 0], [0, 0, 0], [1, 0, 0]], views=[0, 0, 1]), match=method) == alone(3)


@pytest.mark.parametrize("method", METHODS)
def test_twins_of_different_colours_do_not_match(method: str) -> None:
    means = np.zeros((2, 3))
    near, far = (make_features(means, colors=np.array([[0.5, 0.5, 0.5], [0.5 + d, 0.5, 0.5]])) for d in (0.11, 0.13))
    assert len(sets(near, match=method)) == 1
    assert len(sets(far, match=method)) == 2


def test_threshold_is_the_bhattacharyya_coefficient() -> None:
    """Equal balls d standard deviations apart overlap by exp(-d^2 / 8)."""
    pair = make_features([[0, 0, 0], [0.01, 0, 0]])
    assert len(sets(pair, overlap=np.exp(-1 / 8) - 1e-3)) == 1
    assert len(sets(pair, overlap=np.exp(-1 / 8) + 1e-3)) == 2


def test_threshold_is_the_box_overlap() -> None:
    """Boxes of 2 x 2 x 2, half a side apart: 4 shared of 12."""
    pair = make_features([[0, 0, 0], [0.01, 0, 0]])
    assert len(sets(pair, match="aabb", iou=1 / 3 - 1e-3)) == 1
    assert len(sets(pair, match="aabb", iou=1 / 3 + 1e-3)) == 2


def test_boxes_are_compared_with_the_nearest_alone() -> None:
    """Two pairs whose gap is a little wider than they are: more neighbours chain them."""
    row = make_features([[x, 0, 0] for x in (0, 0.01, 0.022, 0.032)], views=[0, 1, 0, 1])
    assert sets(row, match="aabb") == {frozenset([0, 1]), frozenset([2, 3])}
    assert sets(row, match="aabb", neighbors=2) == {frozenset([0, 1, 2, 3])}


def test_neighbours_depend_on_the_method_unless_set() -> None:
    boxes = MatchOptions(match="aabb")
    actual = [options.num_neighbors for options in (MatchOptions(), boxes, replace(boxes, neighbors=5))]
    assert actual == [16, 1, 5]


def test_threshold_is_the_cosine_of_the_latents() -> None:
    """With latents these decide in place of the colours, for boxes alone."""
    colors = np.array([[0.2, 0.2, 0.2], [0.9, 0.9, 0.9]])
    latents = np.array([[3.0, 0.0], [0.4, 0.3]], np.float32)
    pair = replace(make_features(np.zeros((2, 3)), colors=colors), latents=latents)
    assert len(sets(pair, match="aabb", similarity=0.8 - 1e-3)) == 1
    assert len(sets(pair, match="aabb", similarity=0.8 + 1e-3)) == 2
    assert len(sets(pair, match="overlap", similarity=-1)) == 2
    assert len(sets(replace(pair, latents=np.zeros((2, 2), np.float32)), match="aabb", similarity=0.1)) == 2


@pytest.mark.parametrize("method", METHODS)
def test_a_crowd_of_the_own_view_hides_nobody(method: str) -> None:
    """Sixteen neighbours of the own view lie nearer than the twin of the other."""
    crowd = np.random.default_rng(0).normal(size=(40, 3)) * 1e-5
    features = make_features(np.concatenate([crowd, [[0, 0, 1e-3]]]), views=[0] * 40 + [1])
    assert max(map(len, sets(features, match=method))) == (2 if method == "overlap" else 41)


@pytest.mark.parametrize(("method", "count"), [*product((*METHODS, "none"), (0, 1)), ("none", 4)])
def test_no_feature_or_one_or_match_none_makes_no_pair(method: str, count: int) -> None:
    assert sets(make_features(np.zeros((count, 3))), match=method) == alone(count)


@pytest.mark.parametrize("method", METHODS)
def test_features_of_a_single_view_are_left_alone(method: str) -> None:
    assert sets(make_features(np.zeros((5, 3)), views=[2] * 5), match=method) == alone(5)


@pytest.mark.parametrize("method", METHODS)
def test_transparent_features_are_left_alone(method: str) -> None:
    features = make_features(np.zeros((4, 3)), opacities=[0.8, 0.0, 0.8, 0.0])
    assert sets(features, match=method) == {frozenset([0, 2]), frozenset([1]), frozenset([3])}


def test_as_many_to_a_cluster_as_there_are_views() -> None:
    """Those of no view, merged before, count like any other."""
    features = make_features(np.zeros((9, 3)), views=[-1, -1, -1, -1, -1, -1, 0, 1, 2])
    assert sorted(map(len, sets(features))) == [1, 4, 4]


def test_heaviest_feature_leads_a_chain() -> None:
    """A chain of three: the middle one takes both when it is the heaviest, else it goes to the heavier end."""
    means = [[0, 0, 0], [0.012, 0, 0], [0.024, 0, 0]]
    assert sets(make_features(means, opacities=[0.5, 0.9, 0.6])) == {frozenset([0, 1, 2])}
    assert sets(make_features(means, opacities=[0.5, 0.2, 0.6])) == {frozenset([0]), frozenset([1, 2])}


@pytest.mark.parametrize("method", METHODS)
def test_far_twins_are_found_among_many(method: str) -> None:
    rng = np.random.default_rng(0)
    means = rng.uniform(0, 10, (300, 3))
    features = make_features(np.concatenate([means, means[::-1]]), views=[0] * 300 + [1] * 300)
    assert sets(features, match=method) == {frozenset([i, 599 - i]) for i in range(300)}
