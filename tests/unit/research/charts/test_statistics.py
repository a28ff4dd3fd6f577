"""Statistics of the charts against known values and slow twins."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gsmerge.research.charts.statistics import (
    judge,
    mean_interval,
    paired_difference,
    paired_intervals,
    pareto_front,
    quality_at,
    t_factor,
)


@pytest.mark.parametrize(("count", "factor"), [(2, 12.706), (3, 4.303), (5, 2.776), (11, 2.228), (31, 2.042)])
def test_t_factors_are_those_of_the_tables(count: int, factor: float) -> None:
    assert t_factor(count) == pytest.approx(factor, abs=5e-4)


def test_mean_interval() -> None:
    actual = mean_interval([20.0, 22.0, 27.0])
    half = 4.302653 * np.std([20, 22, 27], ddof=1) / math.sqrt(3)
    assert (actual.mean, actual.count) == (23, 3)
    assert actual.low == pytest.approx(23 - half, abs=1e-5)
    assert actual.high == pytest.approx(23 + half, abs=1e-5)


def test_one_scene_has_a_mean_and_no_width() -> None:
    actual = mean_interval([21.5])
    assert (actual.mean, actual.low, actual.high, actual.count) == (21.5, 21.5, 21.5, 1)
    with pytest.raises(ValueError, match="at least one value"):
        mean_interval([])


def test_pairing_takes_out_what_scenes_differ_by() -> None:
    ours = {"a": 15.0, "b": 25.0, "c": 31.0, "only ours": 99.0}
    theirs = {"a": 14.0, "b": 24.1, "c": 29.9}
    actual = paired_difference(ours, theirs)
    assert actual.mean == pytest.approx(1.0)
    assert actual.count == 3
    assert actual.low > 0.7
    assert mean_interval(list(ours.values())[:3]).high - mean_interval([15, 25, 31]).low > 10


def test_paired_intervals_match_a_slow_twin() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(20, 5, (6, 1)) + rng.normal(0, 0.3, (6, 4))
    actual = paired_intervals(values)
    for j, interval in enumerate(actual):
        own = [values[i, j] - np.mean(values[i]) + np.mean(values) for i in range(6)]
        half = t_factor(6) * np.std(own, ddof=1) / math.sqrt(6) * math.sqrt(4 / 3)
        assert interval.mean == pytest.approx(np.mean(values[:, j]))
        assert interval.high - interval.mean == pytest.approx(half)
        assert interval.mean - interval.low == pytest.approx(half)
        assert half < 1.0


def test_paired_intervals_of_one_scene_or_one_condition() -> None:
    one_scene = paired_intervals(np.array([[1.0, 2.0]]))
    assert [(i.low, i.high) for i in one_scene] == [(1, 1), (2, 2)]
    assert paired_intervals(np.array([[1.0], [3.0]])) == [mean_interval([1.0, 3.0])]


def test_front_by_hand() -> None:
    costs, qualities = [1, 2, 2, 3, 4, 5], [10, 9, 12, 12, 11, 13]
    assert pareto_front(costs, qualities) == [0, 2, 5]
    assert pareto_front([], []) == []
    assert pareto_front([1, 1], [5, 5]) == [0]


def test_front_holds_what_nothing_beats() -> None:
    rng = np.random.default_rng(1)
    costs, qualities = rng.integers(1, 9, 40).tolist(), rng.integers(1, 9, 40).tolist()
    front = pareto_front(costs, qualities)

    def beaten(i: int) -> bool:
        better = [(costs[j] <= costs[i] and qualities[j] > qualities[i]) for j in range(40)]
        cheaper = [(costs[j] < costs[i] and qualities[j] >= qualities[i]) for j in range(40)]
        return any(better) or any(cheaper)

    points = {(costs[i], qualities[i]) for i in range(40) if not beaten(i)}
    assert {(costs[i], qualities[i]) for i in front} == points
    assert len(front) == len(points)


def test_quality_between_beyond_and_below() -> None:
    costs, qualities = [1.0, 100.0, 10.0], [20.0, 26.0, 22.0]
    assert quality_at(costs, qualities, math.sqrt(10)) == pytest.approx(21)
    assert quality_at(costs, qualities, 10) == pytest.approx(22)
    assert quality_at(costs, qualities, 1e6) == 26
    assert quality_at(costs, qualities, 0.99) is None
    assert quality_at([], [], 1.0) is None
    assert quality_at([1, 10, 100], [20, 25, 22], 100) == 25  # a worse and dearer point does not pull the front down


OURS = {scene: [(1.0, 20.0 + i), (10.0, 24.0 + i)] for i, scene in enumerate("abc")}


@pytest.mark.parametrize(
    ("shift", "words"),
    [((-1.0, -1.1, -0.9), "ours above"), ((1, 1.1, 0.9), "baseline above"), ((-1, 1, 0), "undecided")],
)
def test_verdicts(shift: tuple[float, ...], words: str) -> None:
    points = {scene: (10.0, 24.0 + i + shift[i]) for i, scene in enumerate("abc")}
    actual = judge("voxel", points, OURS)
    assert (actual.baseline, actual.words) == ("voxel", words)
    assert actual.ahead is not None
    assert actual.ahead.mean == pytest.approx(-np.mean(shift))
    assert actual.ours == pytest.approx(25)
    assert actual.quality == pytest.approx(25 + np.mean(shift))


def test_verdicts_where_less_is_better() -> None:
    ours = {"a": [(1.0, 0.3), (10.0, 0.2)]}
    actual = judge("voxel", {"a": (10.0, 0.25)}, ours, higher=False)
    assert actual.words == "ours above"
    assert actual.ours == pytest.approx(0.2)
    assert actual.quality == pytest.approx(0.25)
    assert actual.ahead is not None
    assert actual.ahead.mean == pytest.approx(0.05)


def test_nothing_is_said_where_ours_has_nothing_as_cheap() -> None:
    actual = judge("random", {"a": (0.1, 30.0)}, OURS)
    assert (actual.ours, actual.ahead, actual.quality) == (None, None, 30)
    assert actual.words == "ours has none so cheap"


def test_one_scene_of_several_says_nothing() -> None:
    curve = {"a": [(1.0, 20.0)], "b": [(9.0, 20.0)]}
    actual = judge("voxel", {"a": (2.0, 15.0), "b": (2.0, 15.0)}, curve)
    assert (actual.words, actual.ahead and actual.ahead.count) == ("undecided", 1)
    assert judge("voxel", {"a": (2.0, 15.0)}, curve).words == "ours above"
