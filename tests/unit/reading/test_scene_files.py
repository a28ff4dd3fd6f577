"""The files of a scene are found beside it by their names."""

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
from gsmerge.reading.scene_files import find_scene_files


def make(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"\0")
    return folder


def test_cameras_and_photos_are_found_up_to_the_named_folder(tmp_path: Path, tiny: Tiny) -> None:
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


def test_last_step_of_a_trained_model_is_the_scene(tmp_path: Path, tiny: Tiny) -> None:
    make(tmp_path, "point_cloud/iteration_7000/point_cloud.ply", "point_cloud/iteration_30000/point_cloud.ply")
    make(tmp_path, "input.ply", "cameras.json")
    actual = find_scene_files(tmp_path)
    assert actual.ply == tmp_path / "point_cloud/iteration_30000/point_cloud.ply"
    assert actual.cameras == tmp_path / "cameras.json"
    assert find_scene_files(actual.ply).cameras == tmp_path / "cameras.json"


def test_scene_of_a_folder_is_its_only_ply_or_that_of_a_usual_name(tmp_path: Path) -> None:
    make(tmp_path, "room.ply", "room.compact.ply", "points3D.ply", ".room-12.ply")
    assert find_scene_files(tmp_path).ply == tmp_path / "room.ply"
    make(tmp_path, "hall.ply")
    with refuses(SceneError, tmp_path, "2 (hall.ply, room.ply)"):
        find_scene_files(tmp_path)
    make(tmp_path, "gaussians.ply")
    assert find_scene_files(tmp_path).ply == tmp_path / "gaussians.ply"
    make(tmp_path, "scene.ply")
    assert find_scene_files(tmp_path).ply == tmp_path / "scene.ply"


def test_named_cameras_and_photos_go_before_found_ones(tiny_folder: Path, tmp_path: Path, tiny: Tiny) -> None:
    write_colmap_text(tmp_path / "other", tiny)
    write_images(tmp_path / "photos", tiny)
    actual = find_scene_files(tiny_folder, cameras=tmp_path / "other", images=str(tmp_path / "photos"))
    assert actual.cameras == tmp_path / "other"
    assert actual.images == tmp_path / "photos"


def test_folders_of_images_are_preferred_in_order(tmp_path: Path, tiny: Tiny) -> None:
    make(tmp_path, "scene.ply", "rgb/1.png", "context/1.png", "images/readme.txt")
    assert find_scene_files(tmp_path).images == tmp_path / "context"
    make(tmp_path, "input/1.jpg")
    assert find_scene_files(tmp_path).images == tmp_path / "input"
    make(tmp_path, "images/deep/1.JPG")
    assert find_scene_files(tmp_path).images == tmp_path / "images"


