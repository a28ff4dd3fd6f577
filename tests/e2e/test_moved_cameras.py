"""Cameras may be in another world than the Gaussians, or belong to another file, which is a note or a doubt."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from batches import InlinePool
from messages import ERROR, names, noted
from shared import write_small, write_smallest
from tiny_scene import edited_json

from gsmerge.method.kernels import elementary

from .conftest import Run, assert_refused

SCALE = 1.8


def enlarge_cameras(folder: Path) -> Path:
    """Move the cameras' centres of a scene into larger units."""
    with edited_json(folder / "transforms.json") as data:
        for frame in data["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] *= SCALE
    return folder


@pytest.fixture
def moved_scene(tmp_path: Path) -> Path:
    """Return the small scene with the camera centres in larger units."""
    return enlarge_cameras(write_small(tmp_path / "scene"))


def psnr(folder: Path, photos: Path) -> float:
    errors = []
    for path in sorted(photos.iterdir()):
        drawn = cv2.imread(str(folder / f"{path.stem}.png")).astype(float)
        errors.append(((drawn - cv2.imread(str(path)).astype(float)) ** 2).mean())
    return float(np.mean(10 * elementary.log10(255**2 / np.array(errors))))


def test_render_moves_the_cameras(moved_scene: Path, tmp_path: Path, run: Run) -> None:
    """Reading looks for the frame of the cameras each time, which takes half a second."""
    outcome = run("compact", moved_scene, "--fit", "none", "--json", code=0)
    expected = json.loads(outcome.out)["psnr_input_views"]
    photos = moved_scene / "images"
    for name, key in (("scene.ply", "before"), ("scene.compact.ply", "after")):
        outcome = run("render", moved_scene / name, "-o", tmp_path / key, "--json", code=0)
        assert noted(json.loads(outcome.out)["notes"], "cameras are", "scaled")
        assert psnr(tmp_path / key, photos) == pytest.approx(expected[key], abs=0.2)


@pytest.mark.slow
def test_result_is_drawn_in_the_frame_of_the_scene_beside_it(moved_scene: Path, tmp_path: Path, run: Run) -> None:
    """A compact scene without photos tells no frame by itself, and has that of the scene beside it."""
    elsewhere, alone = tmp_path / "small.ply", tmp_path / "cameras" / "transforms.json"
    alone.parent.mkdir()
    shutil.copy(moved_scene / "transforms.json", alone)
    assert run("compact", moved_scene, "--fit", "none", "-o", elsewhere, "--quiet").code == 0
    actual = {}
    beside = Path(shutil.copy(elsewhere, moved_scene / "scene.compact.ply"))
    for name, scene, more in (("own", elsewhere, ("--cameras", alone)), ("like", beside, ())):
        run("render", scene, "-o", tmp_path / name, *more, code=0)
        actual[name] = psnr(tmp_path / name, moved_scene / "images")
    assert actual["like"] > actual["own"] + 3


@pytest.mark.slow
def test_render_looks_from_moved_cameras_beside_broken_photos(
    scene_copy: Path, tmp_path: Path, run: Run, floor: Callable[..., None]
) -> None:
    moved_scene = enlarge_cameras(scene_copy)
    photos = tmp_path / "photos"
    (moved_scene / "images").rename(photos)
    (moved_scene / "images").mkdir()
    for path in photos.iterdir():
        (moved_scene / "images" / path.name).write_bytes(path.read_bytes()[:100])
    run("render", moved_scene, "-o", tmp_path / "out", code=0)
    floor(psnr(tmp_path / "out", photos))
    broken, sheet = moved_scene / "images", ("render", moved_scene / "scene.ply", "-o", tmp_path / "sheet.png")
    assert names(run(*sheet, code=0).err, f"the photos in {broken} are left out", "cannot be decoded")
    assert_refused(run(*sheet, "--overwrite", "--images", broken), 3, broken, "view_000.png", "cannot be decoded")


FEW = ("--budget", "20%", "--fit", "none", "--effort", "draft", "--threads", 1)


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run batches in this process: another takes a second to start."""
    monkeypatch.setattr("gsmerge.jobs.batch.run.ProcessPool", InlinePool)


@pytest.fixture
def stray(tmp_path: Path) -> Path:
    """Return a scene beside a damaged camera file."""
    folder = write_smallest(tmp_path / "room")
    shutil.rmtree(folder / "images")
    (folder / "transforms.json").write_text('{"frames": [')
    return folder


def test_stray_cameras_are_noted_and_end_strict_runs_with_code_4(stray: Path, run: Run) -> None:
    words = ("compact", stray, "-o", stray / "small.ply", "--overwrite", *FEW)
    document = json.loads(run(*words, "--json", code=0).out)
    (note,) = document["doubts"]
    assert names(note, stray / "transforms.json", "left out")
    assert document["notes"].count(note) == 1
    outcome = run(*words, "--strict", code=4)
    assert outcome.err.count(note) == 1
    assert outcome.err.endswith(f"{ERROR}{note}\n")
    assert (stray / "small.ply").is_file()
    assert note not in run(*words, "--cameras", "none", "--strict").err
    assert_refused(run(*words, "--cameras", stray / "transforms.json"), 3, "transforms.json", "--cameras none")


def test_batch_repeats_the_note_on_stray_cameras_of_a_finished_scene(stray: Path, run: Run) -> None:
    words = ("batch", stray, "-o", stray.parent / "out", *FEW[:2], "--set", "fit=none", *FEW[4:])
    for _ in range(2):
        outcome = run(*words, code=0)
        assert outcome.out.count("left out") == 1
    outcome = run(*words, "--strict", code=4)
    assert outcome.err.endswith(f"{ERROR}1 of 1 result is doubtful\n")
    assert "left out" not in run(*words, "--cameras", "none", "--strict").out


def test_photos_that_do_not_show_the_scene_are_a_doubt_too(smallest_copy: Path, run: Run) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (16, 24, 3), np.uint8)
    assert cv2.imwrite(str(smallest_copy / "images" / "view_001.png"), noise)
    words = ("compact", smallest_copy, "-o", smallest_copy / "small.ply", *FEW)
    outcome = run(*words, "--strict", "--json", code=4)
    document = json.loads(outcome.out)
    (note,) = document["doubts"]
    assert names(note, "1 of 3", "view_001")
    assert document["notes"].count(note) == 1
    assert outcome.err == f"{ERROR}{note}\n"
    words = ("batch", smallest_copy, "-o", smallest_copy.parent / "out", *FEW[:2], "--set", "fit=none", *FEW[4:])
    assert note in run(*words, code=0).out
    assert run(*words, "--strict", code=4).err.endswith("1 of 1 result is doubtful\n")


@pytest.mark.parametrize("words", [("render", "SCENE", "-o", "OUT.png"), ("convert", "SMALL", "OUT.spz")])
def test_commands_that_take_cameras_run_beside_stray_ones(words: tuple[str, ...], stray: Path, run: Run) -> None:
    small = stray / "small.ply"
    shutil.copy(stray / "scene.ply", small)
    (stray / "small.cameras.json").write_text("nonsense")
    places = {
        "SCENE": str(stray / "scene.ply"),
        "SMALL": str(small),
        "OUT.png": stray / "a.png",
        "OUT.spz": stray / "a.spz",
    }
    parts: list[Any] = [places.get(word, word) for word in words]
    assert "is left out" in run(*parts, code=0).err  # the camera file; photos are
    assert "is left out" not in run(*parts, "--overwrite", "--cameras", "none", code=0).err


@pytest.mark.parametrize(
    ("words", "place", "value"),
    [("--hint opacity=raw", "scene.ply", "--hint opacity=raw"), ("--set checkpoint=nosuch", "nosuch", "checkpoint")],
)
def test_wrong_hint_or_missing_checkpoint_is_refused(
    words: str, place: str, value: str, smallest_copy: Path, run: Run
) -> None:
    assert_refused(run("compact", smallest_copy, *words.split()), 3, place, value)


@pytest.mark.parametrize("command", ["compact A", "extend A.gsm A", "render A", "view A B", "batch A", "lab chart A"])
def test_second_output_is_refused(command: str, run: Run, tmp_path: Path) -> None:
    assert_refused(run(*command.split(), "-o", tmp_path / "a.ply", "-o", tmp_path / "b.spz"), 2, "")
    assert list(tmp_path.iterdir()) == []
