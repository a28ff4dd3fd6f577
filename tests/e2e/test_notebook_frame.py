"""A notebook shows ``result.show()`` as a frame in which the page runs, 3D included."""

from __future__ import annotations

from pathlib import Path

import pytest
from browser import CHROMIUM, browser, needs_browser

import gsmerge

STAGE = "document.querySelector('iframe').contentDocument.getElementById('stage')"
SOLID = "document.querySelector('iframe').contentDocument.querySelectorAll('[data-set=solid]')[1]"


@pytest.mark.slow
@needs_browser()
def test_a_frame_shows_the_page_in_3d(smallest_scene: Path, tmp_path: Path) -> None:
    page = gsmerge.compact(smallest_scene, effort="draft", budget=300).show()
    (tmp_path / "notebook.html").write_text(f"<!DOCTYPE html><meta charset=utf-8>{page._repr_html_()}", "utf-8")
    with browser(CHROMIUM, tmp_path / "profile", "--enable-unsafe-swiftshader") as tab:
        tab.open(tmp_path / "notebook.html")
        for done in (f"!{SOLID}.disabled", f"{STAGE}.classList.contains('solid') && {STAGE}.ariaBusy === 'false'"):
            tab.wait(done)
            tab.run(f"{SOLID}.click()")
        assert [url for url in tab.requests() if not url.startswith(("file:", "data:", "blob:"))] == []
