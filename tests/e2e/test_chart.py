"""``gsmerge lab chart`` runs on small made scenes, resumes, draws, and tells what failed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from charted import CHART_FAST, CHART_TARGETS, charted_scene
from messages import names

import gsmerge
from gsmerge.research.charts import measure_run as running
from gsmerge.research.charts.measure_run import RunRecord, read_runs
from gsmerge.settings.compact import CompactOptions

from .conftest import Outcome, Run, listing


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """Return a copy of the charted scene that a test may spoil."""
    return Path(shutil.copytree(charted_scene(), tmp_path / "grid"))


@pytest.fixture(autouse=True)
def _inline(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw nothing more, which takes half a second; scenes that are read for one test are not those of another."""
    charted_scene()
    running.load_source.cache_clear()
    monkeypatch.setattr(
        "gsmerge.research.charts.figures.draw_figures", lambda figures, folder: {f.name: b"<svg/>" for f in figures}
    )


@pytest.fixture
def merges(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Return the budgets of every merge from now on; one of 3 % fails."""
    seen: list[object] = []
    compact = running.compact

    def watched(scene: Any, settings: CompactOptions) -> Any:
        seen.append(settings.budget.budget)
        if seen[-1] == "3%":
            raise ValueError("two\nlines")
        return compact(scene, settings)

    monkeypatch.setattr(running, "compact", watched)
    return seen


def runs(folder: Path) -> dict[str, RunRecord]:
    """Return all runs by their label."""
    return {record.label: record for record in read_runs(folder)}


def again(run: Run, folder: Path, *options: object) -> Outcome:
    fast = CHART_FAST[2 * ("--grid" in options) :]
    where = ("--output", folder / "out") if "--output" not in options else ()
    return run("lab", "chart", folder / "room", *where, *CHART_TARGETS, *fast, *options)


@pytest.mark.slow
def test_grid_writes_records_table_page_and_charts(tmp_path: Path) -> None:
    out = charted_scene() / "out"
    records = runs(out)
    assert list(records) == ["input", "gsmerge, budget 1%, fit none", "gsmerge, budget 2%, fit none"]
    first, one, two = records.values()
    pixels = 3 * 64 * 48
    for record in (first, one, two):
        assert (record.error, record.scene, record.num_input) == (None, "room", pixels)
        assert {"psnr_target", "psnr_target_visible", "ssim_context"} < record.scores.keys()
        assert record.value("lpips_vgg_target") is None
    assert (first.count, one.count, two.count) == (pixels, pixels // 100, pixels // 50)
    assert first.seconds == 0 < one.seconds
    result = gsmerge.compact(gsmerge.read_scene(charted_scene() / "room"), budget="1%", fill=True, fit="none")
    gsmerge.write_ply(tmp_path / "small.ply", result.gaussians)
    assert (tmp_path / "small.ply").stat().st_size == one.bytes
    page = (out / "index.html").read_text()
    assert "3 runs on 1 scene: room" in page
    assert "--grid budget=1%,2% --set fit=none" in page
    assert len((out / "runs.csv").read_text().splitlines()) == 1 + 3
    drawn = {f"quality-{kind}.{suffix}" for kind in ("ratio", "seconds") for suffix in ("png", "svg")}
    assert {path.name for path in (out / "charts").iterdir()} == drawn


@pytest.mark.slow
def test_a_grid_that_was_killed_goes_on_where_it_was(copied: Path, merges: list[object], run: Run) -> None:
    path = copied / "out" / "runs.jsonl"
    before = path.read_bytes()
    assert names(again(run, copied).out, "3 runs", "0 new")
    assert (merges, path.read_bytes()) == ([], before)
    path.write_bytes(before[:-40])
    assert again(run, copied).code == 0
    assert merges == ["2%"]
    assert len(runs(copied / "out")) == 3
    assert again(run, copied, "--set", "rerun=true").code == 0
    assert merges == ["2%", "1%", "2%"]


def test_a_failed_run_does_not_end_the_grid(
    copied: Path, merges: list[object], run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ("--grid", "budget=3%,1%", "--output", copied / "new")
    outcome = again(run, copied, *options)
    assert outcome.code == 5
    last = outcome.err.splitlines()[-1]
    assert names(last, "1 of 3", "room/gsmerge, budget 3%, fit none: ValueError")
    assert names(outcome.out, "3 runs", "3 new", "1 failed")
    assert "ValueError: two lines" in (copied / "new" / "index.html").read_text()
    assert again(run, copied, *options).code == 5  # what failed is tried again
    assert merges == ["3%", "1%", "3%"]


def test_a_scene_that_cannot_be_read_is_a_failure_of_its_runs(copied: Path, run: Run) -> None:
    bad = Path(shutil.copytree(copied / "room", copied / "bad"))
    (bad / "scene.ply").write_text("ply\nThese are notes.\n")
    words = ("lab", "chart", bad, copied / "room", "--output", copied / "out", *CHART_TARGETS, *CHART_FAST)
    outcome = run(*words, "--quiet", code=5)
    assert names(outcome.err, "3 of 3", "bad/input")
    assert outcome.err.count("\n") == 1


def test_dry_run_prints_the_plan_without_writing(copied: Path, run: Run) -> None:
    before = listing(copied)
    outcome = again(run, copied, "--grid", "budget=1%,5%", "--dry-run")
    assert outcome.code == 0
    assert f"{copied / 'room'} -> {copied / 'out'}: gsmerge, budget 5%" in outcome.out
    assert "budget 1%" not in outcome.out
    assert f"{copied / 'out'}: 1 of 3 runs" in outcome.out
    assert listing(copied) == before


def test_chart_without_scenes_draws_the_runs_of_its_folder_again(copied: Path, run: Run) -> None:
    drawn = {path.name for path in (copied / "out" / "charts").iterdir()}
    shutil.rmtree(copied / "room")
    outcome = run("lab", "chart", "--output", copied / "out", "--json")
    assert (outcome.code, outcome.err) == (0, "")
    document = json.loads(outcome.out)
    assert document["schema_version"] == 2
    assert (document["num_runs"], document["num_done"], document["num_failed"]) == (3, 0, 0)
    assert {Path(path).name for path in document["charts"]} == drawn
    assert "3 runs on 1 scene: room" in Path(document["page"]).read_text()


def test_without_targets_the_page_says_which_photos_judge(small_copy: Path, tmp_path: Path, run: Run) -> None:
    args = ("--grid", "budget=5%", "--set", "fit=none", "--set", "lpips=none")
    done = run("lab", "chart", small_copy, "-o", tmp_path / "out", *args, code=0)
    assert names(done.err, "without --targets", "scored", "view_001.png")
    assert "without --targets" in (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
