"""A page with a scene, in one file or a few, that needs no other host, and a camera that it may not leave."""

from __future__ import annotations

import base64
import html
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scenes
from page_policy import check_policy

from gsmerge.cli.paths import is_page, output_file
from gsmerge.io import read_gaussians
from gsmerge.pages.site import MAX_VIEWS, NAMES, site_contents
from gsmerge.types import Cameras

EVIL = '</script><b onload="x">&{{ 7 * 7 }}'
NONE = Cameras(np.empty((0, 4, 4)), np.empty((0, 3, 3)), 1, 1)


Contents = tuple[str, dict[str, bytes]]


def contents_of(*, apart: bool) -> Contents:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3))
    return site_contents(scene.gaussians, scene.cameras, EVIL, (), apart=apart)


@pytest.fixture(scope="module")
def site() -> Contents:
    return contents_of(apart=True)


def data_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return dict(json.loads(found[1]))


@pytest.mark.parametrize("apart", [True, False])
def test_a_page_needs_no_other_host(apart: bool) -> None:
    page, files = contents_of(apart=apart)
    check_policy(page)
    bare = re.sub(r"[A-Za-z0-9+/=]{1000,}", "", page)
    assert re.findall(r"https?:|[\"']//", bare) == []
    addresses = set(re.findall(r"""(?:src|href)=["']([^"']+)["']""", bare))
    beside = {NAMES["poster"], NAMES["licences"]} if apart else set()
    assert {one for one in addresses if not one.startswith("data:")} == beside
    assert "<b onload" not in page
    assert f'<meta property="og:title" content="{html.escape(EVIL)}">' in page.replace("&#34;", "&quot;")
    assert set(files) == (set(NAMES.values()) if apart else set())


def test_one_file_holds_what_is_beside_a_site(site: Contents) -> None:
    page, _ = contents_of(apart=False)
    for content in site[1].values():
        assert base64.b64encode(content).decode() in page


def test_all_but_the_scene_takes_little(site: Contents) -> None:
    page, files = site
    assert len(page) + sum(len(content) for name, content in files.items() if name != NAMES["scene"]) < 700_000
    assert len(contents_of(apart=False)[0]) < 1_000_000


def test_its_scene_is_a_sog_of_all_gaussians(site: Contents, tmp_path: Path) -> None:
    (tmp_path / "a.sog").write_bytes(site[1][NAMES["scene"]])
    assert len(read_gaussians(tmp_path / "a.sog").gaussians) == len(
        scenes.make_scene(scenes.room(), scenes.arc(3)).gaussians
    )


def test_the_licences_of_the_viewer_are_beside_it(site: Contents) -> None:
    assert site[1]["LICENSES.txt"].count(b"Permission is hereby granted") == 3


def test_of_many_views_the_page_knows_some_and_the_middle_one() -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3))
    many = scene.cameras[np.repeat(np.arange(3), 50)]
    data = data_of(site_contents(scene.gaussians, many, "a", (), apart=False)[0])
    assert len(data["views"]) in (MAX_VIEWS, MAX_VIEWS + 1)
    assert data["free"] is False
    np.testing.assert_allclose(data["views"][data["start"]]["viewmat"], scene.cameras.viewmats[1].reshape(-1))


def test_without_cameras_one_may_look_from_any_side() -> None:
    gaussians = scenes.make_scene(scenes.room(), scenes.arc(3)).gaussians
    page, files = site_contents(gaussians, NONE, "a", (), apart=True)
    data = data_of(page)
    assert data["free"] is True
    assert data["start"] == 0
    poster = cv2.imdecode(np.frombuffer(files["poster.webp"], np.uint8), cv2.IMREAD_COLOR)
    assert poster is not None
    assert (poster > 20).any(2).mean() > 0.3  # it shows the scene


@pytest.mark.parametrize(
    ("output", "site", "expected"),
    [
        ("new", False, "new/a.ply"),
        ("empty", False, "empty/a.ply"),
        ("full.dir", False, "full.dir/a.ply"),  # whatever it holds: a page, or the rest of a killed run
        ("file", False, "file"),  # which no format names
        ("new.html", False, "new.html"),
        ("b.ply", False, "b.ply"),
        ("new", True, "new/index.html"),
        ("full.dir", True, "full.dir/index.html"),
        ("full.dir/page.html", True, "full.dir/page.html"),
    ],
)
def test_a_folder_gets_the_result_and_a_site_where_one_is_asked_for(
    output: str, site: bool, expected: str, tmp_path: Path
) -> None:
    for name in ("empty", "full.dir"):
        (tmp_path / name).mkdir()
    (tmp_path / "full.dir" / "index.html").write_text(contents_of(apart=True)[0])
    (tmp_path / "full.dir" / ".gsmerge-00000000-1-00000000.html").touch()
    (tmp_path / "file").touch()
    assert output_file(tmp_path / output, "a.ply", site=site) == tmp_path / expected


def test_a_page_with_a_scene_is_a_result_that_no_report_replaces(tmp_path: Path) -> None:
    (tmp_path / "scene.html").write_text(contents_of(apart=False)[0])
    (tmp_path / "mine.html").write_text("<!DOCTYPE html><title>mine</title>")
    (tmp_path / "report.html").write_text('<meta name="generator" content="gsmerge 0.3.0">')
    names = ("scene.html", "mine.html", "report.html")
    assert [is_page(tmp_path / name) for name in names] == [False, False, True]
