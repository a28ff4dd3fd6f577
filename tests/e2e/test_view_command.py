"""``gsmerge view`` writes pages, also without the scene's Gaussians, and replaces no other file."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from .conftest import Run, assert_refused


def sources(page: Path) -> list[tuple[str, str | None]]:
    """Return names of what a page shows, each with the place of its Gaussians."""
    data = json.loads(re.findall('<script type="application/json" id="data">(.*?)</script>', page.read_text())[0])
    return [(one["name"], one["splats"]) for one in data["sources"]]


def test_a_named_page_is_replaced_only_if_asked_for(smallest_scene: Path, tmp_path: Path, run: Run) -> None:
    page = tmp_path / "page.html"
    call = ("view", smallest_scene, "--no-open", "-o", page)
    run(*call, code=0)
    page.write_text(page.read_text() + "old")
    assert_refused(run(*call), 2, page, "exists", "--overwrite")
    run(*call, "--overwrite", code=0)
    assert page.read_text().endswith("</html>")
    assert_refused(run(*call[:-1], tmp_path / "page.txt"), 2, tmp_path / "page.txt", ".html")


def test_the_page_beside_a_scene_is_replaced_if_gsmerge_made_it(smallest_copy: Path, run: Run) -> None:
    page = smallest_copy / "scene.view.html"
    call = ("view", smallest_copy, "--no-open")
    run(*call, code=0)
    page.write_text(page.read_text() + "old")
    run(*call, code=0)
    assert page.read_text().endswith("</html>")
    page.write_text("<html>mine</html>")
    assert_refused(run(*call), 2, page, "exists")
    assert page.read_text() == "<html>mine</html>"


@pytest.mark.slow
def test_a_light_page_leaves_the_scene_out_of_3d(smallest_scene: Path, tmp_path: Path, run: Run) -> None:
    page, result = tmp_path / "page.html", tmp_path / "small.ply"
    run("compact", smallest_scene, "--budget", "4.4%", "--set", "fill=true", "-o", result, code=0)
    said = json.loads(run("view", smallest_scene, result, "--no-open", "-o", page, "--json", code=0).out)
    assert said["headline"].startswith("4.3 % of the Gaussians, ")  # 50 of 1,152
    assert [name for name, _ in sources(page)] == ["photo", "input", "small.ply"]
    assert said["bytes"] == page.stat().st_size
    run("view", smallest_scene, result, "--no-open", "-o", page, "--light", "--overwrite", code=0)
    assert [splats is None for _, splats in sources(page)] == [True, True, False]
