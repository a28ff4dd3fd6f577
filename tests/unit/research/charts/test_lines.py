"""Which runs make a line, what it is called, its means, and statistics against known values and slow twins."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from experiments import SCENES, make_grid, make_record
from messages import refuses

from gsmerge.research.charts.lines import Results, line_key, line_names, mean_interval, paired_intervals, size_label

PSNR = "psnr_target_visible"


def test_lines_are_methods_with_their_settings() -> None:
    lines = Results(make_grid()).by_size("ratio", PSNR)
    assert [line.name for line in lines] == ["gsmerge", "gsmerge, no fit", "voxel", "random"]
    assert [line.is_own for line in lines] == [True, True, False, False]
    assert [p.label for p in lines[0].points] == ["1%", "4.4%", "20%"]
    point = lines[0].points[1]
    assert point.x == pytest.approx(0.044)
    assert point.y.mean == pytest.approx(np.mean([26, 24.01, 21.02]))
    assert point.y.count == 3
    assert point.y.high - point.y.low < 0.2  # the scenes' own level, 5 dB apart, is taken off


def test_names_tell_only_what_differs() -> None:
    records = [
        make_record("fern", "gsmerge", {"k": 2, "effort": "fast"}),
        make_record("fern", "gsmerge", {"k": 2, "effort": "best", "segmentation": "bass"}),
        make_record("fern", "voxel"),
    ]
    names = line_names([line_key(r) for r in records])
    assert list(names.values()) == ["gsmerge, effort fast", "gsmerge, effort best, bass", "voxel"]
    alone = line_names([line_key(records[0])])
    assert list(alone.values()) == ["gsmerge, effort fast, K = 2"]


def test_sizes_have_names() -> None:
    sizes = [{"budget": "2%"}, {"budget": 40000}, {"superpixels": "1%"}, {}]
    labels = [size_label(replace(make_record("fern", "gsmerge"), settings=settings)) for settings in sizes]
    assert labels == ["2%", "40,000", "1% superpixels", ""]


def test_means_are_over_the_same_scenes() -> None:
    records = [
        r for r in make_grid() if not (r.scene == "fox" and r.method == "voxel" and r.settings["budget"] == "1%")
    ]
    lines = Results(records).by_size("ratio", PSNR)
    assert {frozenset(p.by_scene) for line in lines for p in line.points} == {frozenset({"apples", "fern"})}


def test_one_bad_setting_does_not_cost_the_scenes_of_the_others() -> None:
    records = [r for r in make_grid() if not (r.scene != "fern" and r.method == "random")]
    lines = Results(records).by_size("ratio", PSNR)
    assert [line.name for line in lines] == ["gsmerge", "gsmerge, no fit", "voxel"]
    assert {len(p.by_scene) for line in lines for p in line.points} == {3}


def test_usual_size_and_views() -> None:
    assert Results(make_grid(("0.5%", "5%", "20%"), views=(None,))).size == "5%"
    assert Results(make_grid()).views is None
    assert Results(make_grid(views=(3, 6))).views == 6
    assert (Results([]).size, Results([]).views) == ("", None)


def test_views_make_lines_where_there_are_several() -> None:
    lines = Results(make_grid(views=(None, 3, 6))).by_views(PSNR)
    assert [line.name for line in lines] == ["gsmerge", "gsmerge, no fit", "input", "voxel", "random"]
    assert [p.x for p in lines[0].points] == [3, 6, 12]
    assert Results(make_grid(views=(None,))).by_views(PSNR) == []


def test_scenes_with_fewer_views_do_not_end_the_line() -> None:
    records = [r for r in make_grid(views=(3, 6)) if r.views_asked == 3 or r.scene != "a"]
    scenes = {r.scene for r in records}
    lines = Results(records).by_views(PSNR)
    assert [[point.label for point in line.points] for line in lines] == [["3", "6"]] * len(lines) != []
    assert all(set(point.by_scene) == scenes - {"a"} for line in lines for point in line.points)


def test_parts_and_metrics() -> None:
    records = make_grid()
    assert Results(records).part == "target_visible"
    assert Results(records).metrics == ["psnr", "ssim", "lpips_vgg"]
    without = [replace(r, scores={"psnr_context": 20.0}) for r in records]
    assert Results(without).part == "context"
    assert Results(without[:2] + records[2:]).part == "target_visible"  # nine of ten are enough
    assert Results([]).part == "context"


def test_the_input_is_a_level() -> None:
    assert Results(make_grid()).input_mean(PSNR, SCENES) == pytest.approx(18 + (2 + 0 - 3) / 3 + 0.01)
    assert Results(make_grid()).input_mean(PSNR, ["unknown"]) is None


@pytest.mark.parametrize(("count", "factor"), [(2, 12.706), (3, 4.303), (5, 2.776), (11, 2.228), (31, 2.042)])
def test_t_factors_are_those_of_the_tables(count: int, factor: float) -> None:
    values = [0.0, 1.0] + [0.5] * (count - 2)
    half = mean_interval(values).high - 0.5
    assert half * math.sqrt(count) / np.std(values, ddof=1) == pytest.approx(factor, abs=5e-4)


def test_one_scene_has_a_mean_and_no_width() -> None:
    actual = mean_interval([21.5])
    assert (actual.mean, actual.low, actual.high, actual.count) == (21.5, 21.5, 21.5, 1)
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


def test_paired_intervals_of_one_scene_or_one_condition() -> None:
    one_scene = paired_intervals(np.array([[1.0, 2.0]]))
    assert [(i.low, i.high) for i in one_scene] == [(1, 1), (2, 2)]
    assert paired_intervals(np.array([[1.0], [3.0]])) == [mean_interval([1.0, 3.0])]
