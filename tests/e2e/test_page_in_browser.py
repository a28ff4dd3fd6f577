"""The page in a real browser: nothing is fetched, nothing complains, the slider follows keys and mouse."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import CHROMIUM, Browser, browser, needs_browser

pytestmark = needs_browser()
FIRST = "document.querySelector('.compare')"


@pytest.fixture(scope="module")
def shown(charted_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(CHROMIUM, tmp_path_factory.mktemp("page") / "profile") as opened:
        opened.open(charted_scene / "out" / "index.html")
        yield opened


def at(shown: Browser) -> str:
    return str(shown.run(f"getComputedStyle({FIRST}).getPropertyValue('--at')"))


def test_nothing_is_fetched_and_nothing_complains(shown: Browser) -> None:
    assert [url for url in shown.requests() if not url.startswith(("file:", "data:", "about:"))] == []
    assert shown.complaints() == []


@pytest.mark.slow
def test_pictures_and_drawings_have_a_size(shown: Browser) -> None:
    assert shown.run("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
    assert shown.run(
        "[...document.querySelectorAll('figure > img')].every(img => img.getBoundingClientRect().height > 90)"
    )
    assert shown.run("document.querySelectorAll('figure > img').length") >= 2
    assert shown.run("document.documentElement.scrollWidth <= innerWidth")


def test_keys_move_the_slider(shown: Browser) -> None:
    shown.run(f"{FIRST}.querySelector('input').focus()")
    assert at(shown) == "50%"
    for _ in range(3):
        shown.press("ArrowRight")
    assert at(shown) == "53%"
    clip = shown.run(f"getComputedStyle({FIRST}.querySelector('.left')).clipPath")
    assert clip == "inset(0px 47% 0px 0px)"
    said = shown.run(f"{FIRST}.querySelector('input').getAttribute('aria-valuetext')")
    assert said.startswith("53 % input, the rest gsmerge")
    shown.press("Home")
    assert at(shown) == "0%"


@pytest.mark.slow
def test_the_mouse_moves_the_slider(shown: Browser) -> None:
    shown.run(f"{FIRST}.scrollIntoView()")
    box = shown.run(f"JSON.parse(JSON.stringify({FIRST}.querySelector('.frame').getBoundingClientRect()))")
    spot = {"x": box["x"] + 0.25 * box["width"], "y": box["y"] + box["height"] / 2, "button": "left", "clickCount": 1}
    shown.call("Input.dispatchMouseEvent", type="mousePressed", **spot)
    shown.call("Input.dispatchMouseEvent", type="mouseReleased", **spot)
    assert abs(float(at(shown).rstrip("%")) - 25) <= 1


@pytest.mark.slow
def test_the_sides_can_be_chosen(shown: Browser) -> None:
    choose = "(select => { select.value = '0'; select.dispatchEvent(new Event('input')); })"
    shown.run(f"{choose}({FIRST}.querySelector('select'))")
    assert shown.run(f"{FIRST}.querySelector('.left').alt") == "photo"
    assert shown.run(f"{FIRST}.querySelectorAll('.left').length") == 1
