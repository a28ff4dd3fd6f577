"""The page stands alone, escapes text, and shows what was measured."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from experiments import make_grid

from gsmerge.research.charts.chart_page import make_page, make_table
from gsmerge.research.charts.figures import draw_figures, make_figures
from gsmerge.research.charts.lines import Results
from gsmerge.research.charts.measure_run import RunRecord, picture_path

EVIL = "<script>alert('x')</script>\"&</title>"


class Outline(HTMLParser):
    """Tags that are open at the end, ids, and attributes that fetch."""

    VOID = ("meta", "img", "input", "br", "link")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.fetched: list[str] = []
        self.scripts = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.scripts += tag == "script"
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in ("src", "href", "xlink:href", "action", "data", "srcset"):
                self.fetched.append(value or "")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def outline(page: str) -> Outline:
    parser = Outline()
    parser.feed(page)
    return parser


def page_of(records: list[RunRecord], folder: Path, most_figures: int = 1) -> str:
    figures = make_figures(Results(records))[::-1][:most_figures]
    return make_page(records, figures, draw_figures(figures, folder / "charts"), folder, "gsmerge lab chart")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    """With two figures, since their ids share the page; Matplotlib takes a second for both."""
    return page_of(make_grid(budgets=("1%", "4.4%")), tmp_path_factory.mktemp("results"), most_figures=2)


@pytest.mark.slow
def test_the_page_is_well_formed(page: str) -> None:
    actual = outline(page)
    assert actual.open == []
    assert len(actual.ids) == len(set(actual.ids))
    assert page.startswith("<!DOCTYPE html>\n<html lang=")


def test_the_page_fetches_nothing(page: str) -> None:
    assert [value for value in outline(page).fetched if not value.startswith(("#", "data:image/"))] == []
    assert "://" not in page
    assert "url(" not in page
    assert "@import" not in page
    assert "default-src &#x27;none&#x27;" in page
    assert "script-src &#x27;sha256-" in page
    assert "unsafe-inline" not in page
    assert ' style="' not in page


def test_every_reference_inside_the_page_is_there(page: str) -> None:
    actual = outline(page)
    inside = {value[1:] for value in actual.fetched if value.startswith("#")}
    assert len(inside) == 2
    assert inside - set(actual.ids) == set()


def test_the_page_says_what_was_found(page: str) -> None:
    assert "42 runs on 3 scenes: apples, fern, fox" in page
    assert "gsmerge lab chart scenes --grid budget=1%,4.4%" in page
    assert "<td>processor</td><td>one</td>" in page
    assert "Failed runs" not in page
    for title in ("Results", "Quality against size", "Quality against views"):
        assert f">{title}</h2>" in page


@pytest.mark.slow
def test_what_comes_from_files_is_escaped(tmp_path: Path) -> None:
    records = [
        replace(r, scene=EVIL if r.scene == "fern" else r.scene, command=EVIL, environment={EVIL: EVIL})
        for r in make_grid(budgets=("4.4%",), views=(None,))
    ]
    records += [replace(records[1], label=EVIL, error=EVIL), replace(records[0], settings={EVIL: EVIL})]
    made = page_of(records, tmp_path)
    assert "<script>alert" not in made
    assert outline(made).scripts == 1
    assert outline(made).open == []
    assert "&lt;script&gt;alert(&#39;x&#39;)" in made
    assert "1 failed" in made


def test_pictures_are_in_the_page(tmp_path: Path) -> None:
    import cv2

    records = [replace(r, pictures=("a/1.png",)) for r in make_grid()]
    data = {suffix: cv2.imencode(suffix, np.zeros((8, 8, 3), np.uint8))[1].tobytes() for suffix in (".jpg", ".png")}
    for record in records:
        for owner, kind in ((f"{record.scene}/photo", "photo"), (record.output, "render"), (record.output, "error")):
            path = picture_path(tmp_path, owner, 0, kind)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data[path.suffix])
    made = page_of(records, tmp_path, most_figures=0)
    assert made.count('<input type="range"') == 3
    assert "fern, a/1.png" in made
    assert outline(made).open == []
    one = made.split('<div class="compare">')[1].split("</select>")[0]
    names = ["input", "gsmerge", "gsmerge, no fit", "voxel", "random"]
    assert re.findall(r'<option value="\d+"( selected)?>([^<]+)<', one) == [
        ("", "photo"),
        (" selected", "input"),
        *(("", name) for name in names[1:]),
        *(("", f"error of {name}") for name in names),
    ]


def test_a_page_of_failures_alone(tmp_path: Path) -> None:
    made = page_of([replace(r, error="out of memory") for r in make_grid()[:2]], tmp_path)
    assert "out of memory" in made
    assert outline(made).open == []


def test_the_table_has_a_row_for_each_run() -> None:
    records = [*make_grid(), replace(make_grid()[1], error="=cmd()")]
    rows = list(csv.DictReader(io.StringIO(make_table(records))))
    assert len(rows) == len(records)
    assert float(rows[1]["psnr_target_visible"]) == records[1].scores["psnr_target_visible"]
    assert (rows[1]["lpips_alex_target"], rows[-1]["error"]) == ("", "'=cmd()")
