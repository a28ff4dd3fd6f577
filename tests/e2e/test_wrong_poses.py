"""Scenes whose cameras are wrong are moved with a note, written on request, or refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import motions
import numpy as np
import pytest
from saved_cameras import write_transforms
from shared import write_scene
from tiny_scene import edited_json

from gsmerge import to_cameras
from gsmerge.io import write_gaussians
from gsmerge.io.cameras.read_cameras import read_cameras
from gsmerge.method.geometry.transforms import pose_changes
from gsmerge.reading.read_scene import load_scene

from .conftest import Run

FAST = ("--effort", "fast", "--set", "fit_steps=20", "--json")


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a scene in which what cameras are turned by is more than a pixel and a half. Read only."""
    return write_scene(tmp_path_factory.mktemp("poses") / "scene", num_views=3, width=108, height=72)


def turn_cameras(folder: Path, degrees: float, only: int | None = None) -> None:
    """Turn the cameras of a scene, or one of them, about their centres."""
    path, rng = folder / "transforms.json", np.random.default_rng(0)
    with edited_json(path) as data:
        for i, frame in enumerate(data["frames"]):
            axis = rng.normal(size=3)
            if only in (None, i):
                turn = np.eye(4)
                turn[:3, :3] = cv2.Rodrigues(np.deg2rad(degrees) * axis / np.linalg.norm(axis))[0]
                frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ turn).tolist()


def test_slightly_wrong_cameras_are_moved_and_written(exact: Path, tmp_path: Path, run: Run) -> None:
    """Two scenes are compacted and scored at the size at which poses can be told."""
    wrong = Path(shutil.copytree(exact, tmp_path / "wrong"))
    turn_cameras(wrong, 0.8)
    psnr: dict[str, Any] = {}
    for folder in (exact, wrong):
        outcome = run("compact", folder, *FAST, "-o", tmp_path / f"{folder.name}.ply", code=0)
        document = json.loads(outcome.out)
        psnr[folder.name] = document["psnr_input_views"]
        notes = [note for note in document["notes"] if "the cameras are off by a median of" in note]
        moves = [move["degrees"] for move in document["input"]["moved_cameras"]]
        assert (len(notes), len(moves)) == ((1, 3) if folder is wrong else (0, 0))
    assert psnr["wrong"]["before"] == pytest.approx(psnr["scene"]["before"], abs=0.3)
    assert psnr["wrong"]["after"] == pytest.approx(psnr["scene"]["after"], abs=0.5)
    truth, cameras = read_cameras(exact / "transforms.json"), read_cameras(tmp_path / "wrong.cameras.json")
    assert pose_changes(truth.viewmats, cameras.viewmats)[0].max() < 0.1
    np.testing.assert_allclose(cameras.Ks, truth.Ks)
    write_transforms(wrong / "transforms.json", to_cameras(cameras), truth.names)  # in place of wrong ones
    assert load_scene(wrong).moves == ()


def test_result_is_measured_from_the_cameras_that_compact_moved(exact: Path, tmp_path: Path, run: Run) -> None:
    """Views that do not agree with each other: ``compact`` moves them, and writes the cameras beside the result."""
    scene = load_scene(exact).scene
    wrong = motions.disagreeing(scene, 0.8, 0.01)
    folder = Path(shutil.copytree(exact, tmp_path / "wrong"))
    write_gaussians(folder / "scene.ply", wrong.gaussians, overwrite=True)
    write_transforms(folder / "transforms.json", wrong.cameras, wrong.names)
    out, other = tmp_path / "auto.ply", tmp_path / "other.ply"
    document = json.loads(run("compact", folder, *FAST, "-o", out).out)
    assert document["choices"]["poses"]
    shutil.copy(out, other)  # without its cameras
    outcome = run("evaluate", folder, out, other, "--lpips", "none", "--json", code=0)
    found = json.loads(outcome.out)
    _, own, given = (one["mean"]["context"]["psnr"] for one in found["results"])
    assert own == pytest.approx(document["psnr_input_views"]["after"], abs=0.6)  # of a quarter of each photo
    assert own > given + 2
    assert sum("its input views are drawn from the cameras in auto.cameras.json" in n for n in found["notes"]) == 1
