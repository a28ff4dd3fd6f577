"""The part of docs/internals/architecture.md that follows a run says what a run does: values, sentences, picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from scripts import load_script

PROGRAM = Path(__file__).parents[2] / "docs" / "one_run.py"


@pytest.fixture(scope="module")
def script() -> Any:
    return load_script(PROGRAM)


@pytest.fixture(scope="module")
def run() -> Any:
    """Return the run of the scene, compacted once for all tests."""
    return load_script(PROGRAM).watch_run()


def test_the_page_fits_the_program(script: Any, run: Any) -> None:
    page = script.make_page(run)
    assert script.PAGE.read_text(encoding="utf-8") == page, "run python docs/one_run.py to renew"
    assert len(script.make_block(run).split()) < 650


def test_the_picture_fits_the_program(script: Any, run: Any) -> None:
    assert script.is_same(script.draw_picture(run)), "run python docs/one_run.py to renew"
    assert script.PICTURE.stat().st_size < 300_000


def test_a_sentence_that_is_no_longer_true_is_named(script: Any, run: Any) -> None:
    plan = run.made["make_plan"]
    longer = replace(
        run,
        made=run.made | {"make_plan": replace(plan, merge=replace(plan.merge, decode=replace(plan.merge.decode, k=2)))},
    )
    with pytest.raises(script.UntrueError, match="K is 1"):
        script.build_steps(longer)


def test_the_picture_of_the_packages_follows_the_import_contracts() -> None:
    script = load_script(PROGRAM.with_name("packages.py"))
    assert script.PICTURE.read_text("utf-8") == script.draw_picture(), "run python docs/packages.py to renew"
