"""`render` and `preview` look from where `compact` does: the cameras may be in another world than the Gaussians."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from messages import names, noted
from shared import write_small
from tiny_scene import edited_json

from gsmerge.kernels import elementary

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
