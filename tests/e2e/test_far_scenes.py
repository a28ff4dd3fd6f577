"""Positions far from the origin lose digits in files, and scores are those of what was written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from messages import noted
from plyfile import PlyData, PlyElement
from scenes import psnr_of
from sweeps import sweep

import gsmerge

from .conftest import Run

DRAFT = ("--effort", "draft", "--budget", 300, "--threads", 1, "--json")
WHOLE = ("--quality", "60dB")  # missed; scores are those of whole photos


def move_scene(folder: Path, shift: float) -> None:
    """Move a scene and its cameras, with positions in float64."""
    rows = PlyData.read(folder / "scene.ply")["vertex"].data
    kinds = [(name, "f8" if name in "xyz" else rows.dtype[name]) for name in rows.dtype.names]
    wide = rows.astype(kinds)
    for axis in "xyz":
        wide[axis] += shift
    PlyData([PlyElement.describe(wide, "vertex")]).write(folder / "scene.ply")
    cameras = json.loads((folder / "transforms.json").read_text())
    for frame in cameras["frames"]:
        matrix = np.array(frame["transform_matrix"])
        matrix[:3, 3] += shift
        frame["transform_matrix"] = matrix.tolist()
    (folder / "transforms.json").write_text(json.dumps(cameras))


def set_apart(folder: Path, factor: float) -> None:
    """Move the last rows of each photo along their rays to where the sky is, as large as they look."""
    scene = gsmerge.read_scene(folder)
    gaussians, centres = scene.gaussians.numpy(), scene.cameras.centres
    far = np.arange(len(gaussians)).reshape(len(centres), -1)[:, -300:]
    gaussians.means[far] = centres[:, None] + factor * (gaussians.means[far] - centres[:, None])
    gaussians.scales[far] *= factor
    gsmerge.write_ply(folder / "scene.ply", gaussians, overwrite=True)


@pytest.mark.slow
@sweep(
    ("name", "shift", "worse"),
    [("out.ply", 5e6, True), ("out.spz", 0, True), ("out.sog", 1e5, False), ("out.splat", 5e6, True)],
)
def test_score_is_that_of_the_written_file(
    scene_copy: Path, tmp_path: Path, run: Run, name: str, shift: float, worse: bool
) -> None:
    if shift:
        move_scene(scene_copy, shift)
    else:
        set_apart(scene_copy, 1e7)
    out = tmp_path / name
    document = json.loads(run("compact", scene_copy, "-o", out, *DRAFT, *WHOLE, code=4).out)
    run("evaluate", scene_copy, out, "--lpips", "none", "-o", tmp_path / "e.json", code=0)
    *_, result = json.loads((tmp_path / "e.json").read_text())["results"]
    assert document["psnr_input_views"]["after"] == pytest.approx(result["mean"]["context"]["psnr"], abs=0.05)
    assert noted(document["notes"], "lose digits", "--translate=" if shift else "write a .ply")
    assert (document["worse"] is not None) == worse
    if worse:
        run("compact", scene_copy, "-o", out, "--overwrite", *DRAFT, "--strict", code=4)


def test_scene_moved_to_the_origin_as_noted_loses_nothing(scene_copy: Path, tmp_path: Path, run: Run) -> None:
    exact = psnr_of((scene := gsmerge.read_scene(scene_copy)).gaussians, scene)
    move_scene(scene_copy, 5e6)
    near, call = tmp_path / "near.ply", ("convert", scene_copy / "scene.ply")
    cameras = "--cameras", scene_copy / "transforms.json"
    said = run(*call, tmp_path / "far.ply", *cameras, code=0)
    (note,) = [line for line in said.err.splitlines() if "lose digits" in line]
    assert "lose digits" not in run(*call, near, *cameras, note.split()[-1], code=0).err
    scene = gsmerge.read_scene(near, images=scene_copy / "images")
    assert psnr_of(scene.gaussians, scene) == pytest.approx(exact, abs=0.05)
