"""A file that holds its cameras needs no other to be looked at, measured, compacted or extended."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from saved_cameras import embed
from sweeps import sweep

import gsmerge
from gsmerge.io import read_cameras
from gsmerge.scene.read import load_scene

from .conftest import Run

FAST = ("--effort", "draft", "--set", "fit_steps=5", "--threads", 1)


@pytest.fixture(scope="module")
def alone(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a result that holds its cameras, and the photos; read only."""
    from gsmerge.cli import main

    folder = tmp_path_factory.mktemp("alone")
    call = ["compact", small_scene, "-o", folder / "small.ply", *FAST, "--levels", 2]
    assert main([str(word) for word in [*call, "--set", "viewer_cameras=false", "--set", "superpixels=200", "-q"]]) == 0
    scene = gsmerge.read_scene(small_scene)
    for path in folder.glob("*.ply"):
        embed(path, scene.cameras, scene.names)
    shutil.copytree(small_scene / "images", folder / "images")
    return folder


def test_the_cameras_are_those_of_the_scene(alone: Path, small_scene: Path) -> None:
    expected = gsmerge.read_scene(small_scene)
    for name in ("small.ply", "small.level1.ply"):
        actual = load_scene(alone / name)
        assert actual.scene.names == expected.names
        np.testing.assert_allclose(actual.scene.cameras.viewmats, expected.cameras.viewmats, atol=1e-6)
        np.testing.assert_allclose(actual.scene.cameras.Ks, expected.cameras.Ks, rtol=1e-6)
        assert np.array_equal(actual.scene.images, expected.images)


@sweep("command", ["compact", "evaluate", "view", "extend", "inspect", "render"], often=2)
def test_commands_read_them(alone: Path, tmp_path: Path, run: Run, command: str) -> None:
    small, state = alone / "small.ply", tmp_path / "room.gsm"
    calls = {
        "compact": (small, "-o", tmp_path / "x.ply", *FAST, "--budget", 100),
        "evaluate": (small, alone / "small.level1.ply", "--lpips", "none"),
        "view": (small, alone / "small.level1.ply", "-o", tmp_path / "x.html", "--no-open"),
        "extend": (state, small, "--set", "effort=draft", "--set", "checkpoint=none"),
        "inspect": (small,),
        "render": (small, "-o", tmp_path / "x.png"),
    }
    said = run(command, *calls[command], code=0)
    if command == "inspect":
        assert "5 (inside" in said.out
    if command == "extend":
        assert "5 views" in said.out


def test_a_result_lends_its_cameras_to_a_scene_without(
    alone: Path, small_scene: Path, tmp_path: Path, run: Run
) -> None:
    shutil.copy(small_scene / "scene.ply", tmp_path / "bare.ply")
    said = run("evaluate", tmp_path / "bare.ply", alone / "small.ply", "--lpips", "none", "--images", alone / "images",
               "--json", code=0)  # fmt: skip
    document = json.loads(said.out)
    assert document["num_views"] == {"context": 5}
    assert document["reference"] == "photos"
    assert document["results"][0]["mean"]["context"]["psnr"] > 15


def test_named_cameras_go_before(alone: Path, small_scene: Path, run: Run) -> None:
    said = run("inspect", alone / "small.ply", "--cameras", small_scene / "transforms.json", code=0)
    assert "transforms.json" in said.out
    assert len(read_cameras(alone / "small.ply")) == 5
