"""A page with a scene needs no other host, and its camera stays within bounds."""

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

from gsmerge.cli.paths import output_file
from gsmerge.drawing.pages.site import MAX_VIEWPOINTS, NAMES, make_page
from gsmerge.io import read_gaussians
from gsmerge.io.first_bytes import may_be_replaced
from gsmerge.types import Cameras

EVIL = '</script><b onload="x">&{{ 7 * 7 }}'
NONE = Cameras(np.empty((0, 4, 4)), np.empty((0, 3, 3)), 1, 1)


def page_of_room() -> str:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3))
    return make_page(scene.gaussians, scene.cameras, EVIL, ())


@pytest.fixture(scope="module")
def page() -> str:
    return page_of_room()


def part_of(page: str, name: str) -> bytes:
    found = re.search(f'<script type="text/plain" id="{re.escape(NAMES[name])}">(.*?)</script>', page, re.DOTALL)
    return base64.b64decode(found[1])


def data_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    return dict(json.loads(found[1]))


def test_a_page_needs_no_other_host(page: str) -> None:
    check_policy(page)
    bare = re.sub(r"[A-Za-z0-9+/=]{1000,}", "", page)
    assert re.findall(r"https?:|[\"']//", bare) == []
    addresses = set(re.findall(r"""(?:src|href)=["']([^"']+)["']""", bare))
    assert [one for one in addresses if not one.startswith("data:")] == []
    assert "<b onload" not in page
    assert f'<meta property="og:title" content="{html.escape(EVIL)}">' in page.replace("&#34;", "&quot;")
    assert len(page) < 1_000_000


def test_scene_in_the_page_is_a_sog_of_all_gaussians(page: str, tmp_path: Path) -> None:
    (tmp_path / "a.sog").write_bytes(part_of(page, "scene"))
    assert len(read_gaussians(tmp_path / "a.sog").gaussians) == len(
        scenes.make_scene(scenes.room(), scenes.arc(3)).gaussians
    )


def test_page_has_the_licences_of_its_viewer(page: str) -> None:
    texts = [base64.b64decode(one) for one in re.findall("data:text/plain;base64,([A-Za-z0-9+/=]+)", page)]
    assert [text.count(b"Permission is hereby granted") for text in texts] == [3]


def test_page_of_many_views_keeps_some_and_starts_at_the_middle() -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3))
    many = scene.cameras[np.repeat(np.arange(3), 50)]
    data = data_of(make_page(scene.gaussians, many, "a", ()))
    assert len(data["views"]) in (MAX_VIEWPOINTS, MAX_VIEWPOINTS + 1)
    assert data["free"] is False
    np.testing.assert_allclose(data["views"][data["start"]]["viewmat"], scene.cameras.viewmats[1].reshape(-1))


def test_page_without_cameras_lets_one_look_from_any_side() -> None:
    gaussians = scenes.make_scene(scenes.room(), scenes.arc(3)).gaussians
    page = make_page(gaussians, NONE, "a", ())
    data = data_of(page)
    assert data["free"] is True
    assert data["start"] == 0
    (picture,) = re.findall("data:image/webp;base64,([A-Za-z0-9+/=]+)", page)
    poster = cv2.imdecode(np.frombuffer(base64.b64decode(picture), np.uint8), cv2.IMREAD_COLOR)
    assert (poster > 20).any(2).mean() > 0.3  # it shows the scene


@pytest.mark.parametrize(
    ("output", "expected"),
    [
        ("new", "new"),  # which no format names, since no folder is made for a name without an ending
        ("empty", "empty/a.ply"),
        ("full.dir", "full.dir/a.ply"),  # whatever it holds: a page, or the rest of a killed run
        ("file", "file"),  # which no format names
        ("new.html", "new.html"),
        ("b.ply", "b.ply"),
    ],
)
def test_a_folder_gets_the_result(output: str, expected: str, tmp_path: Path) -> None:
    for name in ("empty", "full.dir"):
        (tmp_path / name).mkdir()
    (tmp_path / "full.dir" / "index.html").write_text(page_of_room())
    (tmp_path / "full.dir" / ".gsmerge-00000000-1-00000000.html").touch()
    (tmp_path / "file").touch()
    assert output_file(tmp_path / output, "a.ply") == tmp_path / expected


def test_page_with_a_scene_may_not_be_replaced_by_a_report(tmp_path: Path) -> None:
    (tmp_path / "scene.html").write_text(page_of_room())
    (tmp_path / "mine.html").write_text("<!DOCTYPE html><title>mine</title>")
    (tmp_path / "report.html").write_text('<meta name="generator" content="gsmerge 0.3.0">')
    (tmp_path / "empty.html").touch()
    names = ("scene.html", "mine.html", "report.html", "empty.html", "none.html")
    assert [may_be_replaced(tmp_path / name) for name in names] == [False, False, True, True, True]


def test_a_page_without_scripts_says_so_in_place_of_what_a_script_would_say(page: str) -> None:
    (status,) = re.findall(r'<p id="status" role="status">(.*?)</p>', page)
    assert re.fullmatch("<noscript>.*JavaScript.*</noscript>", status)
