"""``gsmerge evaluate`` as users call it."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from bare_files import write_without_grid
from messages import ERROR, says

import gsmerge

from .conftest import Run, assert_refused


@pytest.fixture
def small(scene_copy: Path, compacted_scene: Path) -> Path:
    """A result of the scene by the defaults, and the report of that run."""
    return Path(shutil.copytree(compacted_scene, scene_copy, dirs_exist_ok=True)) / "small.ply"


def test_table_and_files(
    scene_copy: Path,
    small: Path,
    run: Run,
    floor: Callable[..., None],
    target_psnr: Callable[[Path, Path], float],
) -> None:
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
    assert after["mean"]["target"]["psnr"] == pytest.approx(target_psnr(scene_copy / "targets", small), abs=1e-4)
    assert document["num_views"] == {"context": 5, "target": 4}
    with table.open() as file:
        assert len(list(csv.DictReader(file))) == 2 * 9


def test_other_sizes(scene_copy: Path, run: Run) -> None:
    call = ("evaluate", scene_copy, "--targets", scene_copy / "targets", "--set", "context=false", "--lpips", "none")
    outcome = run(*call, "--set", "zoom=.5,1,2", "--set", "antialiased=true", "--json")
    document = json.loads(outcome.out)
    sizes = document["results"][0]["mean"]["target"]["zooms"]
    assert [one["zoom"] for one in sizes] == [0.5, 1, 2]
    assert sizes[1]["psnr"] == document["results"][0]["mean"]["target"]["psnr"]
    assert "PSNR 0.5x" in run(*call, "--set", "zoom=.5").out


@pytest.mark.parametrize("setting", ["context=false", "photo_side=48", "views=3"])
def test_a_page_shows_what_was_measured(setting: str, scene_copy: Path, small: Path, run: Run) -> None:
    page = scene_copy / "page.html"
    call = ("evaluate", scene_copy, small, "--targets", scene_copy / "targets", "--lpips", "none", "-o", page)
    if setting == "views=3":
        call = (*call[:3], *call[5:])
    document = json.loads(run(*call, "--set", setting, "--json", code=0).out)
    split = "context" if setting == "views=3" else "target"
    text = page.read_text()
    assert f"{document['results'][1]['mean'][split]['psnr_visible']:.2f}" in text
    shown = sum(document["num_views"].values())
    assert text.count('"held_out":true') == document["num_views"].get("target", 0)
    assert text.count('"held_out":') == shown + 1  # and the view from outside


def test_photos_of_a_given_size(scene_copy: Path, small: Path, run: Run) -> None:
    call = ("evaluate", scene_copy, small, "--targets", scene_copy / "targets", "--lpips", "none")
    document = json.loads(run(*call, "--set", "photo_side=48", "--set", "speed=true", "--json").out)
    assert document["photo_side"] == 48
    assert [speed["width"] for speed in document["results"][1]["speeds"]] == [48, 96]
    usual = json.loads(run(*call, "--json").out)
    assert "photo_side" not in usual
    assert usual["results"][1]["mean"] != document["results"][1]["mean"]


def test_fewer_views(scene_copy: Path, run: Run) -> None:
    outcome = run("evaluate", scene_copy, "--set", "views=3", "--lpips", "none", "--json")
    assert json.loads(outcome.out)["num_views"] == {"context": 3}


def test_a_trajectory_with_both_kinds_of_views(scene_copy: Path, run: Run) -> None:
    context = json.loads((scene_copy / "transforms.json").read_text())
    targets = json.loads((scene_copy / "targets" / "transforms.json").read_text())
    frames = []
    for i, frame in enumerate(context["frames"]):
        frames.append(frame)
        if i < len(targets["frames"]):
            own = targets["frames"][i]
            frames.append(own | {"file_path": "targets/" + own["file_path"]})
    for frame in frames[1::2]:  # names of their own
        new = frame["file_path"].replace("view", "held")
        (scene_copy / frame["file_path"]).rename(scene_copy / new)
        frame["file_path"] = new
    trajectory = scene_copy / "all.json"
    trajectory.write_text(json.dumps(context | {"frames": frames}))
    outcome = run("evaluate", scene_copy, "--targets", trajectory, "--set", "views=3", "--lpips", "none", "--json")
    document = json.loads(outcome.out)
    assert document["num_views"] == {"context": 3, "target": 2}
    held = [view["view"] for view in document["results"][0]["views"] if view["split"] == "target"]
    assert [Path(name).stem for name in held] == [Path(frames[i]["file_path"]).stem for i in (1, 5)]


def test_networks_that_are_not_installed(scene_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsmerge.measure.lpips.lpips_available", lambda net: False)
    outcome = run("evaluate", scene_copy, scene_copy / "scene.ply", "--lpips", "vgg", code=2)
    assert says(outcome.err.removeprefix(ERROR), "--lpips", "installed")


def test_lpips_is_measured_with_alexnet_on_four_views(
    scene_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = []
    monkeypatch.setattr("gsmerge.measure.lpips.lpips_available", lambda net: True)
    monkeypatch.setattr("gsmerge.measure.lpips.lpips", lambda image, photo, net, mask: looked.append(net) or 0.25)
    monkeypatch.setattr("gsmerge.measure.lpips.min_size", lambda net: 1)
    outcome = run("evaluate", scene_copy, "--json", code=0)
    assert set(looked) == {"alex"}
    document = json.loads(outcome.out)
    assert document["lpips_views"] == 4
    assert [view["lpips_alex"] for view in document["results"][0]["views"]].count(0.25) == 4
    assert "LPIPS on 4 views" in run("evaluate", scene_copy).out
    every = json.loads(run("evaluate", scene_copy, "--lpips", "both", "--set", "lpips_views=null", "--json").out)
    assert "lpips_views" not in every
    assert [view["lpips_vgg"] for view in every["results"][0]["views"]].count(0.25) == 5


def test_costs_and_files_of_every_kind(scene_copy: Path, small: Path, run: Run) -> None:
    outputs = {suffix: scene_copy / f"page.{suffix}" for suffix in ("json", "csv", "md", "html")}
    flags = [part for path in outputs.values() for part in ("-o", path)]
    call = ("evaluate", scene_copy / "scene.ply", small, "--lpips", "none")
    outcome = run(*call, *flags, "--set", "zoom=1,.5", "--set", f"merge_seconds={scene_copy / 'run.json'}", code=0)
    document = json.loads(outputs["json"].read_text())
    before, after = document["results"]
    assert [speed["width"] for speed in before["speeds"][:2]] == [96, 48]
    assert 1 < after["overdraw"] < before["overdraw"]
    assert after["merge_seconds"] == json.loads((scene_copy / "run.json").read_text())["total_seconds"]
    assert "| small.ply |" in outputs["md"].read_text()
    page = outputs["html"].read_text()
    assert "% of the Gaussians, " in page.replace("\u00a0", " ")
    assert 'id="splats-1"' in page  # the page of view
    assert "Render time" in outcome.out
    assert "overdraw" not in run(*call).out
    run(*call, *flags, code=0)  # what it made is replaced
    for path in outputs.values():
        path.write_text("mine")
        assert_refused(run(*call, "-o", path), 2, path, "exists already")
        assert path.read_text() == "mine"


def test_views_are_placed_in_a_scene_without_cameras(small_scene: Path, tmp_path: Path, run: Run) -> None:
    bare = write_without_grid(small_scene / "scene.ply", tmp_path / "scene.ply")
    gsmerge.write_ply(small := tmp_path / "small.ply", gsmerge.read_ply(bare).gaussians[::9])
    outcome = run("evaluate", bare, small, "--lpips", "none", "--json", code=0)
    document = json.loads(outcome.out)
    assert document["reference"] == "renders of the input"
    assert any("placed" in note for note in document["notes"])


def test_names_that_are_no_text(scene_copy: Path, small: Path, run: Run) -> None:
    odd = small.rename(scene_copy / "odd\udcff\x1b[31m.ply")
    outputs = [scene_copy / f"page.{suffix}" for suffix in ("md", "html", "json", "csv")]
    flags = [part for path in outputs for part in ("-o", path)]
    outcome = run("evaluate", scene_copy, odd, "--lpips", "none", *flags, code=0)
    assert all("odd" in path.read_text(encoding="utf-8") for path in outputs)
    assert r"odd\udcff\x1b[31m.ply" in outcome.out
