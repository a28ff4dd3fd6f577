"""The files of a scene are found beside it by their names, and by what they hold."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from exports import export_rows, save_export, smooth_scene
from messages import names, noted, refuses
from tiny_scene import Tiny, rotation, write_colmap_binary, write_colmap_text, write_images, write_transforms

from gsmerge.drawing.preview import save_picture
from gsmerge.errors import SceneError
from gsmerge.io import write_ply
from gsmerge.jobs.inspect import inspect
from gsmerge.reading.read_scene import Loaded, load_scene
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
    assert find_scene_files(tmp_path / "point_cloud").ply == actual.ply


@pytest.mark.parametrize(
    ("files", "scene"),
    [
        ("export_5000 export_10000 export_30000", "export_30000"), ("step-000009999 step-000029999", "step-000029999"),
        ("iter_7000 iter_30000 room.compact", "iter_30000"), ("bicycle_7000 bicycle_30000", "bicycle_30000"),
        ("garden_7k garden_30k", "garden_30k"),
        ("ckpt_100 ckpt_200 ckpt_273", "ckpt_273"), ("ckpt_100 ckpt_500 ckpt_612", "ckpt_612"),
        ("export_0 export_1 export_2", None), ("tile_100 tile_300", None), ("frame_1000 frame_2000", None),
        ("splat_100 splat_101", None), ("0000 1000", None), ("room_100 room_200", None), ("export_100 room", None),
        ("a_1000 b_2000", None), ("export_5000 export_10000 room", None),
    ],
)  # fmt: skip
@pytest.mark.parametrize("ending", [".ply", ".splat"])
def test_last_of_several_exports_of_a_training_is_the_scene(
    tmp_path: Path, files: str, scene: str | None, ending: str
) -> None:
    """Moments, parts and several scenes are none of a training."""
    for name in files.split():
        (tmp_path / f"{name}{ending}").write_bytes(b"\0" + name.encode())  # equal files would be copies
    if scene is None or ("compact" in files and ending != ".ply"):
        with pytest.raises(SceneError):
            find_scene_files(tmp_path)
        return
    found = find_scene_files(tmp_path)
    assert found.plys == (tmp_path / f"{scene}{ending}",)
    count = sum("_" in name or "-" in name for name in files.split())
    assert noted(found.notes, f"{scene}{ending}", f"{count} steps")


def test_exports_of_a_training_are_not_joined_where_photos_are_as_many(tmp_path: Path, tiny: Tiny) -> None:
    for step in (5000, 10000, 15000):
        write_ply(tmp_path / f"export_{step}.ply", tiny.gaussians[: step // 30])
    write_transforms(tmp_path / "transforms.json", tiny)
    assert find_scene_files(tmp_path).plys == (tmp_path / "export_15000.ply",)


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


def test_masks_beside_photos_that_are_named_are_found(tmp_path: Path) -> None:
    make(tmp_path, "a/scene.ply", "b/photos/1.png", "b/masks/1.png")
    assert find_scene_files(tmp_path / "a", images=tmp_path / "b/photos").masks == tmp_path / "b/masks"
    assert find_scene_files(tmp_path / "a", images="none").masks is None


def test_masks_beside_the_file_to_which_a_link_leads_are_found(tmp_path: Path) -> None:
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


SMOOTH = smooth_scene(56, 40)
SOME = np.random.default_rng(0).permutation(np.arange(len(SMOOTH.gaussians)))[:4027]
VOXELS = SOME[np.lexsort(SMOOTH.gaussians.means[SOME].round(1).T)]
ROWS = {"grid": np.arange(len(SMOOTH.gaussians)), "voxels": VOXELS}


def some(views: Sequence[int], scene: Tiny = SMOOTH) -> Tiny:
    views = list(views)
    return replace(scene, c2w=scene.c2w[views], images=scene.images[views], names=tuple(scene.names[i] for i in views))


def astray(count: int) -> Tiny:
    """Return more cameras than photos, at random places."""
    c2w = np.tile(np.eye(4), (count, 1, 1))
    for pose, numbers in zip(c2w, np.random.default_rng(1).uniform(-1, 1, (count, 6)), strict=True):
        pose[:3, :3], pose[:3, 3] = rotation(*3 * numbers[:3]), 9 * numbers[3:]
    return replace(SMOOTH, c2w=c2w, names=(*SMOOTH.names, *(f"more/{i}.png" for i in range(3, count))))


def dark() -> Tiny:
    return replace(SMOOTH, images=np.random.default_rng(0).integers(0, 256, SMOOTH.images.shape, np.uint8))


def resized(scale: float) -> Tiny:
    size = round(56 * scale), round(40 * scale)
    return replace(SMOOTH, images=np.stack([cv2.resize(image, size) for image in SMOOTH.images]))


def flat(scene: Tiny = SMOOTH) -> Tiny:
    """Return photos and cameras without folders in their names."""
    return replace(scene, names=tuple(Path(name).name for name in scene.names))


def two_models(folder: Path) -> None:
    write_images(folder / "images", SMOOTH)
    write_colmap_text(folder / "sparse/0", some([0, 1]))
    write_colmap_binary(folder / "sparse/1", SMOOTH)


def large_astray(folder: Path) -> None:
    write_images(folder / "images", SMOOTH)
    write_colmap_binary(folder / "colmap/sparse/0", astray(6))
    write_colmap_binary(folder / "colmap/sparse/1", some([0, 1]))


def damaged_first(folder: Path) -> None:
    two_models(folder)
    write_colmap_binary(folder / "sparse/0", SMOOTH)
    (folder / "sparse/0/images.bin").write_bytes(b"\xff" * 64)


def astray_transforms(folder: Path) -> None:
    write_images(folder / "images", SMOOTH)
    write_transforms(folder / "transforms.json", replace(astray(3), images=SMOOTH.images))
    write_colmap_text(folder / "distorted/sparse/0", SMOOTH)


def of_camera(folder: Path) -> None:
    write_images(folder / "DCIM/100CANON", flat())
    write_colmap_text(folder / "sparse/0", flat())


def several_folders(folder: Path) -> None:
    for name, scene in (("a", resized(0.5)), ("undistorted", SMOOTH), ("z", resized(1.5)), ("masks", dark())):
        write_images(folder / name, flat(scene))
    grey = np.repeat(SMOOTH.images.mean(-1, keepdims=True).astype(np.uint8), 3, -1)
    write_images(folder / "depth", flat(replace(SMOOTH, images=grey)))
    write_colmap_text(folder / "sparse/0", flat())


def other_places(folder: Path) -> None:
    """Write photos of another scene, and those of other names in the usual place."""
    write_images(folder / "images", replace(dark(), names=("x.png", "y.png", "z.png")))
    write_images(folder / "another/images", flat(dark()))
    write_ply(folder / "another/scene.ply", SMOOTH.gaussians)
    write_images(folder / "frames", flat())
    write_colmap_text(folder / "sparse/0", flat())


def below(folder: Path) -> None:
    write_images(folder / "COLMAP/images", flat())
    write_colmap_text(folder / "COLMAP/sparse/0", flat())


def below_astray(folder: Path) -> None:
    below(folder)
    write_images(folder / "COLMAP/images", flat(dark()))
    write_colmap_text(folder / "COLMAP/sparse/0", flat(astray(3)))


def load(tmp_path: Path, kind: str, make: Callable[[Path], None]) -> Loaded:
    make(save_export(tmp_path, SMOOTH, export_rows(SMOOTH, ROWS[kind]), cameras=False))
    return load_scene(tmp_path)


@pytest.mark.parametrize("kind", ROWS)
@pytest.mark.parametrize(
    ("make", "cameras", "images", "said"),
    [
        (two_models, "sparse/1", "images", ("sparse/1 (3 images)", "sparse/0 (2 images)", "--cameras")),
        (damaged_first, "sparse/1", "images", ("sparse/1 (3 images)", "sparse/0;")),
        (of_camera, "sparse/0", "DCIM/100CANON", ("100CANON", "names of the cameras")),
        (several_folders, "sparse/0", "undistorted", ("undistorted", "names of the cameras")),
        (other_places, "sparse/0", "frames", ("frames", "names of the cameras")),
        (below, "COLMAP/sparse/0", "COLMAP/images", ("COLMAP/sparse/0 (3 images)", "--cameras")),
    ],
)
def test_cameras_and_photos_in_odd_places_are_found_with_a_note(
    tmp_path: Path, kind: str, make: Callable[[Path], None], cameras: str, images: str, said: tuple[str, ...]
) -> None:
    loaded = load(tmp_path, kind, make)
    assert (loaded.files.cameras, loaded.files.images) == (tmp_path / cameras, tmp_path / images)
    assert len(loaded.scene.photo_views) == 3
    assert np.abs(np.asarray(loaded.scene.images) - SMOOTH.images / 255).max() < 0.01
    assert noted(loaded.notes, *said)
    described = inspect(tmp_path)
    assert (described["cameras"], described["images"]) == (str(tmp_path / cameras), str(tmp_path / images))
    assert noted(described["notes"], *said)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "cameras", "other"),
    [(large_astray, "colmap/sparse/1", "colmap/sparse/0 (6"), (astray_transforms, "distorted/sparse/0", "transforms")],
)
def test_cameras_that_fit_precede_those_that_do_not(
    tmp_path: Path, make: Callable[[Path], None], cameras: str, other: str
) -> None:
    loaded = load(tmp_path, "voxels", make)
    assert loaded.files.cameras == tmp_path / cameras
    assert noted(loaded.notes, f"read from {cameras}", other)


@pytest.mark.slow
def test_cameras_below_that_no_photo_confirms_are_named(tmp_path: Path) -> None:
    loaded = load(tmp_path, "voxels", below_astray)
    assert loaded.files.cameras is None
    assert len(loaded.scene) == 0
    assert noted(loaded.notes, "no photo shows", f"--cameras {tmp_path}/COLMAP/sparse/0")
    write_colmap_text(tmp_path / "another/sparse/0", flat())
    assert noted(load_scene(tmp_path).notes, "several folders", f"--cameras {tmp_path}/COLMAP/sparse/0")


def test_model_in_its_usual_place_gets_no_note(tmp_path: Path) -> None:
    def one(folder: Path) -> None:
        write_images(folder / "images", SMOOTH)
        write_colmap_binary(folder / "sparse/0", SMOOTH)
        write_colmap_binary(folder / "distorted/sparse/0", astray(6))

    assert not noted(load(tmp_path, "voxels", one).notes, "read from")


def mask_paths(folder: Path, paths: Sequence[object], *, size: tuple[int, int] = (56, 40), shared: str = "") -> Path:
    """Write masks that leave out the upper quarter, in a folder of any name; return the scene's folder."""
    save_export(folder, SMOOTH, export_rows(SMOOTH, ROWS["grid"]))
    picture = np.full(size[::-1], 255, np.uint8)
    picture[: size[1] // 4] = 0
    (folder / "cut").mkdir()
    for i in range(3):
        cv2.imwrite(str(folder / f"cut/{i}.png"), picture)
    document = json.loads((folder / "transforms.json").read_text())
    for frame, path in zip(document["frames"], paths, strict=False):
        frame["mask_path"] = path
    if shared:
        document["mask_path"] = shared
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


@pytest.mark.parametrize(
    ("paths", "changes", "shares", "said"),
    [
        (["cut/0.png", "./cut/1", "cut/2.png"], {}, [0.25] * 3, ("in 3 of 3 photos",)),
        (["cut/0.png"], {}, [0.25, 0, 0], ("1 of 3 photos",)),
        (["cut/0.png", "gone/1.png"], {}, [0.25, 0, 0], ("1 of 3 masks", "transforms.json", "gone/1.png", "--masks")),
        ([], {"shared": "cut/0.png"}, [0.25] * 3, ("3 of 3 photos",)),
        (["cut/0.png"] * 3, {"size": (112, 80)}, [0.25] * 3, ("3 of 3 photos",)),
        (["cut/0.png"] * 3, {"size": (40, 40)}, None, ("cut/0.png", "aspect ratio", "left out")),
        ([5, ["a"], "../../x.png"], {}, None, ("masks", "transforms.json", "--masks")),
    ],
)
def test_masks_that_the_cameras_name_are_used(
    tmp_path: Path, paths: list[object], changes: dict, shares: list[float] | None, said: tuple[str, ...]
) -> None:
    folder = mask_paths(tmp_path / "scene", paths, **changes)
    loaded = load_scene(folder)
    assert noted(loaded.notes, *said)
    masks = loaded.scene.masks
    assert (None if masks is None else (1 - masks.mean((1, 2))).tolist()) == (shares and pytest.approx(shares))
    assert load_scene(folder, masks="none").scene.masks is None


def test_masks_that_leave_out_all_are_not_used(tmp_path: Path) -> None:
    folder = mask_paths(tmp_path / "scene", ["cut/0.png"] * 3)
    cv2.imwrite(str(folder / "cut/0.png"), np.zeros((40, 56), np.uint8))
    loaded = load_scene(folder)
    assert loaded.scene.masks is None
    (note,) = (text for text in loaded.notes if "masks" in text)
    assert names(note, "bright", "--masks")


def test_pictures_that_gsmerge_drew_are_no_photos(tmp_path: Path) -> None:
    """Renders have the names of the cameras, whose photos they are not."""
    save_export(tmp_path, SMOOTH, export_rows(SMOOTH, ROWS["voxels"]), cameras=False)
    write_colmap_text(tmp_path / "sparse/0", flat())
    for name, image in zip(flat().names, SMOOTH.images, strict=True):
        save_picture(tmp_path / "drawn" / name, image)
    assert load_scene(tmp_path).scene.images is None
    assert load_scene(tmp_path, images=tmp_path / "drawn").scene.images is not None
