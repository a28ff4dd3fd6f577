"""Cameras and photos are found by what they hold: several models, folders of any name, masks that cameras name."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import export_rows, save_export, smooth_scene
from messages import names, noted
from tiny_scene import Tiny, rotation, write_colmap_binary, write_colmap_text, write_images, write_transforms

from gsmerge.drawing.preview import save_picture
from gsmerge.io import write_ply
from gsmerge.jobs.inspect import inspect
from gsmerge.reading.read_scene import Loaded, load_scene

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
        (["cut/0.png", "./cut/1", "cut/2.png"], {}, [0.25] * 3, ("3 of 3 photos have a mask",)),
        (["cut/0.png"], {}, [0.25, 0, 0], ("1 of 3 photos",)),
        (["cut/0.png", "gone/1.png"], {}, [0.25, 0, 0], ("1 of 3 masks", "transforms.json", "gone/1.png", "--masks")),
        ([], {"shared": "cut/0.png"}, [0.25] * 3, ("3 of 3 photos",)),
        (["cut/0.png"] * 3, {"size": (112, 80)}, [0.25] * 3, ("3 of 3 photos",)),
        (["cut/0.png"] * 3, {"size": (40, 40)}, None, ("cut/0.png", "aspect ratio", "left out")),
        ([5, ["a"], "../../x.png"], {}, None, ("masks", "transforms.json", "--masks")),
    ],
)
def test_masks_that_the_cameras_name(
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
