"""``gsmerge evaluate`` works as users call it."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path

import pytest
from scripts import target_psnr
from shared import make_once, write_scene

from gsmerge.cli import main

from .conftest import Run, assert_refused


def make(folder: Path) -> None:
    """Write a scene of five views of 24 x 16, a result of it, and the report of that run."""
    write_scene(folder, num_views=5, width=24, height=16)
    words = ("compact", folder, "-o", folder / "small.ply", "--effort", "draft", "--budget", "10%", "--json")
    with (folder / "run.json").open("w") as report, redirect_stdout(report):
        assert main([str(word) for word in words]) == 0


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Return a copy of what :func:`make` writes, which a test may change."""
    return Path(shutil.copytree(make_once("evaluated", make), tmp_path / "scene"))


def test_evaluate_prints_a_table_and_writes_all_scores(
    scene_copy: Path, compacted_scene: Path, run: Run, floor: Callable[..., None]
) -> None:
    """On the scene of the floor, of which the defaults make a result."""
    small = Path(shutil.copy(compacted_scene / "small.ply", scene_copy))
    table, report = scene_copy / "a.csv", scene_copy / "a.json"
    outcome = run(
        "evaluate", scene_copy / "scene.ply", small, "--targets", scene_copy / "targets", "--lpips", "none",
        "-o", table, "-o", report,
    )  # fmt: skip
    assert outcome.code == 0
    assert [line for line in outcome.err.splitlines() if "outside" not in line] == []
    assert "small.ply" in outcome.out
    assert "fog" in outcome.out
    document = json.loads(report.read_text())
    before, after = document["results"]
    assert after["bytes"] == small.stat().st_size
    assert before["holes"] is None
    assert 0 <= after["holes"] < 0.1
    assert sum(after["bytes_by_attribute"].values()) < after["bytes"]
    floor(after["mean"]["target"]["psnr_visible"] - before["mean"]["target"]["psnr_visible"])
    assert after["mean"]["target"]["psnr"] == pytest.approx(target_psnr(scene_copy / "targets", small), abs=3e-4)
    assert document["num_views"] == {"context": 5, "target": 4}
    with table.open() as file:
        assert len(list(csv.DictReader(file))) == 2 * 9


@pytest.mark.slow
def test_page_of_view_shows_what_evaluate_measures(scene: Path, run: Run) -> None:
    call, page = (scene, scene / "small.ply", "--targets", scene / "targets"), scene / "page.html"
    document = json.loads(run("evaluate", *call, "--lpips", "none", "--json", code=0).out)
    run("view", *call, "--no-open", "-o", page, code=0)
    text = page.read_text()
    assert f"{document['results'][1]['mean']['target']['psnr_visible']:.2f}" in text
    assert text.count('"held_out":true') == document["num_views"]["target"]
    assert text.count('"held_out":') == sum(document["num_views"].values()) + 1  # and the view from outside


@pytest.mark.slow
def test_settings_choose_the_views_that_are_measured(scene: Path, run: Run) -> None:
    call = ("evaluate", scene, scene / "small.ply", "--lpips", "none", "--json", "--set")
    for setting, targets, counts in (
        ("context=false", ("--targets", scene / "targets"), {"target": 4}), ("views=3", (), {"context": 3}),
    ):  # fmt: skip
        assert json.loads(run(*call, setting, *targets, code=0).out)["num_views"] == counts


def test_lpips_is_measured_with_alexnet_on_four_views(scene: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    looked = []
    monkeypatch.setattr("gsmerge.scoring.lpips.lpips_available", lambda net: True)
    monkeypatch.setattr("gsmerge.scoring.lpips.lpips", lambda image, photo, net, mask: looked.append(net) or 0.25)
    monkeypatch.setattr("gsmerge.scoring.lpips.min_size", lambda net: 1)
    outcome = run("evaluate", scene, "--json", code=0)
    assert set(looked) == {"alex"}
    document = json.loads(outcome.out)
    assert document["lpips_views"] == 4
    assert [view["lpips_alex"] for view in document["results"][0]["views"]].count(0.25) == 4
    assert "LPIPS on 4 views" in run("evaluate", scene).out
    every = json.loads(run("evaluate", scene, "--lpips", "both", "--set", "lpips_views=null", "--json").out)
    assert "lpips_views" not in every
    assert [view["lpips_vgg"] for view in every["results"][0]["views"]].count(0.25) == 5


@pytest.mark.slow
def test_outputs_of_evaluate_replace_files_only_when_told_to(scene: Path, run: Run) -> None:
    outputs = {suffix: scene / f"page.{suffix}" for suffix in ("json", "csv")}
    flags = [part for path in outputs.values() for part in ("-o", path)]
    call = ("evaluate", scene / "scene.ply", scene / "small.ply", "--lpips", "none")
    run(*call, *flags, code=0)
    run(*call, *flags, "--overwrite", code=0)
    for path in outputs.values():
        path.write_text("mine")
        assert_refused(run(*call, "-o", path), 2, path, "exists already")
        assert path.read_text() == "mine"


def test_name_that_is_no_text_is_printed_escaped(scene: Path, run: Run) -> None:
    odd = (scene / "small.ply").rename(scene / "odd\udcff\x1b[31m.ply")
    outputs = [scene / f"page.{suffix}" for suffix in ("json", "csv")]
    flags = [part for path in outputs for part in ("-o", path)]
    outcome = run("evaluate", scene, odd, "--lpips", "none", *flags, code=0)
    assert all("odd" in path.read_text(encoding="utf-8") for path in outputs)
    assert r"odd\udcff\x1b[31m.ply" in outcome.out
