"""A web site: files that need no other host, and a camera that a page may not leave."""

from __future__ import annotations

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
from gsmerge.io.formats.table import SITE_SCENE
from gsmerge.pages.site import MAX_VIEWS, NAMES, site_contents
from gsmerge.types import Cameras

EVIL = '</script><b onload="x">&{{ 7 * 7 }}'
NONE = Cameras(np.empty((0, 4, 4)), np.empty((0, 3, 3)), 1, 1)


@pytest.fixture(scope="module")
def contents() -> dict[str, bytes]:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3))
    return site_contents(scene.gaussians, scene.cameras, EVIL, ())


def data_of(page: bytes) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.decode(), re.DOTALL)
    assert found is not None
    return dict(json.loads(found[1]))


def test_a_site_needs_no_other_host(contents: dict[str, bytes]) -> None:
    page = contents["index.html"].decode()
    check_policy(page)
    assert re.findall(r"https?:|[\"']//", page) == []
    addresses = re.findall(r"""(?:src|href)=["']([^"']+)["']""", page)
    assert {one for one in addresses if not one.startswith("data:")} == set(NAMES.values()) - {NAMES["engine"]}
    assert "<b onload" not in page
    assert set(contents) == {"index.html", *NAMES.values()}


def test_of_a_site_of_1_5_mb_800_kb_are_the_scene(contents: dict[str, bytes]) -> None:
    assert sum(len(content) for name, content in contents.items() if name != SITE_SCENE) < 700_000


def test_its_scene_is_a_sog_of_all_gaussians(contents: dict[str, bytes], tmp_path: Path) -> None:
    (tmp_path / "a.sog").write_bytes(contents[SITE_SCENE])
    assert len(read_gaussians(tmp_path / "a.sog").gaussians) == len(
        scenes.make_scene(scenes.room(), scenes.arc(3)).gaussians
    )


def test_the_licences_of_the_viewer_are_beside_it(contents: dict[str, bytes]) -> None:
    assert contents["LICENSES.txt"].count(b"Permission is hereby granted") == 3


def test_of_many_views_the_page_knows_some_and_the_middle_one() -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3))
    many = scene.cameras[np.repeat(np.arange(3), 50)]
    data = data_of(site_contents(scene.gaussians, many, "a", ())["index.html"])
    assert len(data["views"]) in (MAX_VIEWS, MAX_VIEWS + 1)
    assert data["free"] is False
    np.testing.assert_allclose(data["views"][data["start"]]["viewmat"], scene.cameras.viewmats[1].reshape(-1))


def test_without_cameras_one_may_look_from_any_side() -> None:
    gaussians = scenes.make_scene(scenes.room(), scenes.arc(3)).gaussians
    contents = site_contents(gaussians, NONE, "a", ())
    data = data_of(contents["index.html"])
    assert data["free"] is True
    assert data["start"] == 0
    poster = cv2.imdecode(np.frombuffer(contents["poster.webp"], np.uint8), cv2.IMREAD_COLOR)
    assert poster is not None
    assert (poster > 20).any(2).mean() > 0.3  # it shows the scene


def test_which_folders_are_sites(tmp_path: Path, contents: dict[str, bytes]) -> None:
    def named(name: str) -> str:
        return output_file(tmp_path / name, "a.ply").relative_to(tmp_path).as_posix()

    for name in ("empty", "site", "foreign", "full"):
        (tmp_path / name).mkdir()
    (tmp_path / "site" / "index.html").write_bytes(contents["index.html"])
    (tmp_path / "foreign" / "index.html").write_text("<!DOCTYPE html><title>mine</title>")
    (tmp_path / "full" / "b.ply").write_bytes(b"")
    assert [named(name) for name in ("new", "site")] == ["new/index.html", "site/index.html"]
    assert [named(name) for name in ("empty", "foreign", "full")] == ["empty/a.ply", "foreign/a.ply", "full/a.ply"]
    assert [named(name) for name in ("b.ply", "colmap")] == ["b.ply", "colmap/sparse/0/points3D.bin"]
    assert is_page(tmp_path / "site" / "index.html")
    assert not is_page(tmp_path / "foreign" / "index.html")
