"""Figures repeat to the byte, and the page stands alone and escapes text."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import matplotlib
import pytest
from experiments import make_grid, make_record

from gsmerge.research.charts.chart_page import make_chart_page, make_table
from gsmerge.research.charts.figures import RC, Chart, Panel, draw_curves, draw_figures, line_styles, make_figures
from gsmerge.research.charts.lines import Interval, Line, Point, Results
from gsmerge.research.charts.measure_run import RunRecord

EVIL = "<script>alert('x')</script>\"&</title>"


class Outline(HTMLParser):
    """Tags that are open at the end, and attributes that fetch."""

    VOID = ("meta", "img", "input", "br", "link")

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.fetched: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.fetched += [value or "" for name, value in attrs if name in ("src", "href", "action", "data", "srcset")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def page_of(records: list[RunRecord], folder: Path) -> str:
    figures = make_figures(Results(records))[-1:]
    return make_chart_page(records, figures, draw_figures(figures, folder / "charts"), "gsmerge lab chart")


def test_page_fetches_nothing_and_lists_the_runs(tmp_path: Path) -> None:
    """One figure; Matplotlib takes half a second for it."""
    page = page_of(make_grid(budgets=("1%", "4.4%")), tmp_path)
    actual = Outline(page)
    assert actual.open == []
    assert [value for value in actual.fetched if not value.startswith(("#", "data:image/"))] == []
    assert "://" not in page
    assert "default-src &#x27;none&#x27;" in page
    assert "27 runs on 3 scenes: apples, fern, fox" in page
    assert "Failed runs" not in page
    for text in ("<pre>gsmerge lab chart</pre>", ">Quality against size</h2>", "<td>gsmerge, fit none</td><td>1%</td>"):
        assert text in page


def test_names_from_files_are_escaped(tmp_path: Path) -> None:
    records = [make_record("fern", "input"), make_record("fern", "gsmerge")]
    records = [replace(r, scene=EVIL, settings={EVIL: EVIL}) for r in records]
    made = page_of([*records, replace(records[0], label=EVIL, error=EVIL)], tmp_path)
    assert "<script>alert" not in made
    assert Outline(made).open == []
    assert "&lt;script&gt;alert(&#39;x&#39;)" in made
    assert "1 failed" in made


def test_the_table_has_a_row_for_each_run() -> None:
    records = [*make_grid(), replace(make_grid()[1], error="=cmd()")]
    rows = list(csv.DictReader(io.StringIO(make_table(records))))
    assert len(rows) == len(records)
    assert float(rows[1]["psnr_target_visible"]) == records[1].scores["psnr_target_visible"]
    assert rows[-1]["error"] == "'=cmd()"


def test_figures_without_their_data_are_left_out() -> None:
    figures = make_figures(Results(make_grid()))
    assert [figure.name for figure in figures] == ["quality-seconds", "quality-ratio"]
    assert all("3 scenes" in figure.caption for figure in figures)
    assert all(len(row) == len(figure.head) for figure in figures for row in figure.rows)
    assert make_figures(Results([replace(r, error="out of memory") for r in make_grid()])) == []
    alone = make_figures(Results([make_record("fern", "gsmerge")]))
    assert "one scene has no intervals" in alone[0].caption
    assert alone[0].rows[0][-2:] == ("", "")


def figure_of(count: int, name: str = "method") -> Chart:
    """Return one panel with so many lines of a point each, and the input."""
    points = [Point("1%", 0.1 * (i + 1), Interval(20 + i, 19 + i, 21 + i, 4), {}) for i in range(count)]
    lines = tuple(Line(f"{name} {i}", i == 0, (point,)) for i, point in enumerate(points))
    return Chart("quality", "", "", "Seconds", (), (), (Panel("PSNR", True, lines, 22.0),))


@pytest.mark.parametrize("count", [1, 25])
def test_key_names_every_line_within_the_figure(count: int) -> None:
    figure = figure_of(count)
    names = [line.name for line in figure.panels[0].lines]
    styles = line_styles((name, False) for name in names)
    assert len({(style["color"], style["marker"]) for style in styles.values()}) == count + 1
    with matplotlib.rc_context(RC):
        drawing = draw_curves(figure, styles)
        drawing.draw_without_rendering()
    (key,) = drawing.legends
    assert [text.get_text() for text in key.get_texts()] == [*names, "input"]
    box = key.get_window_extent()
    assert drawing.bbox.x0 <= box.x0 < box.x1 <= drawing.bbox.x1
    assert drawing.bbox.y0 <= box.y0 < box.y1 <= drawing.bbox.y1
    assert all(axes.bbox.x1 <= box.x0 for axes in drawing.axes)
