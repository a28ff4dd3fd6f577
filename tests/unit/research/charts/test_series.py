"""Which runs make a line, what it is called, and its means."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from experiments import SCENES, make_grid, make_proxies, make_record

from gsmerge.research.charts.figures import Bars, BreakEven, Curves, make_figures, make_verdict_tables
from gsmerge.research.charts.series import (
    by_size,
    by_views,
    choose_part,
    input_mean,
    line_key,
    line_names,
    list_metrics,
    newest,
    score_getter,
    size_label,
    typical_size,
    typical_views,
)

PSNR = score_getter("psnr", "target_visible")


def test_lines_are_methods_with_their_settings() -> None:
    lines = by_size(make_grid(), lambda r: r.ratio, PSNR)
    assert [line.name for line in lines] == ["gsmerge", "gsmerge, no fit", "voxel", "random"]
    assert [line.ours for line in lines] == [True, True, False, False]
    assert [p.label for p in lines[0].points] == ["1%", "4.4%", "20%"]
    point = lines[0].points[1]
    assert point.x == pytest.approx(0.044)
    assert point.y.mean == pytest.approx(np.mean([26, 24.01, 21.02]))
    assert point.y.count == 3
    assert point.y.high - point.y.low < 0.2  # the scenes' own level, 5 dB apart, is taken off


def test_no_scene_counts_twice() -> None:
    first, other = make_record("fern", "gsmerge", {"k": 2}), make_record("fox", "gsmerge", {"k": 2})
    again = replace(first, key="another seed", psnr_target_visible=20.0)
    few = replace(first, key="few", views_asked=3)
    assert newest([first, other, again, few]) == ([again, other, few], [])
    changed = replace(first, key="changed", scene_sha256="ff" * 32)
    records, notes = newest([first, few, other, changed])
    assert records == [other, changed]
    assert len(notes) == 1
    assert notes[0].startswith("fern: 2 run(s) left out")


def test_names_tell_only_what_differs() -> None:
    records = [
        make_record("fern", "gsmerge", {"k": 2, "effort": "fast"}),
        make_record("fern", "gsmerge", {"k": 2, "effort": "best", "segmentation": "slic"}),
        make_record("fern", "voxel"),
    ]
    names = line_names([line_key(r) for r in records])
    assert list(names.values()) == ["gsmerge, effort fast", "gsmerge, effort best, slic", "voxel"]
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
    lines = by_size(records, lambda r: r.ratio, PSNR)
    assert {frozenset(p.by_scene) for line in lines for p in line.points} == {frozenset({"apples", "fern"})}


def test_one_bad_setting_does_not_cost_the_scenes_of_the_others() -> None:
    records = [r for r in make_grid() if not (r.scene != "fern" and r.method == "random")]
    lines = by_size(records, lambda r: r.ratio, PSNR)
    assert [line.name for line in lines] == ["gsmerge", "gsmerge, no fit", "voxel"]
    assert {len(p.by_scene) for line in lines for p in line.points} == {3}


def test_usual_size_and_views() -> None:
    assert typical_size(make_grid(("0.5%", "5%", "20%"), views=(None,))) == "5%"
    assert typical_views(make_grid()) is None
    assert typical_views(make_grid(views=(3, 6))) == 6
    assert (typical_size([]), typical_views([])) == ("", None)


def test_views_make_lines_where_there_are_several() -> None:
    lines = by_views(make_grid(views=(None, 3, 6)), PSNR, with_input=True)
    assert [line.name for line in lines] == ["gsmerge", "gsmerge, no fit", "input", "voxel", "random"]
    assert [p.x for p in lines[0].points] == [3, 6, 12]
    assert by_views(make_grid(views=(None,)), PSNR) == []


def test_scenes_with_fewer_views_do_not_end_the_line() -> None:
    records = [r for r in make_grid(views=(3, 6)) if r.views_asked == 3 or r.scene != "a"]
    scenes = {r.scene for r in records}
    lines = by_views(records, PSNR)
    assert [[point.label for point in line.points] for line in lines] == [["3", "6"]] * len(lines) != []
    assert all(set(point.by_scene) == scenes - {"a"} for line in lines for point in line.points)


def test_parts_and_metrics() -> None:
    records = make_grid()
    assert choose_part(records) == "target_visible"
    assert list_metrics(records, "target_visible") == ["psnr", "ssim", "lpips_vgg"]
    without = [replace(r, psnr_target_visible=None) for r in records]
    assert choose_part(without) == "context"
    assert choose_part(without[:2] + records[2:]) == "target_visible"  # nine of ten are enough
    assert choose_part([]) == "context"


def test_the_input_is_a_level() -> None:
    assert input_mean(make_grid(), PSNR, SCENES) == pytest.approx(18 + (2 + 0 - 3) / 3 + 0.01)
    assert input_mean(make_grid(), PSNR, ["unknown"]) is None


def test_all_figures() -> None:
    figures = make_figures(make_grid(), make_proxies())
    names = ["quality-seconds", "quality-ratio", "stages", "proxy", "count-views", "quality-views", "break-even"]
    assert [figure.name for figure in figures if not figure.name.endswith("-all")] == names
    doubled = ["quality-seconds", "quality-ratio", "quality-views", "break-even"]
    assert [figure.name for figure in figures if figure.name not in names] == [f"{name}-all" for name in doubled]
    assert all("3 scenes" in f.caption or "3 scene(s)" in f.caption for f in figures)
    by_name = {figure.name: figure for figure in figures}
    stages, payback, counts = by_name["stages"], by_name["break-even"], by_name["count-views"]
    assert isinstance(stages, Bars)
    assert stages.rows == ("gsmerge", "gsmerge, no fit", "voxel", "random")
    assert stages.stages["fit"][0] == pytest.approx(4.8)
    assert "score" not in stages.stages
    assert isinstance(payback, BreakEven)
    assert payback.rows[0][3] == pytest.approx(6 / 0.055)
    assert isinstance(counts, Curves)
    assert [line.name for line in counts.panels[0].lines] == ["gsmerge", "input"]  # all others meet the same budget


def test_bars_and_break_even_are_over_the_same_scenes() -> None:
    records = [r for r in make_grid() if not (r.scene == "fox" and r.method == "voxel")]
    records = [r for r in records if not (r.scene != "fern" and r.method == "random")]
    slow = [replace(r, seconds=100.0, stages={"fit": 100.0}) if r.scene == "fox" and r.seconds else r for r in records]
    stages, payback = (f for f in make_figures(slow) if f.name in ("stages", "break-even-all"))
    assert isinstance(stages, Bars)
    assert isinstance(payback, BreakEven)
    assert stages.rows == tuple(name for name, *_ in payback.rows) == ("gsmerge", "gsmerge, no fit", "voxel")
    assert stages.stages["fit"][0] == pytest.approx(4.8)
    assert payback.rows[0][1] == pytest.approx(6)


def test_figures_need_their_data() -> None:
    assert make_figures([]) == []
    failed = [replace(r, error="out of memory") for r in make_grid()]
    assert make_figures(failed) == []
    alone = make_figures([make_record("fern", "gsmerge")])
    assert [f.name for f in alone] == ["quality-seconds", "quality-ratio", "stages"]
    assert "one scene has no intervals" in alone[0].caption


def test_verdicts() -> None:
    tables = make_verdict_tables(make_grid())
    assert [t.title for t in tables[3:]] == [
        "PSNR (dB) at equal size",
        "SSIM at equal size",
        "LPIPS (VGG) at equal size",
    ]
    assert [t.title.split(" at ")[1] for t in tables] == ["equal time"] * 3 + ["equal size"] * 3
    assert {verdict.words for _, verdict in tables[0].rows} == {"ours has none so cheap"}
    assert [label for label, _ in tables[3].rows] == ["1%", "4.4%", "20%"] * 2
    for table in tables[3:]:
        assert {verdict.words for _, verdict in table.rows} == {"ours above"}
    voxel = tables[3].rows[1][1]
    assert voxel.ahead is not None
    assert voxel.ahead.mean == pytest.approx(7)
    assert make_verdict_tables([r for r in make_grid() if r.method != "gsmerge"]) == []
