"""Some views are context, and others are targets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge.method.geometry.views import (
    MAX_SCORED_VIEWS,
    REPORT_VIEWS,
    even_views,
    midpoint_views,
    pick_views,
    scored_views,
    subset,
)
from gsmerge.prepare.repeats import distinct_views
from gsmerge.types import Scene


@pytest.mark.parametrize(
    ("num_views", "count", "expected"),
    [(12, 3, [0, 6, 11]), (12, 12, list(range(12))), (5, 1, [2]), (7, 2, [0, 6]), (1, 1, [0])],
)
def test_even_views_are_spread_over_all_views(num_views: int, count: int, expected: list[int]) -> None:
    assert even_views(num_views, count) == expected


def test_even_views_are_distinct_and_keep_the_ends() -> None:
    for num_views in range(2, 40):
        for count in range(2, num_views + 1):
            ids = even_views(num_views, count)
            assert ids == sorted(set(ids))
            assert (ids[0], ids[-1], len(ids)) == (0, num_views - 1, count)


def test_all_of_few_views_and_some_of_many_are_scored() -> None:
    assert [scored_views(count) for count in (1, 2, 24)] == [[0], [0, 1], list(range(24))]
    assert len(scored_views(84)) == MAX_SCORED_VIEWS
    assert (scored_views(84)[0], scored_views(84)[-1]) == (0, 83)


def test_report_scores_few_views_that_are_spread() -> None:
    assert [pick_views(count, REPORT_VIEWS) for count in (1, 3)] == [[0], [0, 1, 2]]
    assert pick_views(84, REPORT_VIEWS) == [7, 21, 35, 49, 63, 77]


def test_midpoint_views_are_those_nearest_to_the_middle_of_two_inputs() -> None:
    assert midpoint_views([0, 10, 20], [1, 4, 6, 9, 14, 15, 21]) == [1, 5]
    assert midpoint_views([10, 0], [4.0, 6.0]) == [0]  # the earlier of two that are as near
    assert midpoint_views([0, 1, 2], [1.5]) == [0]
    assert midpoint_views([3], [1, 2]) == []


def test_subset_of_views_is_the_scene_of_those_views() -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(4))
    small = subset(scene, [3, 1])
    expected = scenes.take_views(scene, [3, 1])
    assert np.array_equal(small.gaussians.means, expected.gaussians.means)
    assert np.array_equal(small.cameras.viewmats, expected.cameras.viewmats)
    assert np.array_equal(small.images, expected.images)
    assert small.names == ("003.png", "001.png")
    unaligned = subset(replace(scene, pixels=None), [2])
    assert len(unaligned.gaussians) == len(scene.gaussians)  # in no order, all stay
    assert np.array_equal(unaligned.cameras.viewmats, scene.cameras.viewmats[2:3])


def test_only_equal_views_count_as_repeats() -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3))
    twice = subset(scene, [0, 1, 0, 2, 1])
    assert distinct_views(scene)[0] == [0, 1, 2]
    assert distinct_views(twice)[0] == [0, 1, 3]
    assert distinct_views(twice)[1] == [0, 1, 0, 2, 1]
    other_photo = twice.images.copy()
    other_photo[2, 0, 0] = 0
    assert distinct_views(replace(twice, images=other_photo))[0] == [0, 1, 2, 3]
    other_depth = twice.gaussians.means.copy()
    other_depth[-1] += 1
    assert distinct_views(replace(twice, gaussians=replace(twice.gaussians, means=other_depth)))[0] == [0, 1, 3, 4]
    unaligned = Scene(scene.gaussians, twice.cameras, twice.images, None, twice.names)
    assert distinct_views(unaligned)[0] == [0, 1, 3]
