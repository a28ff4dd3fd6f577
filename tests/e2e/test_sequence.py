"""Moments of one place, each from the result before it: what stands still does not flicker."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from batches import records, statuses

import gsmerge
from gsmerge.io import read_ply
from gsmerge.io.photo_files import read_images
from gsmerge.raster.metrics import psnr
from gsmerge.research.generate import GenerateOptions, generate

MOMENTS = 3
QUICK = ("--effort", "default", "--name", "{parent}-{index}.ply", "--quiet")


@pytest.fixture(scope="module")
def moments(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three moments of a room in 5 views of 96 x 72. Read only."""
    folder = tmp_path_factory.mktemp("sequence") / "walk"
    generate(folder, MOMENTS, GenerateOptions(views=(5, 5), width=96, height=72, style="room", moments=MOMENTS), seed=3)
    return folder


def test_moments_differ_by_a_ball_alone(moments: Path) -> None:
    first, second = (gsmerge.read_scene(moments / f"scene_000{i}") for i in range(2))
    assert np.allclose(first.cameras.viewmats, second.cameras.viewmats, atol=1e-3)  # errors are shares of the depth
    assert first.images is not None
    assert second.images is not None
    moved = np.abs(first.images - second.images).max(-1) > 0.06
    assert 0.01 < moved.mean() < 0.3
    assert np.abs(first.images - second.images)[~moved].max() > 0  # noise of its own
    assert not np.array_equal(first.gaussians.means, second.gaussians.means)


def held_out(moments: Path, results: Path) -> tuple[float, float]:
    """Mean PSNR (dB) of held-out views from the second moment on, and flicker where their photos do not move."""
    scores, differences = [], []
    before: tuple[np.ndarray, np.ndarray] | None = None
    for moment in range(MOMENTS):
        folder = moments / f"scene_000{moment}/targets"
        targets = gsmerge.read_cameras(folder / "transforms.json")
        photos = read_images(folder / "images", targets.names)
        g = read_ply(results / f"walk-{moment}.ply").gaussians
        drawn = gsmerge.render(g, gsmerge.to_cameras(targets)).images.clip(0, 1)
        if before is not None:
            scores += [psnr(image, photo) for image, photo in zip(drawn, photos, strict=True)]
            moving = (np.abs(photos - before[1]).max(-1) > 0.06).astype(np.uint8)
            still = np.stack([cv2.dilate(mask, np.ones((7, 7), np.uint8)) == 0 for mask in moving])
            differences.append(np.square(drawn - before[0])[still].mean())
        before = drawn, photos
    return float(np.mean(scores)), float(np.mean(differences) ** 0.5)


def test_a_sequence_flickers_less_and_is_as_good(moments: Path, tmp_path: Path, run: Any) -> None:
    run("batch", moments, "-o", tmp_path / "alone", "--jobs", 1, *QUICK, code=0)
    run("batch", moments, "-o", tmp_path / "chained", "--sequence", *QUICK, code=0)
    alone, chained = (held_out(moments, tmp_path / name) for name in ("alone", "chained"))
    assert chained[1] < 0.67 * alone[1], (alone, chained)
    assert chained[0] > alone[0] - 0.2, (alone, chained)
    choices = [record["report"]["choices"] for record in records(tmp_path / "chained")]
    assert ["taken_over" in chosen for chosen in choices] == [False, True, True]
    assert all(0 < chosen["flicker"] < 0.05 for chosen in choices[1:])
    assert choices[1]["fit"]["steps"] * 2 == choices[0]["fit"]["steps"]


def test_what_follows_a_change_is_made_again(moments: Path, tmp_path: Path, run: Any) -> None:
    scenes, out = Path(shutil.copytree(moments, tmp_path / "walk")), tmp_path / "out"
    call = ("batch", scenes, "-o", out, "--sequence", *QUICK, "--effort", "draft")
    run(*call, code=0)
    run(*call, code=0)
    assert statuses(out) == {f"walk-{i}.ply": ["done"] for i in range(MOMENTS)}
    shutil.rmtree(scenes / "scene_0001/images")
    shutil.copytree(scenes / "scene_0002/images", scenes / "scene_0001/images")
    assert json.loads(run(*call, "--dry-run", "--json", code=0).out)["num_pending"] == 2
    run(*call, code=0)
    assert statuses(out) == {"walk-0.ply": ["done"], "walk-1.ply": ["done"] * 2, "walk-2.ply": ["done"] * 2}


def test_a_moment_that_cannot_be_read_is_passed_over(moments: Path, tmp_path: Path, run: Any) -> None:
    scenes, out = Path(shutil.copytree(moments, tmp_path / "walk")), tmp_path / "out"
    (scenes / "scene_0001/scene.ply").write_bytes(b"ply\n")
    run("batch", scenes, "-o", out, "--sequence", *QUICK, "--effort", "draft", code=5)
    chosen = {record["output"]: record["report"] for record in records(out)}
    assert chosen["walk-1.ply"] is None
    assert "taken_over" in chosen["walk-2.ply"]["choices"]


def test_a_file_of_others_is_no_result(moments: Path, tmp_path: Path, run: Any) -> None:
    """It stays, its scene fails, and the next scene starts anew."""
    (tmp_path / "walk-0.ply").write_bytes(b"ply\n")
    run("batch", moments, "-o", tmp_path, "--sequence", *QUICK, "--effort", "draft", code=5)
    assert statuses(tmp_path) == {"walk-0.ply": ["failed"], "walk-1.ply": ["done"], "walk-2.ply": ["done"]}
    chosen = [record["report"]["choices"] for record in records(tmp_path)[1:]]
    assert ["taken_over" in choices for choices in chosen] == [False, True]


@pytest.mark.parametrize("wrong", [("--jobs", 2), ("--engine", "ray")])
def test_a_sequence_is_one_after_the_other(moments: Path, tmp_path: Path, run: Any, wrong: tuple[Any, ...]) -> None:
    said = run("batch", moments, "-o", tmp_path, "--sequence", *wrong, code=2).err
    assert "sequence" in said
    assert "one job" in said


def test_compact_goes_on_from_a_result(moments: Path, tmp_path: Path, run: Any) -> None:
    first, second = (moments / f"scene_000{i}" for i in range(2))
    run("compact", first, "-o", tmp_path / "a.ply", "--effort", "draft", "--quiet", code=0)
    call = ("compact", second, "-o", tmp_path / "b.ply", "--earlier", tmp_path / "a.ply", "--effort", "draft")
    run(*call, "--report", tmp_path / "b.json", code=0)
    assert "taken_over" in (tmp_path / "b.json").read_text()
    missing = run("compact", second, "-o", tmp_path / "c.ply", "--earlier", tmp_path / "no.ply", "--dry-run", code=3)
    assert "no.ply" in missing.err
    assert "--up" in run(*call, "--overwrite", "--up=-y", code=2).err
    assert "a.ply" in run("compact", second, "-o", tmp_path / "a.ply", "--earlier", tmp_path / "a.ply", code=2).err
