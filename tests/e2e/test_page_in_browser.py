"""The page of charts works in a real browser, which fetches nothing and complains of nothing."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from browser import CHROMIUM, Browser, browser, needs_browser
from charted import charted_scene

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
