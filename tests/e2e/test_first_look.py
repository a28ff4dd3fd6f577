"""``gsmerge SCENE`` makes a result and its page, and outputs may be folders."""

from __future__ import annotations

from pathlib import Path

import pytest
from messages import says

import gsmerge
from gsmerge.reading import input as files

from .conftest import Run, assert_refused, listing

FAST = ("--budget", "5%", "--effort", "draft", "--fit", "none")


@pytest.fixture(autouse=True)
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return pages that a browser was asked to open."""
    pages: list[str] = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr("webbrowser.open", lambda address: not pages.append(address))
    return pages


def pages_in(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.html"))


def test_scene_without_a_command_is_compacted_and_shown(
    smallest_copy: Path, run: Run, opened: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert files.read_files  # which reads the scene, once
    monkeypatch.setattr(
        "gsmerge.reading.read_scene.read_files", lambda *_, **__: pytest.fail("the page reads it again")
    )
    said = run(smallest_copy / "scene.ply", *FAST, code=0)
    (page,) = pages_in(smallest_copy)
    assert opened == [page.as_uri()]
    assert (smallest_copy / "scene.compact.ply").exists()
    assert f"{page}: " in said.out
    assert b"scene.compact.ply" in page.read_bytes()  # the result beside the input
    before = listing(smallest_copy)
    again = run(smallest_copy / "scene.ply", *FAST)
    assert_refused(again, 2, smallest_copy / "scene.compact.ply", "gsmerge view", "--overwrite")
    assert listing(smallest_copy) == before


def test_dry_run_or_output_that_is_a_page_opens_no_browser(smallest_copy: Path, run: Run, opened: list[str]) -> None:
    assert "would write" in run(smallest_copy, *FAST, "--dry-run", code=0).out
    run(smallest_copy, *FAST, "-o", smallest_copy.parent / "page.html", code=0)
    assert (pages_in(smallest_copy), opened) == ([], [])


def test_results_are_written_into_folders_that_exist(smallest_copy: Path, tmp_path: Path, run: Run) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").touch()
    run("compact", smallest_copy, "-o", tmp_path / "out", *FAST, code=0)
    result = tmp_path / "out" / "scene.compact.ply"
    assert says(run("compact", smallest_copy, "-o", tmp_path / "out", *FAST).err, "", result, "--overwrite")
    (tmp_path / "copies").mkdir()
    (tmp_path / "copies" / "notes.txt").touch()
    run("convert", result, tmp_path / "copies", code=0)
    copied = gsmerge.read_ply(tmp_path / "copies" / "scene.compact.ply").gaussians
    assert len(copied) == len(gsmerge.read_ply(result).gaussians)


def test_variable_sets_the_number_of_threads(smallest_copy: Path, monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    from gsmerge.runtime.threads import available_threads, use_threads

    monkeypatch.setenv("GSMERGE_THREADS", "3")
    with use_threads() as count:
        assert available_threads() == count == 3
    monkeypatch.setenv("GSMERGE_THREADS", "0")
    assert_refused(run("inspect", smallest_copy), 2, "GSMERGE_THREADS", "'0'")


@pytest.mark.parametrize("count", ["1025", "9" * 23, "-1", "two"])
def test_impossible_numbers_of_threads_in_the_variable_are_refused(
    count: str, smallest_scene: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    monkeypatch.setenv("GSMERGE_THREADS", count)
    assert_refused(run("inspect", smallest_scene), 2, "GSMERGE_THREADS", "1 to 1024", f"'{count}'")
