"""``gsmerge view``: what it writes and replaces, the sizes that it adds, pages without the scene's Gaussians."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from .conftest import Run, assert_refused


def sources(page: Path) -> list[tuple[str, str | None]]:
    """Names of what a page shows, each with the place of its Gaussians."""
    data = json.loads(re.findall('<script type="application/json" id="data">(.*?)</script>', page.read_text())[0])
    return [(one["name"], one["splats"]) for one in data["sources"]]


def test_a_page_is_replaced_and_nothing_else(small_scene: Path, tmp_path: Path, run: Run) -> None:
    page = tmp_path / "page.html"
    call = ("view", small_scene, "--no-open", "-o", page)
    run(*call, code=0)
    page.write_text(page.read_text() + "old")
    run(*call, code=0)
    assert page.read_text().endswith("</html>")
    page.write_text("<html>mine</html>")
    assert_refused(run(*call), 2, page, "exists")
    assert page.read_text() == "<html>mine</html>"
    assert_refused(run(*call[:-1], tmp_path / "page.txt"), 2, tmp_path / "page.txt", ".html")


def test_sizes_are_compacted_and_light_leaves_the_scene_out(small_scene: Path, tmp_path: Path, run: Run) -> None:
    page = tmp_path / "page.html"
    call = ("view", small_scene, "--no-open", "-o", page, "--sizes", "2, 10%,4.4")
    said = json.loads(run(*call, "--json", code=0).out)
    assert said["headline"].startswith("4.4 % of the Gaussians, ")
    assert [name for name, _ in sources(page)] == ["photo", "input", "4.4 %", "2 %", "10 %"]
    whole = said["bytes"]
    assert whole == page.stat().st_size
    run(*call, "--light", code=0)
    assert [splats is None for _, splats in sources(page)] == [True, True, False, False, False]
    assert page.stat().st_size < whole


@pytest.mark.parametrize("sizes", ["none", "0", "101", "2,2%", "2,,4"])
def test_sizes_are_different_shares(sizes: str, small_scene: Path, tmp_path: Path, run: Run) -> None:
    assert_refused(run("view", small_scene, "-o", tmp_path / "page.html", "--sizes", sizes), 2, "--sizes", sizes)