LAYOUTS = {  # files of Gaussians, pictures and cameras -> the scene, and where its cameras, photos and masks lie
    "masks of its own": ("a/scene.ply a/images/1.png a/masks/1.png", "a", None, "a/images", "a/masks"),
    "beside a folder of masks": ("a/scene.ply a/images/1.png masks/1.png", "a", None, "a/images", None),
    "below a folder of masks": ("b/a/scene.ply b/a/images/1.png masks/1.png", "b/a", None, "b/a/images", None),
    "beside a scene called masks": ("a.ply images/1.png masks/scene.ply masks/1.png", "a.ply", None, "images", None),
    "beside scenes in masks": ("a.ply images/1.png masks/b/c.ply masks/b/1.png", "a.ply", None, "images", None),
    "beside a result of masks": ("a.ply images/1.png masks/gaussians/b.ply masks/1.png", "a.ply", None, "images", None),
    "beside a scene called images": ("a/scene.ply images/scene.ply images/1.png", "a", None, None, None),
    "beside scenes in input": ("a/scene.ply input/b/scene.ply input/b/1.png", "a", None, None, None),
    "beside a scene called rgb": ("a.ply rgb/scene.ply rgb/images/1.png", "a.ply", None, None, None),
    "beside Gaussians among photos": ("a.ply rgb/b.ply rgb/1.png", "a.ply", None, None, None),
    "its Gaussians among photos": ("a/images/b.ply a/images/1.png a/masks/1.png", "a", None, "a/images", "a/masks"),
    "photos of its own, shared masks": ("a.ply images/a/1.png masks/1.png", "a.ply", None, "images/a", "masks"),
    "photos among those of masks": (
        "a.ply masks.ply images/a/1.png images/masks/1.png",
        "a.ply",
        None,
        "images/a",
        None,
    ),
    "pictures of its own": ("a.ply b.ply images/a/1.png masks/a/1.png", "a.ply", None, "images/a", "masks/a"),
    "shared photos": ("a/scene.ply images/1.png masks/1.png", "a", None, "images", "masks"),
    "shared cameras": ("a/scene.ply b.ply cameras.json", "a", "cameras.json", None, None),
    "beside cameras of a scene": ("a/scene.ply opensfm/b.ply opensfm/reconstruction.json", "a", None, None, None),
    "beside cameras in a scene": ("a/scene.ply exports/b.ply exports/npz/results.npz", "a", None, None, None),
    "in a scene": ("a/scene.ply a/cameras.json a/images/1.png a/b/scene.ply", "a/b", None, None, None),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_scene_among_many_has_its_own_files(tmp_path: Path, layout: str) -> None:
    """Masks lie beside its photos or in its folder; no file of another scene is its own."""
    files, scene, *places = LAYOUTS[layout]
    make(tmp_path, *files.split())
    found = find_scene_files(tmp_path / scene, within=tmp_path)
    expected = [None if place is None else tmp_path / place for place in places]
    assert [found.cameras, found.images, found.masks] == expected


def test_masks_above_the_scene_are_named_if_they_have_its_names(tmp_path: Path) -> None:
    make(tmp_path, "a/scene.ply", "a/images/1.png", "b/scene.ply", "b/images/2.png", "masks/1.png")
    assert noted(find_scene_files(tmp_path / "a", within=tmp_path).notes, f"--masks {tmp_path}/masks")
    assert noted(find_scene_files(tmp_path / "a/scene.ply").notes, f"--masks {tmp_path}/masks")
    others = find_scene_files(tmp_path / "b"), find_scene_files(tmp_path / "a", masks="none")
    assert [files.notes for files in others] == [(), ()]


def test_masks_beside_photos_that_are_named(tmp_path: Path) -> None:
    make(tmp_path, "a/scene.ply", "b/photos/1.png", "b/masks/1.png")
    assert find_scene_files(tmp_path / "a", images=tmp_path / "b/photos").masks == tmp_path / "b/masks"
    assert find_scene_files(tmp_path / "a", images="none").masks is None


def test_masks_beside_the_file_to_which_a_link_leads(tmp_path: Path) -> None:
    """They are the scene's where its photos lie there."""
    make(tmp_path, "all/a.ply", "all/b.ply", "all/masks/1.png", "a/masks/2.png")
    (link := tmp_path / "a/scene.ply").symlink_to(tmp_path / "all/a.ply")
    assert find_scene_files(link).masks == tmp_path / "a/masks"
    make(tmp_path, "all/images/1.png")
    assert find_scene_files(link).masks == tmp_path / "all/masks"


@pytest.mark.parametrize("folder", ["color", "corrected_images", "keyframes/corrected_images", "keyframes/images"])
def test_folders_of_images_of_other_programs_are_found(tmp_path: Path, folder: str) -> None:
    make(tmp_path, "scene.ply", f"{folder}/1.png")
    assert find_scene_files(tmp_path).images == tmp_path / folder


def test_cameras_of_blender_are_those_of_training(tmp_path: Path, tiny: Tiny) -> None:
    make(tmp_path, "scene.ply")
    for part in ("train", "test", "val"):
        write_transforms(tmp_path / f"transforms_{part}.json", tiny)
    assert find_scene_files(tmp_path).cameras == tmp_path / "transforms_train.json"


def test_missing_files_that_are_named_are_refused(tmp_path: Path, tiny: Tiny) -> None:
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


def test_cameras_beside_a_relative_path_are_found(
    tiny_folder: Path, monkeypatch: pytest.MonkeyPatch, tiny: Tiny
) -> None:
    monkeypatch.chdir(tiny_folder)
    write_transforms(tiny_folder / "transforms.json", tiny)
    actual = find_scene_files("scene.ply")
    assert actual.ply == Path("scene.ply")
    assert actual.cameras == tiny_folder.resolve() / "transforms.json"


def test_cameras_and_photos_one_folder_above_are_offered_unread(tmp_path: Path, tiny: Tiny) -> None:
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


def test_cameras_in_a_neighbouring_folder_are_offered(tmp_path: Path, tiny: Tiny) -> None:
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
