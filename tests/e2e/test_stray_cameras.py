"""Cameras beside a file that belong to another one are a note, and with ``--strict`` a doubt."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from batches import InlinePool
from messages import ERROR, names
from shared import write_smallest

from .conftest import Run, assert_refused

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
