"""What figures show, their key with the names of the lines, and drawings that repeat to the byte."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import matplotlib
import pytest
from experiments import make_grid, make_record
from matplotlib.axes import Axes

from gsmerge.research.charts.figures import (
    MAX_LINES,
    RC,
    Figure,
    Panel,
    choose_lines,
    draw_curves,
    draw_figures,
    line_styles,
    make_figures,
)
from gsmerge.research.charts.lines import Interval, Line, Point, Results
from gsmerge.research.charts.measure_run import RunRecord

METHODS = ("gsmerge", "voxel")
NAMES = ["quality-seconds", "quality-ratio", "quality-views"]


def figures_of(records: list[RunRecord]) -> list[Figure]:
    return make_figures(Results(records))


def test_all_figures() -> None:
    figures = figures_of(make_grid())
    assert [figure.name for figure in figures] == NAMES
    assert all("3 scenes" in f.caption for f in figures)
    assert all(len(row) == len(f.head) for f in figures for row in f.rows)


def test_figures_need_their_data() -> None:
    assert figures_of([]) == []
    assert figures_of([replace(r, error="out of memory") for r in make_grid()]) == []
    alone = figures_of([make_record("fern", "gsmerge")])
    assert [f.name for f in alone] == ["quality-seconds", "quality-ratio"]
    assert "one scene has no intervals" in alone[0].caption


def figure_of(count: int) -> Figure:
    """One panel with so many lines of a point each, and the input."""
    points = [(Interval(20 + i, 19 + i, 21 + i, 4), 0.1 * (i + 1)) for i in range(count)]
    lines = tuple(Line(f"method {i}", i == 0, (Point("1%", x, y, {}),)) for i, (y, x) in enumerate(points))
    return Figure("quality", "", "", "Seconds", (), (), (Panel("PSNR", True, lines, 22.0),), log=True)


@pytest.mark.parametrize("count", [1, 25])
def test_the_key_names_every_line_and_fits(count: int) -> None:
    """The reference is a name, too."""
    figure = figure_of(count)
    lines = figure.panels[0].lines
    with matplotlib.rc_context(RC):
        drawing = draw_curves(figure, line_styles((x.name, False) for x in lines))
        drawing.draw_without_rendering()
    (key,) = drawing.legends
    assert [text.get_text() for text in key.get_texts()] == [*(line.name for line in lines), "input"]
    box = key.get_window_extent()
    assert drawing.bbox.x0 <= box.x0 < box.x1 <= drawing.bbox.x1
    assert drawing.bbox.y0 <= box.y0 < box.y1 <= drawing.bbox.y1
    assert all(axes.bbox.x1 <= box.x0 for axes in drawing.axes)


def test_no_two_lines_have_one_colour_and_mark() -> None:
    names = [(f"{name} {i}", name == "gsmerge") for name in METHODS for i in range(20)]
    styles = line_styles([("input", False), *names])
    assert len({(style["color"], style["marker"]) for style in styles.values()}) == 41


def line(name: str, *quality: float) -> Line:
    points = (Point(f"{i} %", i + 1.0, Interval(y, y, y, 1), {}) for i, y in enumerate(quality))
    return Line(name, name.startswith("gsmerge"), tuple(points))


def test_of_many_lines_one_for_each_method_is_drawn() -> None:
    """The best of those with several points; a few lines are all drawn."""
    lines = (
        line("gsmerge", 20, 21), line("gsmerge, fast", 19, 20, 20), line("gsmerge, best", 30), line("voxel, a", 9, 9),
        line("voxel, b", 10, 12),
    )  # fmt: skip
    many = (*lines, *(line(f"random, {i}", 5 - i) for i in range(MAX_LINES)))
    assert choose_lines(Panel("PSNR", True, lines)) == {one.name for one in lines}
    assert choose_lines(Panel("PSNR", True, many)) == {"gsmerge", "voxel, b", "random, 0"}
    assert choose_lines(Panel("LPIPS", False, many)) == {"gsmerge, fast", "voxel, a", f"random, {MAX_LINES - 1}"}
    records = [make_record("fern", "gsmerge", {"budget": "1%", "max_color": i / 20}) for i in range(MAX_LINES + 1)]
    figure = figures_of(records)[0]
    assert len(figure.panels[0].lines) == 1
    assert figure.caption.endswith("One line for each method; the table has all.")
    assert len({row[1] for row in figure.rows}) == MAX_LINES + 1


def axes_of(figure: Figure) -> Axes:
    with matplotlib.rc_context(RC):
        drawing = draw_curves(figure, line_styles((line.name, line.is_own) for line in figure.panels[0].lines))
        drawing.draw_without_rendering()
    return drawing.axes[0]


@pytest.mark.slow
def test_ticks_are_round_and_a_logarithmic_axis_says_so() -> None:
    """Over time, where each method has costs of its own, ours has the sizes at its points."""
    sizes = ("1%", "4%", "10%")
    records = [
        replace(make_record(scene, method, {"budget": size}), count=round(120 * float(size[:-1]) * wobble))
        for scene in ("fern", "fox")
        for method, wobble in (("gsmerge", 1.0), ("voxel", 1.02))
        for size in sizes
    ]
    seconds, ratio = (f for f in figures_of(records) if f.name in ("quality-seconds", "quality-ratio"))
    over_time, over_ratio = axes_of(seconds), axes_of(ratio)
    assert {"1", "2", "5", "10"} <= {text.get_text() for text in over_ratio.get_xticklabels()}
    assert [text.get_text() for text in over_time.texts] == list(sizes)
    assert not list(over_ratio.texts)
    for axes in (over_time, over_ratio):
        assert axes.get_xlabel().endswith("log scale")
        assert "log" not in axes.get_ylabel()


def test_two_scenes_have_no_interval_in_the_table() -> None:
    records = [make_record(scene, "gsmerge", {"budget": "1%"}) for scene in ("fern", "fox")]
    assert all(row[-2:] == ("", "") for row in figures_of(records)[0].rows)


@pytest.mark.slow
def test_drawings_repeat_to_the_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draw_figures([figure_of(2)], tmp_path / "a")
    monkeypatch.setitem(matplotlib.rcParams, "font.size", 30)  # the user's own style does not matter
    drawn = draw_figures([figure_of(2)], tmp_path / "b")
    names = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert names == ["quality.png", "quality.svg"]
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert matplotlib.rcParams["font.size"] == 30
    assert drawn["quality"] == (tmp_path / "a" / "quality.svg").read_bytes()
    assert b"<dc:date>" not in drawn["quality"]


def test_names_are_no_formulas_in_drawings(tmp_path: Path) -> None:
    figure = figure_of(2)
    names = ("a $\\frac{$ b", "_\\$")
    lines = tuple(replace(line, name=name) for line, name in zip(figure.panels[0].lines, names, strict=True))
    assert draw_figures([replace(figure, panels=(replace(figure.panels[0], lines=lines),))], tmp_path)
