"""``gsmerge evaluate`` as users call it."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from .conftest import Run


@pytest.fixture
def small(scene_copy: Path, run: Run) -> Path:
    out = scene_copy / "small.ply"
    assert run("compact", scene_copy, "-o", out, "-q", "--report", scene_copy / "run.json").code == 0
    return out


def test_table_and_files(scene_copy: Path, small: Path, run: Run, floor: Callable[..., None]) -> None:
    table, report = scene_copy / "a.csv", scene_copy / "a.json"
    outcome = run(
        "evaluate", scene_copy / "scene.ply", small, "--targets", scene_copy / "targets", "--lpips", "none",
        "-o", table, "-o", report,
    )  # fmt: skip
    assert (outcome.code, outcome.err) == (0, "")
    assert "small.ply" in outcome.out
    document = json.loads(report.read_text())
    before, after = document["results"]
    assert after["bytes"] == small.stat().st_size
    assert sum(after["bytes_by_attribute"].values()) < after["bytes"]
    floor(after["mean"]["target"]["psnr_visible"] - before["mean"]["target"]["psnr_visible"])
    assert document["num_views"] == {"context": 5, "target": 4}
    with table.open() as file:
        assert len(list(csv.DictReader(file))) == 2 * 9


def test_other_sizes(scene_copy: Path, run: Run) -> None:
    call = ("evaluate", scene_copy, "--targets", scene_copy / "targets", "--no-context", "--lpips", "none")
    outcome = run(*call, "--zoom", ".5,1,2", "--antialiased", "--json")
    document = json.loads(outcome.out)
    sizes = document["results"][0]["mean"]["target"]["zooms"]
    assert [one["zoom"] for one in sizes] == [0.5, 1, 2]
    assert sizes[1]["psnr"] == document["results"][0]["mean"]["target"]["psnr"]
    assert "PSNR 0.5x" in run(*call, "--zoom", ".5").out


def test_alignment(scene_copy: Path, run: Run) -> None:
    """Of held-out photos taken with another exposure and from a place that is not quite theirs."""
    targets = scene_copy / "targets" / "transforms.json"
    document = json.loads(targets.read_text())
    for frame in document["frames"]:
        frame["transform_matrix"][0][3] += 0.03
        photo = targets.parent / frame["file_path"]
        cv2.imwrite(str(photo), cv2.convertScaleAbs(cv2.imread(str(photo)), alpha=0.7, beta=10))
    targets.write_text(json.dumps(document))
    call = ("evaluate", scene_copy, "--targets", targets, "--no-context", "--lpips", "none", "--align", "color,pose")
    mean = json.loads(run(*call, "--json").out)["results"][0]["mean"]["target"]
    aligned = {name: scores["psnr_visible"] for name, scores in mean["aligned"].items()}
    assert mean["psnr_visible"] + 2 < aligned["color"] < aligned["both"]
    assert mean["pose_change"]["shift"] > 0
    assert "cameras moved by" in run(*call).out


def test_agrees_with_the_measuring_example(scene_copy: Path, small: Path, run: Run, target_psnr) -> None:
    outcome = run("evaluate", scene_copy, small, "--targets", scene_copy / "targets", "--lpips", "none", "--json")
    mean = json.loads(outcome.out)["results"][1]["mean"]["target"]
    assert mean["psnr"] == pytest.approx(target_psnr(scene_copy / "targets", small), abs=1e-4)


def test_fewer_views_need_the_trajectory(scene_copy: Path, run: Run) -> None:
    outcome = run("evaluate", scene_copy, "--targets", scene_copy / "targets", "--views", "3", "--lpips", "none")
    assert outcome.code == 2
    assert "also name the input views" in outcome.err
    outcome = run("evaluate", scene_copy, "--views", "3", "--lpips", "none", "--json")
    assert json.loads(outcome.out)["num_views"] == {"context": 3}
    assert "expected 1 to 5" in run("evaluate", scene_copy, "--views", "6", "--lpips", "none").err


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
    outcome = run("evaluate", scene_copy, "--targets", trajectory, "--views", "3", "--lpips", "none", "--json")
    document = json.loads(outcome.out)
    assert document["num_views"] == {"context": 3, "target": 2}
    held = [view["view"] for view in document["results"][0]["views"] if view["split"] == "target"]
    assert [Path(name).stem for name in held] == [Path(frames[i]["file_path"]).stem for i in (1, 5)]


@pytest.mark.parametrize("given", ["targets", "targets/transforms.json"])
def test_no_input_is_replaced(given: str, scene_copy: Path, run: Run) -> None:
    cameras = scene_copy / "targets" / "transforms.json"
    before = cameras.read_bytes()
    for command, flag in (("evaluate", "-o"), ("stress", "--report")):
        outcome = run(command, scene_copy, "--targets", scene_copy / given, flag, cameras, "--overwrite")
        assert (outcome.code, outcome.err.count("\n")) == (2, 1)
        assert "other than the input" in outcome.err
    assert cameras.read_bytes() == before


def test_networks_that_are_not_installed(scene_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsmerge.measure.lpips.lpips_available", lambda net: False)
    outcome = run("evaluate", scene_copy, scene_copy / "scene.ply", "--lpips", "vgg")
    assert outcome.code == 2
    assert "weights are not installed" in outcome.err


def test_outputs_are_files_of_their_own(scene_copy: Path, run: Run) -> None:
    both = ("-o", scene_copy / "a.md", "-o", scene_copy / "a.md")
    assert "got it twice" in run("evaluate", scene_copy, "--lpips", "none", *both).err
    assert "got scene.ply twice" in run("evaluate", scene_copy, "scene.ply", "scene.ply").err


@pytest.mark.parametrize("command", ["evaluate", "stress"])
def test_a_scene_without_cameras(command: str, scene_copy: Path, run: Run) -> None:
    (scene_copy / "transforms.json").unlink()
    outcome = run(command, scene_copy / "scene.ply", "--hint", "order=none", "--targets", scene_copy / "targets")
    assert outcome.code == 3
    assert "scene.ply: expected cameras to measure from" in outcome.err


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("--no-context",), 2, "--targets"),
        (("--target-images", "images"), 2, "--targets"),
        (("--targets", "nowhere.json"), 3, "expected cameras of held-out views"),
        (("--targets", "transforms.json"), 3, "the scene was not made of"),
        (("-o", "scene.ply"), 2, "ends in .json, .csv, .md, .html"),
        (("-o", "transforms.json"), 2, "other than the input"),
        (("--merge-seconds", "1"), 2, "that of each of 0 AFTER, got 1"),
        (("--align=color",), 2, "expected held-out views"),
        (("--align=colour", "--targets", "targets"), 2, "color or pose"),
        (("--zoom=a,2",), 2, "sizes such as .5,1,2,4"),
        (("--zoom=0",), 2, "from 1/16 to 16"),
        (("--zoom=2,2",), 2, "every size once"),
    ],
)
def test_bad_calls(arguments: tuple[str, ...], code: int, words: str, scene_copy: Path, run: Run) -> None:
    flag, *rest = arguments
    outcome = run(
        "evaluate", scene_copy, "--lpips", "none", flag,
        *(name if name.startswith("--") else scene_copy / name for name in rest),
    )  # fmt: skip
    assert outcome.code == code
    assert words in outcome.err
    assert outcome.err.count("\n") == 1


def test_costs_and_files_of_every_kind(scene_copy: Path, small: Path, run: Run) -> None:
    outputs = {suffix: scene_copy / f"page.{suffix}" for suffix in ("json", "csv", "md", "html")}
    flags = [part for path in outputs.values() for part in ("-o", path)]
    call = ("evaluate", scene_copy / "scene.ply", small, "--lpips", "none")
    outcome = run(*call, *flags, "--zoom", "1,.5", "--merge-seconds", scene_copy / "run.json")
    assert outcome.code == 0, outcome.err
    document = json.loads(outputs["json"].read_text())
    before, after = document["results"]
    assert [speed["width"] for speed in before["speeds"][:2]] == [96, 48]
    assert 1 < after["overdraw"] < before["overdraw"]
    assert after["merge_seconds"] == json.loads((scene_copy / "run.json").read_text())["total_seconds"]
    assert "| small.ply |" in outputs["md"].read_text()
    assert "data:image/webp;base64," in outputs["html"].read_text()
    assert "Render time" in outcome.out
    assert "overdraw" not in run(*call).out
    again = run(*call, "-o", outputs["md"])
    assert (again.code, "--overwrite" in again.err) == (2, True)


def test_views_are_placed_in_a_scene_without_cameras(scene_copy: Path, small: Path, run: Run) -> None:
    (scene_copy / "transforms.json").unlink()
    small.with_name("small.cameras.json").unlink()
    outcome = run("evaluate", scene_copy / "scene.ply", small, "--hint", "order=none", "--lpips", "none", "--json")
    assert outcome.code == 0, outcome.err
    document = json.loads(outcome.out)
    assert document["reference"] == "renders of the input"
    assert any("placed" in note for note in document["notes"])


def test_names_that_are_no_text(scene_copy: Path, small: Path, run: Run) -> None:
    odd = small.rename(scene_copy / "odd\udcff\x1b[31m.ply")
    outputs = [scene_copy / f"page.{suffix}" for suffix in ("md", "html", "json", "csv")]
    flags = [part for path in outputs for part in ("-o", path)]
    outcome = run("evaluate", scene_copy, odd, "--lpips", "none", *flags)
    assert outcome.code == 0, outcome.err
    assert all("odd" in path.read_text(encoding="utf-8") for path in outputs)
    assert r"odd\udcff\x1b[31m.ply" in outcome.out


@pytest.mark.parametrize(
    ("given", "words"), [("transforms.json", "total_seconds"), ("scene.ply", "cannot be read as text")]
)
def test_reports_that_are_none(
    given: str, words: str, scene_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(scene_copy)
    outcome = run("evaluate", "scene.ply", "scene.ply", "--lpips", "none", "--merge-seconds", given)
    assert (outcome.code, words in outcome.err, outcome.err.count("\n")) == (3, True, 1)
