"""Which views are context and which are targets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from messages import noted, refuses

from gsmerge.facts.views import (
    MAX_SCORED_VIEWS,
    REPORT_VIEWS,
    distinct_views,
    even_views,
    midpoint_views,
    pick_views,
    scored_views,
    subset,
)
from gsmerge.types import Scene


@pytest.mark.parametrize(
    ("num_views", "count", "expected"),
    [(12, 3, [0, 6, 11]), (12, 12, list(range(12))), (5, 1, [2]), (7, 2, [0, 6]), (1, 1, [0])],
)
def test_even_views(num_views: int, count: int, expected: list[int]) -> None:
    assert even_views(num_views, count) == expected


@pytest.mark.parametrize("count", [0, 6])
def test_more_views_than_there_are(count: int) -> None:
    with refuses(ValueError, "views", "1 to 5"):
        even_views(5, count)


def test_even_views_are_distinct_and_keep_the_ends() -> None:
    for num_views in range(2, 40):
        for count in range(2, num_views + 1):
            ids = even_views(num_views, count)
            assert ids == sorted(set(ids))
            assert (ids[0], ids[-1], len(ids)) == (0, num_views - 1, count)


def test_few_views_are_all_judged_by_and_many_by_some() -> None:
    assert [scored_views(count) for count in (1, 2, 24)] == [[0], [0, 1], list(range(24))]
    assert len(scored_views(84)) == MAX_SCORED_VIEWS
    assert (scored_views(84)[0], scored_views(84)[-1]) == (0, 83)


def test_the_report_is_of_few_views_that_are_spread() -> None:
    assert [pick_views(count, REPORT_VIEWS) for count in (1, 3)] == [[0], [0, 1, 2]]
    assert pick_views(84, REPORT_VIEWS) == [10, 31, 52, 73]


def test_targets_lie_midway() -> None:
    assert midpoint_views([0, 10, 20], [1, 4, 6, 9, 14, 15, 21]) == [1, 5]
    assert midpoint_views([10, 0], [4.0, 6.0]) == [0]  # the earlier of two that are as near
    assert midpoint_views([0, 1, 2], [1.5]) == [0]
    assert midpoint_views([3], [1, 2]) == []


@pytest.mark.parametrize(
    ("num_frames", "count", "expected"),
    [
        (31, 3, ([0, 15, 30], [7, 22])),
        (61, 6, ([0, 12, 24, 36, 48, 60], [6, 18, 30, 42, 54])),
        (4, 3, ([0, 2, 3], [1])),  # no frame between the last two
        (4, 4, ([0, 1, 2, 3], [])),
        (9, 1, ([4], [])),
    ],
)
def test_the_paper_s_lists(num_frames: int, count: int, expected: tuple[list[int], list[int]]) -> None:
    context = even_views(num_frames, count)
    assert (context, midpoint_views(context, range(num_frames))) == expected


def test_subset_is_the_scene_of_those_views() -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(4))
    small = subset(scene, [3, 1])
    expected = scenes.take_views(scene, [3, 1])
    assert np.array_equal(small.gaussians.means, expected.gaussians.means)
    assert np.array_equal(small.cameras.viewmats, expected.cameras.viewmats)
    assert np.array_equal(small.images, expected.images)
    assert small.names == ("003.png", "001.png")


def test_gaussians_in_no_order_all_stay() -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3))
    unaligned = Scene(scene.gaussians, scene.cameras, scene.images, None, scene.names)
    small = subset(unaligned, [2])
    assert len(small.gaussians) == len(scene.gaussians)
    assert np.array_equal(small.cameras.viewmats, scene.cameras.viewmats[2:])


def test_only_true_repeats_count_as_such() -> None:
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


@pytest.mark.parametrize("settings", [{}, {"budget": "10%"}], ids=str)
def test_repeats_change_nothing_but_the_share(settings: dict[str, str]) -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(2))
    one = scenes.compacted(scene, fit="none", **settings)
    two = scenes.compacted(subset(scene, [0, 1, 1, 0]), fit="none", **settings)
    if settings:  # a share of the file, which has twice as many Gaussians
        assert len(two.gaussians) == pytest.approx(2 * len(one.gaussians), abs=1)
    else:
        assert scenes.identical(one.gaussians, two.gaussians)
    assert noted(two.report.notes, "once")
