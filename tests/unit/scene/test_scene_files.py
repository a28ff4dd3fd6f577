from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Any

import pytest
from messages import noted, refuses
from tiny_scene import Tiny, write_colmap_text, write_images, write_transforms

from gsmerge.errors import SceneError
from gsmerge.io import write_ply
from gsmerge.io.scene_files import find_scene_files


def make(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"\0")
    return folder


def test_cameras_and_photos_above_the_scene_up_to_the_named_folder(tmp_path: Path, tiny: Tiny) -> None:
    top, run = tmp_path / "captures", tmp_path / "captures/room/run 1"
    run.mkdir(parents=True)
    write_ply(run / "scene.ply", tiny.gaussians)
    write_transforms(tmp_path / "transforms.json", tiny)
    write_images(tmp_path / "images", tiny)
    for files in (find_scene_files(top), find_scene_files(run / "scene.ply", within=top)):
        assert (files.cameras, files.images) == (None, None)  # they lie above what was named
    write_transforms(top / "room/transforms.json", tiny)
    write_images(top / "images", tiny)
    for files in (find_scene_files(top), find_scene_files(run / "scene.ply", within=top)):
        assert (files.cameras, files.images) == (top / "room/transforms.json", top / "images")
    assert find_scene_files(run / "scene.ply").images is None
    write_images(top / "images/run 1", tiny)
    assert find_scene_files(top).images == top / "images/run 1"  # beside the photos of other scenes


def test_a_trained_model_s_folders(tmp_path: Path, tiny: Tiny) -> None:
    make(tmp_path, "point_cloud/iteration_7000/point_cloud.ply", "point_cloud/iteration_30000/point_cloud.ply")
    make(tmp_path, "input.ply", "cameras.json")
    actual = find_scene_files(tmp_path)
    assert actual.ply == tmp_path / "point_cloud/iteration_30000/point_cloud.ply"
    assert actual.cameras == tmp_path / "cameras.json"
    assert find_scene_files(actual.ply).cameras == tmp_path / "cameras.json"


def test_which_ply_of_a_folder(tmp_path: Path) -> None:
    make(tmp_path, "room.ply", "room.compact.ply", "points3D.ply", ".room-12.ply")
    assert find_scene_files(tmp_path).ply == tmp_path / "room.ply"
    make(tmp_path, "hall.ply")
    with refuses(SceneError, tmp_path, "2 (hall.ply, room.ply)"):
        find_scene_files(tmp_path)
    make(tmp_path, "gaussians.ply")
    assert find_scene_files(tmp_path).ply == tmp_path / "gaussians.ply"
    make(tmp_path, "scene.ply")
    assert find_scene_files(tmp_path).ply == tmp_path / "scene.ply"


def test_named_files_go_first(tiny_folder: Path, tmp_path: Path, tiny: Tiny) -> None:
    write_colmap_text(tmp_path / "other", tiny)
    write_images(tmp_path / "photos", tiny)
    actual = find_scene_files(tiny_folder, cameras=tmp_path / "other", images=str(tmp_path / "photos"))
    assert actual.cameras == tmp_path / "other"
    assert actual.images == tmp_path / "photos"


def test_image_folders_in_order(tmp_path: Path, tiny: Tiny) -> None:
    make(tmp_path, "scene.ply", "rgb/1.png", "context/1.png", "images/readme.txt")
    assert find_scene_files(tmp_path).images == tmp_path / "context"
    make(tmp_path, "input/1.jpg")
    assert find_scene_files(tmp_path).images == tmp_path / "input"
    make(tmp_path, "images/deep/1.JPG")
    assert find_scene_files(tmp_path).images == tmp_path / "images"


def test_photos_of_a_scene_in_a_folder_of_photos(tmp_path: Path, tiny: Tiny) -> None:
    """A folder called ``rgb`` with Gaussians and a folder of photos is a scene of its own."""
    write_ply(make(tmp_path, "rgb/images/1.png") / "x.ply", tiny.gaussians)
    assert find_scene_files(tmp_path / "x.ply").images == tmp_path / "rgb"
    write_ply(tmp_path / "rgb/scene.ply", tiny.gaussians)
    assert find_scene_files(tmp_path / "x.ply").images is None
    assert find_scene_files(tmp_path / "rgb").images == tmp_path / "rgb/images"
    make(tmp_path, "rgb/1.png")  # AnySplat writes its Gaussians among the photos
    assert find_scene_files(tmp_path / "x.ply").images == tmp_path / "rgb"


