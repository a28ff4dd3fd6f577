"""`render --path`: videos and frames along a path, of one scene or several side by side."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from bare_files import write_without_grid
from messages import ERROR, names, says
from sweeps import sweep
from tiny_scene import edited_json

import gsmerge

from .conftest import Run, assert_refused, listing

WIDTH, HEIGHT = 96, 64
SCALE = 1.8  # of the cameras' world to that of the Gaussians


def read(path: Path) -> list[np.ndarray]:
    reader, pictures = cv2.VideoCapture(str(path)), []
    while (step := reader.read())[0]:
        pictures.append(step[1].astype(float))
    return pictures


def error(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one.astype(float) - other).mean())


@sweep(("kind", "name"), [("orbit", "walk.mp4"), ("orbit:45", "a.mp4"), ("spline", "walk.webm")])
def test_a_video_shows_the_frames_of_its_path(kind: str, name: str, made_scene: Path, tmp_path: Path, run: Run) -> None:
    call = ("render", made_scene, "--path", kind, "--frames", 8)
    outcome = run(*call, "-o", tmp_path / name, "--fps", 4, code=0)
    assert says(outcome.err.splitlines()[-1], tmp_path / name, "8 frames", f"{WIDTH} x {HEIGHT}", "2.0 s")
    run(*call, "-o", tmp_path / "frames", "--threads", 1, code=0)
    run(*call, "-o", tmp_path / "again", "--threads", 2, code=0)
    assert list(listing(tmp_path / "frames")) == [f"frame_{i:05d}.png" for i in range(8)]
    for path in (tmp_path / "frames").iterdir():
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()
    drawn = [cv2.imread(str(path)) for path in sorted((tmp_path / "frames").iterdir())]
    shown = read(tmp_path / name)
    assert [picture.shape for picture in shown] == [(HEIGHT, WIDTH, 3)] * 8
    assert max(error(a, b) for a, b in zip(drawn, shown, strict=True)) < 12
    assert min(error(a, b) for a, b in zip(drawn[1:], drawn, strict=False)) > 0


def test_a_spline_starts_and_ends_at_the_photos(made_scene: Path, tmp_path: Path, run: Run) -> None:
    run("render", made_scene, "--path", "spline", "--frames", 5, "-o", tmp_path / "out", code=0)
    photos = [cv2.imread(str(path)) for path in sorted((made_scene / "images").iterdir())]
    for frame, photo in ((0, 0), (4, -1)):
        drawn = cv2.imread(str(tmp_path / "out" / f"frame_{frame:05d}.png"))
        errors = [error(drawn, one) for one in photos]
        assert errors[photo] == min(errors) < 20


def test_a_folder_may_have_the_name_of_a_path(
    made_scene: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run("render", made_scene, "--path", "orbit", "--frames", 2, "-o", "orbit", code=0)
    assert list(listing(tmp_path / "orbit")) == ["frame_00000.png", "frame_00001.png"]


def test_scenes_are_side_by_side(scene_copy: Path, tmp_path: Path, run: Run) -> None:
    scene = scene_copy / "scene.ply"
    shutil.copy(scene, tmp_path / "small.ply")
    video = tmp_path / "both.mp4"
    document = json.loads(
        run("render", scene, tmp_path / "small.ply", "--path", "orbit", "--frames", 3, "-o", video, "--json").out
    )
    assert document["scenes"] == {str(scene): 30720, str(tmp_path / "small.ply"): 30720}
    assert (document["frames"], document["fps"], document["pictures"]) == (3, 30, [str(video)])
    for picture in read(video):
        half = picture.shape[1] // 2 - 2
        assert half >= 320
        assert error(picture[22:, :half], picture[22:, half + 4 :]) < 3
        assert picture[22:].std() > 10


def test_the_path_of_a_file_is_placed_as_held_out_views_are(scene_copy: Path, tmp_path: Path, run: Run) -> None:
    """The cameras of the scene, and those of the path in their world, are in larger units than the Gaussians."""
    targets = tmp_path / "targets"
    shutil.move(scene_copy / "targets", targets)
    for path in (scene_copy / "transforms.json", targets / "transforms.json"):
        with edited_json(path) as data:
            for frame in data["frames"]:
                for row in frame["transform_matrix"][:3]:
                    row[3] *= SCALE
    run("render", scene_copy, "--path", targets / "transforms.json", "-o", tmp_path / "out", code=0)
    photos = [cv2.imread(str(path)) for path in sorted((targets / "images").iterdir())]
    drawn = [cv2.imread(str(path)) for path in sorted((tmp_path / "out").iterdir())]
    assert len(drawn) == len(photos) > 2
    for i, picture in enumerate(drawn):
        errors = [error(picture, photo) for photo in photos]
        assert errors[i] == min(errors) < 20
    some = run("render", scene_copy, "--path", targets, "--views", 2, "-o", tmp_path / "x.mp4", "--dry-run", code=0)
    assert names(some.out, "x.mp4", "2 frames", f"{WIDTH} x {HEIGHT}", "0.1 s")


def test_a_scene_without_cameras_takes_those_of_the_path(scene_copy: Path, tmp_path: Path, run: Run) -> None:
    bare = write_without_grid(scene_copy / "scene.ply", tmp_path / "away" / "bare.ply")
    out = tmp_path / "out.mp4"
    run("render", bare, "--path", scene_copy / "transforms.json", "-o", out, code=0)
    assert len(read(out)) == 5
    made = run("render", bare, "--path", "orbit", "--frames", 2, "-o", tmp_path / "x.mp4", code=0)
    assert "no cameras: " in made.err  # about the views that are placed
    assert len(read(tmp_path / "x.mp4")) == 2


def test_frames_too_large_for_a_video_go_to_a_folder(made_scene: Path, tmp_path: Path, run: Run) -> None:
    shutil.copy(made_scene / "transforms.json", tmp_path / "path.json")
    with edited_json(tmp_path / "path.json") as data:
        data["w"], data["h"] = 4096, 4096
    call = ("render", made_scene, "--path", tmp_path / "path.json", "--dry-run")
    outcome = run(*call, "-o", tmp_path / "a.mp4", code=3)
    assert says(outcome.err.removeprefix(ERROR), tmp_path / "a.mp4", "8,388,608", "4096 x 4096", "folder")
    run(*call, "-o", tmp_path / "out", code=0)


def test_one_camera_has_an_orbit_but_no_spline(made_scene: Path, tmp_path: Path, run: Run) -> None:
    call = ("render", made_scene, "--views", 1, "--frames", 2, "-o", tmp_path / "a.mp4")
    assert_refused(run(*call, "--path", "spline"), 2, "spline", 2, 1)
    assert not (tmp_path / "a.mp4").exists()
    run(*call, "--path", "orbit", code=0)
    assert len(read(tmp_path / "a.mp4")) == 2


def test_frames_grow_with_the_views_of_a_spline(
    made_scene: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsmerge.measure.drawings.PATH_FRAMES", 12)
    for kind, count in (("spline,back:0.5", 20), ("orbit", 12)):
        outcome = run("render", made_scene, "--path", kind, "-o", tmp_path / "x", "--dry-run", "--json", code=0)
        assert json.loads(outcome.out)["frames"] == count


@pytest.mark.parametrize("kind", ["orbit", "spline"])
def test_a_small_world_is_drawn_as_a_large_one(kind: str, scene_copy: Path, tmp_path: Path, run: Run) -> None:
    """Nothing near is cut off where a unit is large: what is nearest lies 2 % of one away here."""
    small = shutil.copytree(scene_copy, tmp_path / "small")
    gaussians = gsmerge.read_ply(small / "scene.ply").gaussians
    shrunk = replace(gaussians, means=gaussians.means / 256, scales=gaussians.scales / 256)
    gsmerge.write_ply(small / "scene.ply", shrunk, overwrite=True)
    with edited_json(small / "transforms.json") as data:
        for frame in data["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] /= 256
    for scene in (scene_copy, small):
        run("render", scene, "--path", kind, "--frames", 3, "-o", tmp_path / f"{scene.name} out", code=0)
    for path in sorted((tmp_path / "scene out").iterdir()):
        picture = cv2.imread(str(path))
        assert picture.std() > 10
        assert error(picture, cv2.imread(str(tmp_path / "small out" / path.name))) < 0.1
