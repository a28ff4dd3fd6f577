"""Runs make named lines of means, with statistics that match known values and slow twins."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from experiments import SCENES, make_grid, make_record
from messages import refuses

from gsmerge.research.charts.lines import Results, line_key, line_names, mean_interval, paired_intervals, size_label

PSNR = "psnr_target_visible"


def test_each_method_with_its_settings_is_a_line() -> None:
    lines = Results(make_grid()).by_size("percent", PSNR)
    assert [line.name for line in lines] == ["gsmerge", "gsmerge, fit none", "greedy", "random"]
    assert [line.is_own for line in lines] == [True, True, False, False]
    assert [p.label for p in lines[0].points] == ["1%", "4.4%", "20%"]
    point = lines[0].points[1]
    assert point.x == pytest.approx(4.4)
    assert point.y.mean == pytest.approx(np.mean([26, 24.01, 21.02]))
    assert point.y.count == 3
    assert point.y.high - point.y.low < 0.2  # the scenes' own level, 5 dB apart, is taken off


def test_names_of_lines_tell_only_the_settings_that_differ() -> None:
    settings = [{"k": 2, "effort": "fast"}, {"k": 2, "effort": "best", "segmentation": "slic"}]
    keys = [line_key(make_record("fern", "gsmerge", one)) for one in settings]
    names = ["gsmerge, effort fast", "gsmerge, effort best, segmentation slic"]
    assert list(line_names(keys).values()) == names
    assert list(line_names(keys[:1]).values()) == ["gsmerge, effort fast, k 2"]
    sizes = [{"budget": "2%"}, {"budget": 40000}, {"superpixels": "1%"}, {}]
    labels = [size_label(replace(make_record("fern", "gsmerge"), settings=one)) for one in sizes]
    assert labels == ["2%", "40,000", "1% superpixels", ""]


def test_means_are_over_the_same_scenes() -> None:
    """One bad setting does not cost the scenes of the others."""
    grid = make_grid()
    few = [r for r in grid if not (r.scene == "fox" and r.method == "greedy" and r.settings["budget"] == "1%")]
    lines = Results(few).by_size("percent", PSNR)
    assert {frozenset(p.by_scene) for line in lines for p in line.points} == {frozenset({"apples", "fern"})}
    lines = Results([r for r in grid if r.scene == "fern" or r.method != "random"]).by_size("percent", PSNR)
    assert [line.name for line in lines] == ["gsmerge", "gsmerge, fit none", "greedy"]
    assert {len(p.by_scene) for line in lines for p in line.points} == {3}


def test_results_choose_the_views_and_metrics_that_most_runs_have() -> None:
    records = make_grid()
    assert (Results(records).part, Results(records).caveat) == ("target_visible", "")
    assert Results(records).metrics == ["psnr", "ssim", "lpips_vgg"]
    without = [replace(r, scores={"psnr_context": 20.0}) for r in records]
    assert Results(without).part == "context"
    assert "held out" in Results(without).caveat
    assert Results(without[:2] + records[2:]).part == "target_visible"  # nine of ten are enough
    assert Results([]).part == "context"


def test_level_of_the_input_is_its_mean_over_the_scenes() -> None:
    assert Results(make_grid()).input_mean(PSNR, SCENES) == pytest.approx(18 + (2 + 0 - 3) / 3 + 0.01)
    assert Results(make_grid()).input_mean(PSNR, ["unknown"]) is None


@pytest.mark.parametrize(("count", "factor"), [(2, 12.706), (3, 4.303), (5, 2.776), (11, 2.228), (31, 2.042)])
def test_confidence_interval_has_the_t_factors_of_the_tables(count: int, factor: float) -> None:
    values = [0.0, 1.0] + [0.5] * (count - 2)
    half = mean_interval(values).high - 0.5
    assert half * math.sqrt(count) / np.std(values, ddof=1) == pytest.approx(factor, abs=5e-4)


def test_intervals_of_one_value_have_no_width_and_of_none_are_refused() -> None:
    actual = mean_interval([21.5])
    assert (actual.mean, actual.low, actual.high, actual.count) == (21.5, 21.5, 21.5, 1)
    assert [(i.low, i.high) for i in paired_intervals(np.array([[1.0, 2.0]]))] == [(1, 1), (2, 2)]
    assert paired_intervals(np.array([[1.0], [3.0]])) == [mean_interval([1.0, 3.0])]
    with refuses(ValueError, "", "value", "none"):
        mean_interval([])


def test_paired_intervals_match_a_slow_twin() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(20, 5, (6, 1)) + rng.normal(0, 0.3, (6, 4))
    actual = paired_intervals(values)
    for j, interval in enumerate(actual):
        own = [values[i, j] - np.mean(values[i]) + np.mean(values) for i in range(6)]
        half = 2.570582 * np.std(own, ddof=1) / math.sqrt(6) * math.sqrt(4 / 3)
        assert interval.mean == pytest.approx(np.mean(values[:, j]))
        assert interval.high - interval.mean == pytest.approx(half)
        assert interval.mean - interval.low == pytest.approx(half)
        assert half < 1.0