@pytest.mark.parametrize("folder", ["color", "corrected_images", "keyframes/corrected_images", "keyframes/images"])
def test_image_folders_of_other_programs(tmp_path: Path, folder: str) -> None:
    make(tmp_path, "scene.ply", f"{folder}/1.png")
    assert find_scene_files(tmp_path).images == tmp_path / folder


def test_blender_s_training_views(tmp_path: Path, tiny: Tiny) -> None:
    make(tmp_path, "scene.ply")
    for part in ("train", "test", "val"):
        write_transforms(tmp_path / f"transforms_{part}.json", tiny)
    assert find_scene_files(tmp_path).cameras == tmp_path / "transforms_train.json"


def test_what_is_not_there(tmp_path: Path, tiny: Tiny) -> None:
    with refuses(SceneError, "none.ply", "no such"):
        find_scene_files(tmp_path / "none.ply")
    with refuses(SceneError, tmp_path, ".ply", "none"):
        find_scene_files(tmp_path)
    make(tmp_path, "scene.ply")
    assert find_scene_files(tmp_path).cameras is None
    assert find_scene_files(tmp_path).images is None
    with refuses(SceneError, "lost.json", "no such"):
        find_scene_files(tmp_path, cameras=tmp_path / "lost.json")
    with refuses(SceneError, "photos", "no such"):
        find_scene_files(tmp_path, images=tmp_path / "photos")


def test_a_broken_npz_is_no_source_of_images(tmp_path: Path, tiny: Tiny) -> None:
    make(tmp_path, "scene.ply", "results.npz")
    assert find_scene_files(tmp_path).cameras == tmp_path / "results.npz"
    assert find_scene_files(tmp_path).images is None


def test_files_beside_a_relative_path(tiny_folder: Path, monkeypatch: pytest.MonkeyPatch, tiny: Tiny) -> None:
    monkeypatch.chdir(tiny_folder)
    write_transforms(tiny_folder / "transforms.json", tiny)
    actual = find_scene_files("scene.ply")
    assert actual.ply == Path("scene.ply")
    assert actual.cameras == tiny_folder.resolve() / "transforms.json"


def test_what_lies_one_folder_above_is_named_and_not_read(tmp_path: Path, tiny: Tiny) -> None:
    (run := tmp_path / "room/run").mkdir(parents=True)
    write_ply(run / "x.ply", tiny.gaussians)
    write_transforms(cameras := tmp_path / "room/transforms.json", tiny)
    write_images(images := tmp_path / "room/images", tiny)
    for path in (run, run / "x.ply"):
        files = find_scene_files(path)
        assert (files.cameras, files.images) == (None, None)
        options = shlex.join(["--images", f"{images}", "--cameras", f"{cameras}"])
        words = "are not read; to read them, pass"
        assert files.notes == (f"photos and cameras outside the scene's folder {words} {options}",)
    assert find_scene_files(tmp_path / "room").notes == find_scene_files(run, cameras="none", images="none").notes == ()


def test_files_of_a_neighbouring_folder(tmp_path: Path, tiny: Tiny) -> None:
    """Cameras alone are offered; those beside other Gaussians belong to them."""
    (run := tmp_path / "run").mkdir()
    write_ply(run / "x.ply", tiny.gaussians)
    cameras = tmp_path / "opensfm/reconstruction.json"
    make(tmp_path, "opensfm/reconstruction.json")
    assert noted(find_scene_files(run).notes, "cameras", "--cameras", cameras)
    assert not noted(find_scene_files(run).notes, "--images")
    write_ply(cameras.with_name("scene.ply"), tiny.gaussians)  # they belong to that scene
    assert find_scene_files(run).notes == ()


def test_a_folder_without_the_right_to_read_is_named(
    tiny_folder: Path, tiny: Tiny, monkeypatch: pytest.MonkeyPatch
) -> None:
    scandir, closed = os.scandir, tiny_folder / "images"

    def refuse(path: Any = ".") -> Any:
        if Path(path).is_relative_to(closed):
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refuse)
    with refuses(SceneError, closed, "Permission denied", "--images none"):
        find_scene_files(tiny_folder)
    assert find_scene_files(tiny_folder, images="none").images is None
