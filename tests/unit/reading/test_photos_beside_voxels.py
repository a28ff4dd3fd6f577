"""Photos that lie beside Gaussians of no pixels, or among the frames of a film, are those of their views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import export_rows, save_export, smooth_scene, with_intrinsics
from messages import names
from PIL import Image
from plyfile import PlyData
from shared import write_scene
from sweeps import sweep
from tiny_scene import write_images

from gsmerge.reading.read_scene import load_scene

WIDTH, HEIGHT = 96, 64
SMOOTH = with_intrinsics(smooth_scene(WIDTH, HEIGHT), np.array([[110.0, 0, 48], [0, 110, 32], [0, 0, 1]]))
FLAT = replace(SMOOTH, names=("2.png", "10.png", "11.png"))


def store_on_the_side(images: Path) -> None:
    """Store portraits as a phone does, with a tag that says how to hold them."""
    exif = Image.Exif()
    exif[0x0112] = 6
    for path in images.iterdir():
        Image.open(path).transpose(Image.Transpose.ROTATE_90).save(path, exif=exif)


def delete_one(images: Path) -> None:
    (images / "view_001.png").unlink()


def add_thumbnails(images: Path) -> None:
    paths = [*images.iterdir()]
    (images / ".thumb").mkdir()
    for path in paths:
        cv2.imwrite(str(images / ".thumb" / path.name), cv2.resize(cv2.imread(str(path)), (24, 16)))


@sweep(
    ("change", "shown"), [(delete_one, [0, 2, 3]), (store_on_the_side, [0, 1, 2, 3]), (add_thumbnails, [0, 1, 2, 3])]
)
def test_photos_beside_gaussians_of_no_pixels(tmp_path: Path, change: Callable[[Path], None], shown: list[int]) -> None:
    """Only what is missing is left out, with its name."""
    folder = write_scene(tmp_path / "room", num_views=4, width=WIDTH, height=HEIGHT)
    rows = PlyData.read(str(folder / "scene.ply"))["vertex"].data
    save_export(folder, SMOOTH, np.random.default_rng(0).permutation(rows), cameras=False)
    photos = np.stack([cv2.imread(str(path)) for path in sorted((folder / "images").iterdir())])[..., ::-1] / 255
    change(folder / "images")
    loaded = load_scene(folder)
    assert not loaded.scene.has_own_pixels
    assert sorted(loaded.scene.photo_views) == shown
    assert np.abs(loaded.scene.images[shown] - photos[shown]).mean() < 0.01
    assert names(str(loaded.doubts), "1 of 4 views", "view_001.png") == (len(shown) < 4)


def test_rows_of_a_file_alone_follow_photos_whose_names_are_sorted_as_text(tmp_path: Path) -> None:
    """There are no cameras whose order could tell that 10 and 11 come before 2."""
    rows = export_rows(FLAT).reshape(3, -1)[[1, 2, 0]].reshape(-1)
    folder = save_export(tmp_path, FLAT, rows, cameras=False)
    write_images(folder / "images", FLAT)
    scene = load_scene(folder).scene
    photos = [FLAT.images[FLAT.names.index(name)] / 255 for name in scene.names]
    assert np.abs(scene.images - np.stack(photos)).mean() < 0.01
    colors = scene.gaussians.sh0[scene.pixels.fronts, 0] * 0.28209479 + 0.5
    assert np.abs(colors - scene.images).mean() < 0.02


@pytest.mark.slow
def test_frames_of_a_film_that_the_rows_show_are_their_photos(tmp_path: Path) -> None:
    """Of 40 frames that resemble one another, a model took three, which no file names."""
    taken = (3, 17, 36)
    folder = save_export(tmp_path, FLAT, export_rows(FLAT), cameras=False)
    (folder / "images").mkdir()
    rng = np.random.default_rng(0)
    for frame in range(40):
        view = int(np.argmin(np.abs(np.array(taken) - frame)))
        shift = (
            np.array([[1, 0, rng.uniform(2, 5)], [0, 1, rng.uniform(-4, 4)]]) if frame not in taken else np.eye(2, 3)
        )
        moved = cv2.warpAffine(FLAT.images[view], shift, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)
        cv2.imwrite(str(folder / "images" / f"frame_{frame:05d}.png"), moved[..., ::-1])
    scene = load_scene(folder).scene
    assert scene.names == tuple(f"frame_{frame:05d}.png" for frame in taken)
    assert np.abs(scene.images - FLAT.images / 255).mean() < 0.01
