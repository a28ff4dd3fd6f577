"""The page that follows one run says what a run does: its shapes, values, sentences and picture."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scripts import load_script

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def script() -> Any:
    return load_script(ROOT / "docs" / "one_run.py")


@pytest.fixture(scope="module")
def run(script: Any) -> Any:
    """The scene, compacted once for all tests."""
    return script.watch_run()


def test_the_page_fits_the_program(script: Any, run: Any) -> None:
    page = script.make_page(run)
    assert script.PAGE.read_text(encoding="utf-8") == page, "run python docs/one_run.py to renew"
    assert len(page.split()) < 1000


def test_the_picture_fits_the_program(script: Any, run: Any) -> None:
    assert script.is_same(script.draw_picture(run)), "run python docs/one_run.py to renew"
    assert script.PICTURE.stat().st_size < 300_000


def test_another_picture_is_seen(script: Any, run: Any) -> None:
    """Such as one without the merge of views."""
    made = run.made | {"merge": run.made["correct"]}
    assert not script.is_same(script.draw_picture(replace(run, made=made)))


def test_a_sentence_that_is_no_longer_true_is_named(script: Any, run: Any) -> None:
    plan = run.made["make_plan"]
    longer = replace(run, made=run.made | {"make_plan": replace(plan, decode=replace(plan.decode, k=2))})
    with pytest.raises(script.UntrueError, match="K is 1"):
        script.build_section(longer)


@pytest.mark.parametrize(("words", "code"), [((), 0), (("--check",), 1)])
def test_stale_files_are_named_or_written(
    script: Any, run: Any, words: tuple[str, ...], code: int, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    page, picture = tmp_path / "one-run.md", tmp_path / "one-run.jpg"
    page.write_text("old", encoding="utf-8")
    picture.write_bytes(bytes(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1]))
    for name, value in {"PAGE": page, "PICTURE": picture, "DOCS": tmp_path / "docs"}.items():
        monkeypatch.setattr(script, name, value)
    monkeypatch.setattr(script, "watch_run", lambda: run)
    monkeypatch.setattr(sys, "argv", ["one_run.py", *words])
    assert script.main() == code
    assert capsys.readouterr().out.split() == ["one-run.md", "one-run.jpg"]
    assert (page.read_text(encoding="utf-8") == "old") == bool(words)
    assert script.is_same(script.draw_picture(run)) != bool(words)
