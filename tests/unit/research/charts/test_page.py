"""The page stands alone, escapes text, and the drawings repeat to the byte."""

from __future__ import annotations

import re
from dataclasses import replace
from html import escape
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from experiments import make_grid, make_proxies

from gsmerge.research.charts.draw import draw_figures
from gsmerge.research.charts.figures import make_figures, make_verdict_tables
from gsmerge.research.charts.page import inline_svg, make_page, table
from gsmerge.research.charts.record import RunRecord, picture_path

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
    figures = make_figures(records, make_proxies())[-most_figures:]
    drawings = draw_figures(figures, folder / "charts")
    return make_page(
        records, figures, drawings, make_verdict_tables(records), folder, command="gsmerge chart --draw-only"
    )


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    return page_of(make_grid(), tmp_path_factory.mktemp("results"), most_figures=20)


def test_the_page_is_well_formed(page: str) -> None:
    actual = outline(page)
    assert actual.open == []
    assert len(actual.ids) == len(set(actual.ids))
    assert page.startswith("<!DOCTYPE html>\n<html lang=")


def test_all_lines_are_behind_a_toggle(page: str) -> None:
    for name in ("quality-seconds", "quality-ratio"):
        assert page.count(f'<section id="{name}">') == 1
        assert f'<section id="{name}-all">' not in page
    assert page.count("<details><summary>all lines</summary><figure><svg") == 4  # also over views, and break-even
    assert page.count("</section>") == page.count("<section ")


def test_the_page_fetches_nothing(page: str) -> None:
    assert [value for value in outline(page).fetched if not value.startswith(("#", "data:image/"))] == []
    assert "://" not in page
    assert not re.search(r"url\((?!#)", page)
    assert "@import" not in page
    assert "default-src &#39;none&#39;" in page


def test_every_reference_inside_the_page_is_there(page: str) -> None:
    actual = outline(page)
    inside = {value[1:] for value in actual.fetched if value.startswith("#")}
    inside |= set(re.findall(r"url\(#([^)]+)\)", page))
    assert len(inside) > 20
    assert inside - set(actual.ids) == set()


def test_the_page_says_what_was_found(page: str) -> None:
    assert "54 runs on 3 scene(s): apples, fern, fox" in page
    assert "PSNR (dB) at equal size: no baseline&#x27;s point lies above ours (6 points; 6 below ours" in page
    assert "gsmerge chart scenes --budgets 1%,4.4%" in page
    assert '<td class="text">processor</td><td class="text">one</td>' in page
    assert "Failed runs" not in page
    for title in ("Results", "At equal cost", "Quality against time", "Superpixels alone", "When merging pays"):
        assert f"<h2>{title}</h2>" in page


def test_what_comes_from_files_is_escaped(tmp_path: Path) -> None:
    records = [
        replace(r, scene=EVIL if r.scene == "fern" else r.scene, command=EVIL, environment={EVIL: EVIL})
        for r in make_grid()
    ]
    records += [replace(records[1], key="bad", error=EVIL), replace(records[0], key="odd", settings={EVIL: EVIL})]
    made = page_of(records, tmp_path)
    assert "<script>alert" not in made
    assert outline(made).scripts == 1
    assert outline(made).open == []
    assert "&lt;script&gt;alert(&#x27;x&#x27;)" in made
    assert "1 failed" in made


@pytest.mark.parametrize("name", ["a $\\frac{$ b", "$x$", "_\\$", "\N{SNOWMAN}\N{CJK UNIFIED IDEOGRAPH-4E2D}", "=1|x"])
def test_names_are_no_formulas_in_drawings(name: str, tmp_path: Path) -> None:
    records = [replace(r, scene=name if r.scene == "fern" else r.scene, method=r.method) for r in make_grid()]
    assert escape(name) in page_of(records, tmp_path)


def test_pictures_are_in_the_page(tmp_path: Path) -> None:
    import cv2

    records = [replace(r, pictures=("a/1.png",)) for r in make_grid()]
    data = {suffix: cv2.imencode(suffix, np.zeros((8, 8, 3), np.uint8))[1].tobytes() for suffix in (".jpg", ".png")}
    for record in records:
        for owner, kind in ((record.scene_sha256, "photo"), (record.key, "render"), (record.key, "error")):
            path = picture_path(tmp_path, owner, 0, kind)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data[path.suffix])
    made = page_of(records, tmp_path)
    assert made.count('<input type="range"') == 3
    assert "fern, a/1.png" in made
    assert outline(made).open == []
    one = made.split('id="compare-0"')[1].split("</select>")[0]
    assert re.findall(r'<option value="\d"( selected)?>([^<]+)<', one) == [
        ("", "photo"),
        (" selected", "input"),
        ("", "gsmerge"),
        ("", "gsmerge, no fit"),
        ("", "voxel"),
        ("", "random"),
    ]
    assert 'alt="error of voxel"' in made


def test_a_page_of_failures_alone(tmp_path: Path) -> None:
    made = page_of([replace(r, error="out of memory") for r in make_grid()[:2]], tmp_path)
    assert "out of memory" in made
    assert outline(made).open == []


def test_drawings_repeat_to_the_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib as mpl

    figures = [f for f in make_figures(make_grid()) if f.name in ("quality-ratio", "stages", "break-even")]
    draw_figures(figures, tmp_path / "a")
    monkeypatch.setitem(mpl.rcParams, "font.size", 30)  # the user's own style does not matter
    draw_figures(figures, tmp_path / "b")
    names = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert len(names) == 6
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert mpl.rcParams["font.size"] == 30
    assert "<dc:date>" not in (tmp_path / "a" / "stages.svg").read_text()


def test_missing_matplotlib_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from gsmerge.errors import GsmergeError

    monkeypatch.setattr("gsmerge.research.charts.draw.find_spec", lambda name: None)
    with pytest.raises(GsmergeError, match=r'not installed: pip install "matplotlib>=3.8,<4"'):
        draw_figures([], tmp_path)


def test_inline_drawings() -> None:
    drawing = (
        '<?xml version="1.0"?><!DOCTYPE svg PUBLIC "x" "http://x/y.dtd">\n<svg xmlns:xlink="http://a" width="72pt"'
        ' viewBox="0 0 72 36" xmlns="http://b"><metadata><a href="http://c"/></metadata><!-- http://d -->'
        '<g id="p"/><use xlink:href="#p"/><g clip-path="url(#p)"/></svg>\n'
    )
    assert inline_svg(drawing, "one", 'a "b"') == (
        '<svg viewBox="0 0 72 36" style="max-width:126px" role="img" aria-label="a &quot;b&quot;"><g id="one-p"/>'
        '<use xlink:href="#one-p"/><g clip-path="url(#one-p)"/></svg>'
    )
    with pytest.raises(ValueError, match="viewBox"):
        inline_svg("<svg></svg>", "one", "")


def test_tables_escape() -> None:
    assert "&lt;b&gt;" in table(["<b>"], [["x"]])
    assert "&lt;i&gt;" in table(["b"], [["<i>"]])
