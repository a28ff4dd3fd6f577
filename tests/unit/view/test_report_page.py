"""Reports and pictures as pages."""

from __future__ import annotations

import re

import numpy as np
import pytest
import scenes

from gsmerge.measure.comparison import Storage, compare
from gsmerge.measure.comparison_page import comparison_document
from gsmerge.measure.evaluate import EvaluateOptions
from gsmerge.measure.preview import view_pictures
from gsmerge.view.report_page import pictures_page, report_page, without_empty_columns

NAME = "a|b<i>"


@pytest.fixture(scope="module")
def page() -> str:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3))
    half = scene.gaussians[::2]
    sizes = {"input": Storage("in.ply", 5184, 2000, {"means": 1}), NAME: Storage("out.ply", 2592, 1000, {"means": 1})}
    comparison = compare(scene, {NAME: half}, sizes, None, EvaluateOptions(lpips=()), long_sides=(8,))
    pictures = view_pictures([("in", scene.gaussians), (NAME, half)], scene.cameras, scene.images, max_views=2)
    return report_page(comparison_document(comparison, ["first <note>"]), pictures)


def test_it_loads_nothing_and_escapes_names(page: str) -> None:
    assert "a|b&lt;i&gt;" in page
    assert "first &lt;note&gt;" in page
    assert re.findall("<i>|<note>|https?:", page) == []
    addresses = re.findall(r"""(?:src|href)=["']?([^"'> ]*)""", page)
    assert len(addresses) >= 6
    assert all(address.startswith("data:") for address in addresses)


def test_the_headline_comes_first_then_pictures(page: str) -> None:
    places = [
        page.index(words) for words in ("50.0\u00a0% of the Gaussians", "2.0 kB", "data:image/webp", "<h2>Storage</h2>")
    ]
    assert places == sorted(places)
    assert page.count('class="compare"') == 2
    assert page.count("<img") == 2 * 3


def test_columns_without_a_figure_are_left_out(page: str) -> None:
    assert "LPIPS" not in page
    assert "earned back after" not in page
    assert "PSNR (dB)" in page
    table = ("title", ["", "a", "b"], [["x", "-", "1"], ["y", "", "-"]])
    assert without_empty_columns(table) == ("title", ["", "b"], [["x", "1"], ["y", "-"]])


def test_pictures_alone() -> None:
    page = pictures_page("some", [[("only", np.zeros((8, 8, 3)))]])
    assert page.count("<img") == 1
    assert re.search(r'<option value="0" selected>only', page)
    assert "<table" not in page
