"""Pages work in a real browser, which fetches nothing, complains of nothing, and runs no name that is a program."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import CHROMIUM, Browser, browser, needs_browser
from charted import charted_scene
from shared import write_smallest

from e2e.conftest import Run
from gsmerge.cli import main

pytestmark = needs_browser()


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(CHROMIUM, tmp_path_factory.mktemp("page") / "profile") as opened:
        opened.open(charted_scene() / "out" / "index.html")
        yield opened


def test_page_fetches_nothing(shown: Browser) -> None:
    assert [url for url in shown.requests() if not url.startswith(("file:", "data:", "about:"))] == []


def test_page_makes_the_browser_complain_of_nothing(shown: Browser) -> None:
    assert shown.complaints() == []


def test_page_shows_all_figures_within_its_width(shown: Browser) -> None:
    assert shown.run("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
    heights = shown.run("[...document.querySelectorAll('figure > img')].map(img => img.getBoundingClientRect().height)")
    assert len(heights) >= 2
    assert min(heights) > 90
    assert shown.run("document.documentElement.scrollWidth <= innerWidth")


QUICK = ("--effort", "draft", "--fit", "none")
NAMES = [
    "<img src=x onerror=ran=1>",
    "\"><svg onload=ran=1>';ran=1;'`${ran=1}`",
    "--></script><script>ran=1<!--",  # a folder and a file in it
    "x\ny\u202egnp.exe",
]


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(CHROMIUM, tmp_path_factory.mktemp("names") / "profile") as opened:
        yield opened


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return what the scene is made to under a usual name: each page of one scene is of a run with its name."""
    folder = tmp_path_factory.mktemp("result")
    small = folder / "small.ply"
    assert main(["compact", str(write_smallest(folder / "scene")), "-o", str(small), *QUICK, "-q"]) == 0
    return small


@pytest.mark.parametrize("name", NAMES)
def test_page_runs_no_program_in_a_name(
    name: str, smallest_scene: Path, result: Path, tmp_path: Path, run: Run, tab: Browser
) -> None:
    """Of a folder, its file, its photos and a result."""
    scene = Path(shutil.copytree(smallest_scene, tmp_path / name))
    (scene / "scene.ply").rename(scene / f"{Path(name).name}.ply")
    cameras = json.loads((scene / "transforms.json").read_text(encoding="utf-8"))
    for frame in cameras["frames"]:
        photo = Path(frame["file_path"]).with_name(f"{Path(name).name}{Path(frame['file_path']).name}")
        (scene / frame["file_path"]).rename(scene / photo)
        frame["file_path"] = photo.as_posix()
    (scene / "transforms.json").write_text(json.dumps(cameras), encoding="utf-8")
    small = scene / f"{Path(name).name}.small.ply"
    shutil.copy(result, small)
    pages = {"send": ("compact", scene), "view": ("view", scene, small, "--no-open")}
    for kind, words in pages.items():
        page = tmp_path / f"{kind}.html"
        run(*words, "-o", page, *(QUICK if words[0] == "compact" else ()), code=0)
        tab.events.clear()
        tab.open(page)
        tab.wait("document.readyState === 'complete'")
        assert tab.run("typeof ran") == "undefined"
        assert [text for text in tab.complaints() if "WebGL" not in text and "GL Driver" not in text] == []
        assert [url for url in tab.requests() if not url.startswith(("file:", "data:", "blob:", "about:"))] == []
