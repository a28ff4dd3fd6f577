"""Datasets as people have them: RE10K's chunks, folders of DL3DV and of Mip-NeRF 360."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import smooth_scene
from messages import refuses
from tiny_scene import Tiny, edited_json, write_colmap_binary, write_images, write_transforms

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import select_views
from gsmerge.research.captures import Capture, find_capture, list_captures
from gsmerge.types import Views

TINY = replace(smooth_scene(48, 36), names=("b.png", "c.png", "a.png"))
BY_NAME = [2, 0, 1]


def read(capture: Capture, ids: list[int]) -> Views:
    return capture.read_views(select_views(capture.read_cameras(), ids))


def check(views: Views, tiny: Tiny, ids: list[int], scale: float = 1, tolerance: float = 2) -> None:
    """Cameras and photos of some of the scene's views, in that order."""
    np.testing.assert_allclose(views.cameras.viewmats, tiny.w2c[ids], atol=1e-5)
    np.testing.assert_allclose(views.cameras.Ks[0, :2], tiny.K[:2] * scale, atol=1e-3)
    size = round(tiny.width * scale), round(tiny.height * scale)
    assert (views.cameras.width, views.cameras.height) == size
    expected = [cv2.resize(tiny.images[view], size, interpolation=cv2.INTER_AREA) for view in ids]
    assert np.abs(views.images * 255 - np.stack(expected)).mean() < tolerance


def write_dl3dv(folder: Path) -> None:
    """Cameras of photos in full size, which are there at a quarter of it alone; frames in no order."""
    folder.mkdir(parents=True)
    write_transforms(folder / "transforms.json", TINY)
    small = [cv2.resize(image, (12, 9), interpolation=cv2.INTER_AREA) for image in TINY.images]
    write_images(folder / "images_4", replace(TINY, images=np.stack(small)))


@pytest.mark.parametrize("place", ["", "nerfstudio"])
def test_folders_of_dl3dv(tmp_path: Path, place: str) -> None:
    write_dl3dv(tmp_path / "b1" / place)
    write_dl3dv(tmp_path / "a2" / place)
    (tmp_path / "notes").mkdir()
    assert [capture.name for capture in list_captures(tmp_path)] == ["a2", "b1"]
    capture = find_capture(tmp_path, "b1")
    check(read(capture, [0, 1, 2]), TINY, BY_NAME, 1 / 4)
    check(read(capture, [1]), TINY, [0], 1 / 4)
    assert find_capture(tmp_path.parent, f"{tmp_path.name}/b1").read_cameras().names == capture.read_cameras().names


def test_lenses_are_undone(tmp_path: Path) -> None:
    write_dl3dv(tmp_path / "a")
    straight = read(find_capture(tmp_path, "a"), [0])
    with edited_json(tmp_path / "a" / "transforms.json") as document:
        document |= {"camera_model": "OPENCV", "k1": -0.3, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    bent = read(find_capture(tmp_path, "a"), [0])
    np.testing.assert_array_equal(bent.cameras.Ks, straight.cameras.Ks)
    middle, corner = (np.abs(bent.images - straight.images)[0, y, x].mean() for y, x in ((5, 5), (0, 0)))
    assert middle < 0.01 < corner


def test_folders_of_mipnerf360(tmp_path: Path) -> None:
    write_colmap_binary(tmp_path / "garden" / "sparse" / "0", TINY)
    write_images(tmp_path / "garden" / "images", replace(TINY, images=255 - TINY.images))
    write_images(tmp_path / "garden" / "images_4", TINY)
    (capture,) = list_captures(tmp_path)
    check(read(capture, [0, 2]), TINY, [2, 1])


def test_chunks_of_re10k_and_acid(tmp_path: Path) -> None:
    from re10k_chunks import entry, save

    other = replace(TINY, c2w=TINY.c2w[::-1], images=TINY.images[::-1])
    save(tmp_path, entry(other, "one"), entry(TINY, "two"))
    (tmp_path / "index.json").write_text(json.dumps({"two": "000000.torch", "one": "000000.torch"}))
    two, one = list_captures(tmp_path)
    assert (two, one.name) == (find_capture(tmp_path, "two"), "one")
    check(read(two, [0, 1, 2]), TINY, [0, 1, 2], tolerance=3)
    check(read(one, [2, 0]), TINY, [0, 2], tolerance=3)


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    with refuses(SceneError, tmp_path, "transforms.json", "index.json"):
        list_captures(tmp_path)
    write_dl3dv(tmp_path / "a")
    with refuses(SceneError, tmp_path, "none"):
        find_capture(tmp_path, "b")
    for photo in (tmp_path / "a" / "images_4").rglob("*.png"):
        photo.unlink()
    with refuses(SceneError, tmp_path / "a" / "images_4", "photos", "none"):
        read(find_capture(tmp_path, "a"), [0])
    (tmp_path / "a" / "images_4").rename(tmp_path / "a" / "photos")
    with refuses(SceneError, tmp_path / "a" / "transforms.json", "photo"):
        read(find_capture(tmp_path, "a"), [0])
    (tmp_path / "index.json").write_text(json.dumps({"a": "1.torch"}))
    with refuses(SceneError, tmp_path, "b"):
        find_capture(tmp_path, "b")
    with refuses(SceneError, tmp_path / "1.torch", "no such file"):
        find_capture(tmp_path, "a").read_cameras()
    (tmp_path / "index.json").write_text(json.dumps(["a"]))
    with refuses(SceneError, tmp_path / "index.json", "scene"):
        list_captures(tmp_path)
