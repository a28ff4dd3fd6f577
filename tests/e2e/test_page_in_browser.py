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
    assert shown.run("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
    heights = shown.run("[...document.querySelectorAll('figure > img')].map(img => img.getBoundingClientRect().height)")
    assert len(heights) >= 2
    assert min(heights) > 90
    assert shown.run("document.documentElement.scrollWidth <= innerWidth")


def test_keys_and_the_mouse_move_the_slider(shown: Browser) -> None:
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
    shown.run(f"{FIRST}.scrollIntoView()")
    box = shown.box(f"{FIRST}.querySelector('.frame')")
    spot = {"x": box["x"] + 0.25 * box["width"], "y": box["y"] + box["height"] / 2, "button": "left", "clickCount": 1}
    shown.call("Input.dispatchMouseEvent", type="mousePressed", **spot)
    shown.call("Input.dispatchMouseEvent", type="mouseReleased", **spot)
    assert abs(float(at(shown).rstrip("%")) - 25) <= 1


def test_the_sides_can_be_chosen(shown: Browser) -> None:
    choose = "(select => { select.value = '0'; select.dispatchEvent(new Event('input')); })"
    shown.run(f"{choose}({FIRST}.querySelector('select'))")
    assert shown.run(f"[...{FIRST}.querySelectorAll('.left')].map(one => one.alt)") == ["photo"]
