"""Results that show the scene's own photos worse than the input are never written without a word about it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from batches import InlinePool, records
from messages import names
from scenes import psnr_of
from shared import write_scene
from sweeps import sweep

import gsmerge
from gsmerge import Scene
from gsmerge.method.geometry.views import subset
from gsmerge.method.raster.metrics import MAX_LOSS

from .conftest import Run

FEW = ("--budget", 10, "--set", "fit=none", "--effort", "draft", "--threads", 1)  # Gaussians, too few to show anything
SAID = "worse"


@pytest.fixture(scope="module")
def one_photo(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Return the second of three views alone."""
    folder = write_scene(tmp_path_factory.mktemp("three") / "scene", num_views=3, width=60, height=40)
    return subset(gsmerge.read_scene(folder), [1])


@pytest.mark.slow
@sweep("effort", ["draft", "fast"])
def test_networks_keep_what_the_views_show_without_photos_or_fit(made_scene: Path, effort: str) -> None:
    """Judged by the photos that the run did not get."""
    scene = gsmerge.read_scene(made_scene)
    bare = replace(scene, images=None, large_photos=None)
    before = psnr_of(scene.gaussians, scene)
    after, alone = (
        psnr_of(gsmerge.compact(bare, effort=effort, fit="none", checkpoint=name, threads=1).gaussians, scene)
        for name in ("auto", "none")
    )
    assert after > before - MAX_LOSS
    assert after > alone


@pytest.mark.slow
def test_one_photo_is_fitted_though_no_other_shows_what_is_held_out(one_photo: Scene) -> None:
    report = gsmerge.compact(one_photo, effort="draft", k=4, threads=1).report
    assert report.choices["fit"]["method"] == "full"
    assert report.psnr_after > report.psnr_before
    assert report.worse is None


@pytest.mark.parametrize("settings", [{"effort": "fast"}, {"fit": "none"}])
def test_one_photo_without_a_long_fit_gets_more_gaussians(one_photo: Scene, settings: dict[str, Any]) -> None:
    actual = gsmerge.compact(one_photo, threads=1, **settings)
    assert actual.report.options["k"] == 4
    assert any(note.startswith("k: 4, because") for note in actual.report.notes)
    fewer = gsmerge.compact(one_photo, threads=1, k=1, **settings)
    assert 2 * len(fewer.gaussians) < len(actual.gaussians) < 6 * len(fewer.gaussians)
    assert actual.report.psnr_after > fewer.report.psnr_after


def test_k_stays_1_with_a_long_fit_a_count_or_several_cameras(one_photo: Scene, smallest_scene: Path) -> None:
    asked = ({"fit_steps": 160}, {"effort": "fast", "budget": 200}, {"fit": "none", "superpixels": 100})
    cases = [*((one_photo, settings) for settings in asked), (gsmerge.read_scene(smallest_scene), {"fit": "none"})]
    for scene, settings in cases:
        assert gsmerge.compact(scene, threads=1, **settings).report.options["k"] == 1


def test_summary_names_a_worse_result(smallest_scene: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / "few.ply"
    said = run("compact", smallest_scene, "-o", out, *FEW, code=0)
    document = json.loads(run("compact", smallest_scene, "-o", out, *FEW, "--overwrite", "--json", code=0).out)
    psnr = document["psnr_input_views"]
    assert psnr["after"] < psnr["before"] - 0.5
    assert names(document["worse"], f"{psnr['after']:.2f} dB", f"{psnr['before']:.2f} dB")
    assert document["worse"] in document["notes"]
    (line,) = [line for line in said.err.splitlines() if SAID in line]
    assert f": {document['worse']}; " in line
    for option in ("--quiet", "--json"):
        assert run("compact", smallest_scene, "-o", out, *FEW, "--overwrite", option, code=0).err == ""


def test_strict_ends_with_code_4_and_keeps_a_worse_result(smallest_scene: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / "few.ply"
    said = run("compact", smallest_scene, "-o", out, *FEW, "--strict", code=4)
    assert said.err.count(SAID) == 1
    assert len(gsmerge.read_ply(out).gaussians) == 10
    better = ("--set", "fit_steps=60", "--threads", 1)
    assert "warning" not in run("compact", smallest_scene, "-o", tmp_path / "x.ply", *better, "--strict", code=0).err


@pytest.mark.slow
def test_worse_level_is_named(small_scene: Path, tmp_path: Path, run: Run) -> None:
    usual = ("--set", "fit_steps=60", "--threads", 1, "--budget", 120, "--levels", 3, "--json")
    said = run("compact", small_scene, "-o", tmp_path / "x.ply", *usual, code=0)
    document = json.loads(said.out)
    assert document["worse"].startswith("level ")
    assert {*document["doubts"]} == {note for note in document["notes"] if SAID in note}
    assert all(doubt.startswith("level ") for doubt in document["doubts"])
    assert any(document["worse"] in level["notes"] for level in document["levels"])


def test_cropped_result_is_not_called_worse(smallest_scene: Path) -> None:
    """Scores are of what a crop leaves, so a result is as good as without one."""
    scene = gsmerge.read_scene(smallest_scene)
    x, y, z = scene.gaussians.means[len(scene.gaussians) // 2]
    report = gsmerge.compact(scene, crop=f"sphere:{x},{y},{z},1", superpixels="30%", fit_steps=60, threads=1).report
    assert report.num_input < scene.num_gaussians
    assert report.psnr_after > report.psnr_before
    assert report.worse is None


def test_a_batch_names_worse_results(
    smallest_scene: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsmerge.jobs.batch.run.ProcessPool", InlinePool)
    out = tmp_path / "out"
    call = ("batch", smallest_scene, "-o", out, "--jobs", 1, *FEW)
    said = run(*call, code=0)
    assert f"warning: {smallest_scene}: " in said.out
    assert said.out.splitlines()[-1].endswith("; 1 doubtful")
    assert "warning: 1 of 1 result is doubtful" in said.err
    (record,) = records(out)
    assert SAID in record["report"]["worse"]
    again = run(*call, "--strict", code=4)
    assert "1 skipped" in again.out
    assert again.err.endswith("1 of 1 result is doubtful\n")


@pytest.mark.slow
def test_evaluate_and_view_name_a_worse_result(smallest_scene: Path, tmp_path: Path, run: Run) -> None:
    small = tmp_path / "few.ply"
    run("compact", smallest_scene, "-o", small, *FEW, "-q", code=0)
    report = tmp_path / "report.json"
    said = run("evaluate", smallest_scene, small, "--lpips", "none", "-o", report, code=0)
    assert "warning: few.ply " in said.err
    assert [note for note in json.loads(report.read_text())["notes"] if SAID in note]
    page = tmp_path / "view.html"
    said = run("view", smallest_scene, small, "-o", page, "--no-open", code=0)
    assert "warning: few.ply " in said.err
    assert "photos worse than" in page.read_text()
