"""An evaluation as a page."""

from __future__ import annotations

import re

import pytest
import scenes

from gsmerge.measure.evaluate import EvaluateOptions, evaluate
from gsmerge.measure.preview import view_pictures
from gsmerge.measure.scores import evaluation_document
from gsmerge.view.page import report_page

NAME = "a|b<i>"


@pytest.fixture(scope="module")
def page() -> str:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3))
    half = scene.gaussians[::2]
    sizes = {"input": {"path": "in.ply", "bytes": 2000}, NAME: {"path": "out.ply", "bytes": 1000}}
    evaluation = evaluate(scene, {NAME: half}, None, EvaluateOptions(lpips=()))
    pictures = view_pictures([("in", scene.gaussians), (NAME, half)], scene.cameras, scene.images, max_views=2)
    return report_page(evaluation_document(evaluation, sizes, ["first <note>"]), pictures)


def test_it_loads_nothing_and_escapes_names(page: str) -> None:
    assert "a|b&lt;i&gt;" in page
    assert "first &lt;note&gt;" in page
    assert re.findall("<i>|<note>|https?:", page) == []
    addresses = re.findall(r"""(?:src|href)=["']?([^"'> ]*)""", page)
    assert len(addresses) >= 6
    assert all(address.startswith("data:") for address in addresses)


def test_the_headline_comes_first_then_pictures(page: str) -> None:
    places = [
        page.index(words) for words in ("50.0\u00a0% of the Gaussians", "2.0 kB", "data:image/webp", "<h2>Size</h2>")
    ]
    assert places == sorted(places)
    assert page.count('class="compare"') == 2
    assert page.count("<img") == 2 * 3


def test_columns_without_a_figure_are_left_out(page: str) -> None:
    assert "LPIPS" not in page
    assert "earned back after" not in page
    assert "PSNR (dB)" in page
    assert "2.0 x" in page
