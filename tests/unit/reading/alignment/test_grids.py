"""Cameras, photos and grids of Gaussians may have different sizes."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import smooth_scene
from messages import noted
from tiny_scene import Tiny, frames_of, write_npz

from gsmerge.io.photo_files import PhotoTransform, resize_and_crop, resize_to
from gsmerge.reading.read_scene import load_scene

SMOOTH = smooth_scene(48, 36)


def write_photos(folder: Path, tiny: Tiny, photos: list[np.ndarray]) -> None:
    for name, photo in zip(tiny.names, photos, strict=True):
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / "images" / name), photo[..., ::-1])


def write_cameras(folder: Path, tiny: Tiny, K: np.ndarray, size: tuple[int, int]) -> None:
    data = frames_of(tiny) | {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    (folder / "transforms.json").write_text(json.dumps(data | {"w": size[0], "h": size[1]}))


def before_mapping(tiny: Tiny, mapping: PhotoTransform, size: tuple[int, int]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return intrinsics and photos that the mapping makes the scene's of."""
    matrix = np.array([[mapping.scale_x, 0, -mapping.left], [0, mapping.scale_y, -mapping.top], [0, 0, 1]])
    photos = [
        cv2.warpAffine(image, np.linalg.inv(matrix)[:2], size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for image in tiny.images
    ]
    return np.linalg.inv(matrix) @ tiny.K, photos


@pytest.mark.slow
@pytest.mark.parametrize(
    ("resize", "start"),
    [
        (resize_to, "photos of 110 x "),
        (resize_and_crop, "bars around the photos are cut off: 110 x 72 pixels become 96 x 72"),  # its edges repeat
    ],
)
def test_larger_photos_are_resized_or_cropped_to_the_grid(
    resize: Callable[..., PhotoTransform], start: str, tmp_path: Path
) -> None:
    """An npz at the grid's size, photos as they were taken: stretched or cropped, as their colours say."""
    _, photos = before_mapping(SMOOTH, resize((110, 72), (48, 36)), (110, 72))
    SMOOTH.save(tmp_path, cameras=False, images=False)
    write_photos(tmp_path, SMOOTH, photos)
    write_npz(tmp_path / "results.npz", SMOOTH, image=None, depth=np.ones((3, 36, 48), np.float32))
    loaded = load_scene(tmp_path, images=tmp_path / "images", order="view-major")
    assert np.abs(loaded.scene.images * 255 - SMOOTH.images).mean() < 8  # of 255: the photos were resized twice
    assert any(note.startswith(start) for note in loaded.notes)


def test_cameras_of_uncropped_pictures_are_cropped_to_the_images(tmp_path: Path) -> None:
    K, _ = before_mapping(SMOOTH, resize_and_crop((96, 54), (48, 36)), (96, 54))
    SMOOTH.save(tmp_path)
    write_cameras(tmp_path, SMOOTH, K, (96, 54))
    loaded = load_scene(tmp_path, order="view-major")
    assert np.allclose(loaded.scene.cameras.Ks, SMOOTH.K)
    assert loaded.notes == ("cameras of 96 x 54 are resized and centre-cropped to 48 x 36, the images' size",)


def test_intrinsics_stay_where_the_size_is_twice_the_principal_point(tmp_path: Path, tiny: Tiny) -> None:
    """They may be a pixel off; intrinsics stay those of the photos."""
    folder = tiny.save(tmp_path / "scene")
    write_cameras(folder, tiny, tiny.K, (tiny.width + 1, tiny.height))
    loaded = load_scene(folder)
    assert np.allclose(loaded.scene.cameras.Ks, tiny.K)
    assert not noted(loaded.notes, "scaled")


def test_intrinsics_divided_by_the_size_are_scaled_back(tmp_path: Path, tiny: Tiny) -> None:
    small = np.diag([1 / tiny.width, 1 / tiny.height, 1]) @ tiny.K
    folder = tiny.save(tmp_path / "scene")
    for size in ((20, 14), (0, 0)):
        write_cameras(folder, tiny, small, size)
        assert np.allclose(load_scene(folder).scene.cameras.Ks, tiny.K)
    (folder / "transforms.json").unlink()
    (folder / "camera_poses.txt").write_text("\n".join(" ".join(map(str, p.reshape(-1))) for p in tiny.c2w))
    (folder / "intrinsic.txt").write_text(f"{small[0, 0]} {small[1, 1]} {small[0, 2]} {small[1, 2]}")
    assert np.allclose(load_scene(folder).scene.cameras.Ks, tiny.K)


def test_rows_in_any_order_are_read_with_smaller_photos(tmp_path: Path) -> None:
    """Rows that are no pixels in their order need no photos of a grid's size."""
    order = np.random.default_rng(0).permutation(len(SMOOTH.gaussians))
    replace(SMOOTH, gaussians=SMOOTH.gaussians[order]).save(tmp_path, images=False)
    write_photos(tmp_path, SMOOTH, [cv2.resize(image, (24, 18)) for image in SMOOTH.images])
    scene = load_scene(tmp_path).scene
    assert (scene.cameras.width, scene.cameras.height, len(scene.images)) == (24, 18, 3)
    assert scene.num_gaussians == len(SMOOTH.gaussians)


@pytest.mark.parametrize(
    "size", [(144, 108), (192, 144), (120, 90)], ids=["odd multiple", "even multiple", "2.5 times"]
)
def test_rows_are_the_pixels_of_a_smaller_grid_beside_cameras_and_photos_as_they_were_taken(
    size: tuple[int, int], tmp_path: Path
) -> None:
    K, photos = before_mapping(SMOOTH, resize_to(size, (48, 36)), size)
    SMOOTH.save(tmp_path, cameras=False, images=False)
    write_photos(tmp_path, SMOOTH, photos)
    write_cameras(tmp_path, SMOOTH, K, size)
    loaded = load_scene(tmp_path)
    assert loaded.scene.has_own_pixels
    assert (loaded.scene.cameras.width, loaded.scene.cameras.height) == (48, 36)
    assert np.abs(loaded.scene.images * 255 - SMOOTH.images).mean() < 4  # of 255
    assert noted(loaded.notes, "{} x {}".format(*size), "48 x 36")
