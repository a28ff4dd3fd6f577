"""Every kind of bad input: its exit code, one clear line, no traceback, nothing left behind."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import gsmerge

from .conftest import Run, listing

HEADER_END = b"end_header\n"
Spoil = Callable[[Path], list[object]]


@pytest.fixture
def scene_copy(small_scene: Path, tmp_path: Path) -> Path:
    """A copy that a test may change, of 5 views of 48 x 32: some kinds are searched on every pixel."""
    return Path(shutil.copytree(small_scene, tmp_path / "scene"))


def header_and_rows(ply: Path) -> tuple[str, bytes]:
    head, rows = ply.read_bytes().split(HEADER_END, 1)
    return head.decode(), rows


def missing_file(scene: Path) -> list[object]:
    (scene / "scene.ply").unlink()
    return []


def truncated(scene: Path) -> list[object]:
    ply = scene / "scene.ply"
    ply.write_bytes(ply.read_bytes()[:-1000])
    return []


def text_file(scene: Path) -> list[object]:
    (scene / "scene.ply").write_text("These are notes, not Gaussians.\n")
    return []


def no_vertex(scene: Path) -> list[object]:
    ply = scene / "scene.ply"
    ply.write_bytes(ply.read_bytes().replace(b"element vertex", b"element points", 1))
    return []


def missing_columns(scene: Path) -> list[object]:
    ply = scene / "scene.ply"
    data = ply.read_bytes()
    for name in (b"rot_3", b"scale_1"):
        data = data.replace(b"property float " + name + b"\n", b"property float other_" + name + b"\n", 1)
    ply.write_bytes(data)
    return []


def no_gaussians(scene: Path) -> list[object]:
    head, _ = header_and_rows(scene / "scene.ply")
    lines = ["element vertex 0" if line.startswith("element") else line for line in head.splitlines()]
    (scene / "scene.ply").write_bytes("\n".join([*lines, ""]).encode() + HEADER_END)
    return []


def all_nan(scene: Path) -> list[object]:
    head, rows = header_and_rows(scene / "scene.ply")
    nans = np.full(len(rows) // 4, np.nan, "<f4").tobytes()
    (scene / "scene.ply").write_bytes(head.encode() + HEADER_END + nans)
    return []


def unknown_lens(scene: Path) -> list[object]:
    path = scene / "transforms.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"camera_model": "EQUIRECTANGULAR"}))
    return []


def resized_images(scene: Path) -> list[object]:
    for path in (scene / "images").iterdir():
        image = cv2.imread(str(path))
        assert image is not None
        cv2.imwrite(str(path), cv2.resize(image, (24, 16)))
    return []


def lost_image(scene: Path) -> list[object]:
    (scene / "images" / "view_003.png").unlink()
    return []


def unreadable_image(scene: Path) -> list[object]:
    (scene / "images" / "view_003.png").write_bytes(b"no picture")
    return []


def no_cameras(scene: Path) -> list[object]:
    (scene / "transforms.json").unlink()
    shutil.rmtree(scene / "images")
    return []


def broken_json(scene: Path) -> list[object]:
    (scene / "transforms.json").write_text("{")
    return []


def missing_cameras(scene: Path) -> list[object]:
    path = scene / "transforms.json"
    data = json.loads(path.read_text())
    data["frames"] = data["frames"][:-1]
    path.write_text(json.dumps(data))
    return []


def output_in_no_folder(scene: Path) -> list[object]:
    return ["-o", scene / "nowhere" / "small.ply"]


def output_below_a_file(scene: Path) -> list[object]:
    return ["-o", scene / "transforms.json" / "small.ply"]


def output_is_a_folder(scene: Path) -> list[object]:
    return ["-o", scene / "images"]


def output_is_the_input(scene: Path) -> list[object]:
    return ["-o", scene / "scene.ply", "--overwrite"]


def output_is_the_input_by_another_name(scene: Path) -> list[object]:
    return ["-o", scene / "images" / ".." / "scene.ply", "--overwrite"]


def output_exists(scene: Path) -> list[object]:
    (scene / "scene.compact.ply").write_bytes(b"precious")
    return []


def report_is_the_output(scene: Path) -> list[object]:
    return ["-o", scene / "small.ply", "--report", scene / "small.ply"]


def given(*arguments: object) -> Spoil:
    return lambda scene: list(arguments)


CASES: dict[str, tuple[Spoil, int, list[str]]] = {
    "missing file": (missing_file, 3, ["scene"]),
    "truncated": (truncated, 3, ["scene.ply", "truncated", "7680"]),
    "text file": (text_file, 3, ["scene.ply", "expected a PLY file"]),
    "no vertex element": (no_vertex, 3, ["scene.ply", "vertex", "points"]),
    "missing columns": (missing_columns, 3, ["scene.ply", "scale_1", "rot_3"]),
    "zero Gaussians": (no_gaussians, 3, ["scene.ply", "at least one Gaussian", "0"]),
    "all NaN": (all_nan, 3, ["scene.ply", "NaN", "7680"]),
    "unknown lens": (unknown_lens, 3, ["transforms.json", "EQUIRECTANGULAR", "undistort"]),
    "image size": (resized_images, 3, ["48 x 32", "24 x 16"]),
    "fewer images than cameras": (lost_image, 3, ["images", "expected 5", "found 4", "view_003"]),
    "unreadable image": (unreadable_image, 3, ["view_003.png"]),
    "no cameras": (no_cameras, 3, ["scene.ply", "no cameras", "--cameras"]),
    "broken JSON": (broken_json, 3, ["transforms.json", "expected JSON"]),
    "missing cameras": (missing_cameras, 3, ["scene.ply", "7680", "6144", "5 views"]),
    "no such cameras": (given("--cameras", "nowhere.json"), 3, ["nowhere.json", "no such file"]),
    "no such images": (given("--images", "nowhere"), 3, ["nowhere", "no such file"]),
    "output in no folder": (output_in_no_folder, 3, ["small.ply", "nowhere"]),
    "output below a file": (output_below_a_file, 3, ["small.ply"]),
    "output is a folder": (output_is_a_folder, 2, ["images", "found a folder"]),
    "output is the input": (output_is_the_input, 2, ["scene.ply", "other than the input"]),
    "output is the input, renamed": (output_is_the_input_by_another_name, 2, ["other than the input"]),
    "output exists": (output_exists, 2, ["scene.compact.ply", "--overwrite"]),
    "report is the output": (report_is_the_output, 2, ["small.ply"]),
    "K = 0": (given("--k", 0), 2, ["k: expected 1 to 8 or mixed, got 0"]),
    "K = 9": (given("--k", 9), 2, ["k: expected 1 to 8 or mixed, got 9"]),
    "more superpixels than pixels": (given("--superpixels", 48 * 32 + 1), 2, ["1536", "1537"]),
    "no superpixels": (given("--superpixels", 0), 2, ["superpixels"]),
    "share zero": (given("--superpixels", "0%"), 2, ["superpixels"]),
    "share above one": (given("--superpixels", "150%"), 2, ["superpixels"]),
    "unknown segmentation": (given("--set", "segmentation=magic"), 2, ["segmentation", "rdseg"]),
    "unknown match": (given("--set", "match=magic"), 2, ["--set match", "overlap"]),
    "unknown option": (given("--magic"), 2, ["--magic"]),
    "unknown setting": (given("--set", "pose=free"), 2, ["--set pose", "the closest name is poses", "settings.md"]),
    "no setting": (given("--set", "poses"), 2, ["--set: expected NAME=VALUE, got 'poses'"]),
    "a setting of another type": (given("--set", "overlap=much"), 2, ["--set overlap: expected a number, got 'much'"]),
    "a setting given twice": (given("--k", 2, "--set", "k=2"), 2, ["--set k: expected it once, got --k too"]),
    "unknown hint": (given("--hint", "oder=none"), 2, ["--hint oder", "the closest name is order"]),
    "impossible hint": (given("--hint", "max_side=4"), 2, ["max_side: expected a whole number of at least 16"]),
    "no threads": (given("--threads", 0), 2, ["--threads"]),
}


@pytest.mark.parametrize("name", CASES)
def test_bad_input_is_told_in_one_line(name: str, scene_copy: Path, run: Run) -> None:
    spoil, code, fragments = CASES[name]
    arguments = spoil(scene_copy)
    before = listing(scene_copy)
    outcome = run("compact", scene_copy, *arguments)
    assert outcome.code == code, outcome.err
    assert outcome.out == ""
    assert outcome.err.startswith("gsmerge: error: ")
    assert outcome.err.count("\n") == 1
    assert [part for part in fragments if part not in outcome.err] == []
    assert listing(scene_copy) == before


def test_a_named_file_that_is_missing_is_told(tmp_path: Path, run: Run) -> None:
    outcome = run("compact", tmp_path / "nothing.ply")
    assert outcome.code == 3
    assert "nothing.ply: no such file" in outcome.err


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the superuser may write anywhere")
def test_a_folder_without_permission_is_told(scene_copy: Path, run: Run) -> None:
    locked = scene_copy / "locked"
    locked.mkdir(mode=0o500)
    outcome = run("compact", scene_copy, "-o", locked / "small.ply")
    assert outcome.code == 3
    assert "cannot be written" in outcome.err
    assert list(locked.iterdir()) == []


@pytest.mark.parametrize(
    "command", ["inspect", "render -o {}/p.png", "render -o {}/out", "render --as superpixels -o {}/out"]
)
def test_other_commands_tell_bad_input_too(command: str, scene_copy: Path, run: Run) -> None:
    text_file(scene_copy)
    outcome = run(*command.format(scene_copy).split(), scene_copy)
    assert outcome.code == 3
    assert outcome.err.count("\n") == 1
    assert "expected a PLY file" in outcome.err
    assert not (scene_copy / "p.png").exists()


@pytest.mark.parametrize("kind", ["views", "superpixels"])
def test_occupied_folders_are_refused(kind: str, made_scene: Path, tmp_path: Path, run: Run) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("precious")
    outcome = run("render", made_scene, "--as", kind, "-o", tmp_path / "out")
    assert outcome.code == 2
    assert "--overwrite" in outcome.err
    assert listing(tmp_path) == {"out/mine.txt": 8}


def test_nothing_left_is_bad_input(scene_copy: Path, run: Run) -> None:
    """Points without any size: no file of nothing is written."""
    gaussians = gsmerge.read_ply(scene_copy / "scene.ply").gaussians
    points = replace(gaussians, scales=np.full_like(gaussians.scales, 1e-30))
    gsmerge.write_ply(scene_copy / "scene.ply", points, overwrite=True)
    outcome = run("compact", scene_copy, "--fit", "none")
    assert outcome.code == 3
    assert "found none that is left" in outcome.err
    assert not (scene_copy / "scene.compact.ply").exists()
