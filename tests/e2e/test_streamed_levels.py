"""``compact -o scene/lod-meta.json`` writes levels that stream."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from splat_transform_programs import needs_program, put_stand_in, run_here

from gsmerge.io import read_gaussians
from gsmerge.io.formats.splat_transform import VARIABLE
from gsmerge.io.formats.streamed import read_index

from .conftest import Run, assert_refused, listing

FOUND = os.environ.get(VARIABLE)
QUICK = ("--set", "superpixels=200", "--fit", "none", "--set", "checkpoint=none", "--threads", 1)


@pytest.fixture(autouse=True)
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a stand-in for splat-transform in each test that does not take the program itself."""
    run_here(monkeypatch, put_stand_in(tmp_path / "program", monkeypatch))


@pytest.fixture
def index(tmp_path: Path) -> Path:
    return tmp_path / "web" / "lod-meta.json"


@pytest.mark.slow
@needs_program()
def test_splat_transform_itself_writes_the_levels(
    small_scene: Path, index: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    monkeypatch.delenv(VARIABLE, raising=False) if FOUND is None else monkeypatch.setenv(VARIABLE, FOUND)
    document = json.loads(run("compact", small_scene, "-o", index, *QUICK, "--json", code=0).out)
    counts = [document["output"]["num_gaussians"], *(level["num_gaussians"] for level in document["levels"])]
    assert read_index(index).counts == counts
    assert json.loads(run("inspect", index, "--json", code=0).out)["count"] == counts[0]


def test_compact_writes_three_levels_into_a_folder(small_scene: Path, index: Path, run: Run) -> None:
    document = json.loads(run("compact", small_scene, "-o", index, *QUICK, "--json", code=0).out)
    levels = read_index(index).levels
    counts = [document["output"]["num_gaussians"], *(level["num_gaussians"] for level in document["levels"])]
    assert read_index(index).counts == counts
    assert all(
        0.9 * most <= count <= most for count, most in zip(counts[1:], (counts[0] // 4, counts[0] // 16), strict=True)
    )
    assert [level["path"] for level in document["levels"]] == [str(next(iter(level))) for level in levels[1:]]
    written = listing(index.parent)
    assert min(written.pop(name) for name in ("lod-meta.cameras.json", "settings.json")) > 0
    total = document["output"]["bytes"] + sum(level["bytes"] for level in document["levels"])
    assert total == sum(written.values())
    first = listing(index.parent)
    assert_refused(run("compact", small_scene, "-o", index, *QUICK, "--levels", 2), 2, index, "exists", "--overwrite")
    assert listing(index.parent) == first
    run("compact", small_scene, "-o", index, *QUICK, "--levels", 2, "--overwrite", code=0)
    assert {Path(name).parts[0][0] for name in listing(index.parent)} == {"0", "1", "l", "s"}  # none of a third


@pytest.mark.parametrize(("more", "number"), [(("--levels", 2), 2), (("--set", "method=random"), 1), ((), 3)])
def test_dry_run_says_how_many_levels_are_written(
    more: tuple[object, ...], number: int, small_scene: Path, index: Path, run: Run
) -> None:
    said = run("compact", small_scene, "-o", index, *QUICK[:2], *more, "--dry-run", code=0)
    assert f"{index}, and {number} level{'' if number == 1 else 's'} in" in said.out
    assert not index.parent.exists()


@pytest.mark.slow
def test_other_commands_take_the_finest_level(small_scene: Path, index: Path, run: Run) -> None:
    run("compact", small_scene, "-o", index, *QUICK, code=0)
    said = json.loads(run("evaluate", small_scene, index, "--lpips", "none", "--json", code=0).out)
    finest = len(read_gaussians(index).gaussians)
    assert [one["num_gaussians"] for one in said["results"][-1:]] == [finest]
    assert f"Gaussians  {finest:,}:" in run("inspect", index, code=0).out
    assert json.loads(run("inspect", index, "--json", code=0).out)["count"] == finest
    picture = index.parent / "a.png"
    run("render", small_scene, index, "-o", picture, code=0)
    assert picture.stat().st_size > 1000


def test_batch_writes_no_streamed_levels(small_scene: Path, tmp_path: Path, run: Run) -> None:
    words = ("batch", small_scene, "--output", tmp_path, "--name", "{stem}/lod-meta.json")
    assert_refused(run(*words), 2, "--name", ".ply")


def test_a_budget_in_bytes_needs_a_format_that_counts_them(small_scene: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / "new" / "lod-meta.json"
    assert_refused(run("compact", small_scene, "-o", out, "--budget", "5MB"), 2, "", "--budget", "5MB")
    assert not out.parent.exists()
