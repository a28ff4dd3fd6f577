"""Photos of several shapes are all used, and photos much smaller than the rows' grid take nothing from it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import Smooth, export_rows, save_export, smooth_scene
from messages import noted

from gsmerge.reading.read_scene import load_scene

WIDTH, HEIGHT, CUT = 56, 40, 16


@pytest.fixture
def smooth() -> Smooth:
    return smooth_scene(WIDTH, HEIGHT)


def save_shuffled(folder: Path, scene: Smooth) -> Path:
    """Write the scene with rows that are no pixels."""
    order = np.random.default_rng(0).permutation(len(scene.gaussians))
    return save_export(folder, scene, export_rows(scene, order))


def change_frames(folder: Path, size: tuple[int, int], views: list[int], resize: bool = False) -> None:
    """Crop the photos of some views at the right to a ``size``, or resize them; cameras keep their other numbers."""
    path = folder / "transforms.json"
    document = json.loads(path.read_text())
    for view, frame in enumerate(document["frames"]):
        sides = {key: frame.get(key, document.get(key)) for key in ("w", "h")}
        if view in views:
            photo = folder / frame["file_path"]
            image = cv2.imread(str(photo))
            cv2.imwrite(str(photo), cv2.resize(image, size) if resize else image[: size[1], : size[0]])
            sides = sides if resize else dict(zip("wh", size, strict=True))
        frame |= sides
    path.write_text(json.dumps(document))


def test_photos_of_two_shapes_are_extended_to_one(tmp_path: Path, smooth: Smooth) -> None:
    folder = save_shuffled(tmp_path / "scene", smooth)
    whole = load_scene(folder).scene
    change_frames(folder, (WIDTH - CUT, HEIGHT), [1])
    load = load_scene(folder)
    assert len(load.scene) == 3
    assert noted(load.notes, f"photos of 2 shapes are extended to {WIDTH} x {HEIGHT}")
    assert load.scene.masks is not None
    assert load.scene.masks[[0, 2]].all()
    assert load.scene.masks[1, :, : WIDTH - CUT - 1].all()
    assert not load.scene.masks[1, :, WIDTH - CUT + 1 :].any()
    assert load.scene.importance is not None
    assert (load.scene.importance[1, :, WIDTH - CUT + 1 :] == 0).all()
    np.testing.assert_allclose(load.scene.cameras.Ks, whole.cameras.Ks)
    np.testing.assert_allclose(load.scene.images[1, :, : WIDTH - CUT], whole.images[1, :, : WIDTH - CUT], atol=1e-6)


def test_masks_of_photos_of_two_shapes_are_extended_with_them(tmp_path: Path, smooth: Smooth) -> None:
    folder = save_shuffled(tmp_path / "scene", smooth)
    change_frames(folder, (WIDTH - CUT, HEIGHT), [1])
    mask = np.full((HEIGHT, WIDTH - CUT), 255, np.uint8)
    mask[:10] = 0
    path = folder / "masks" / smooth.names[1]
    path.parent.mkdir(parents=True)
    cv2.imwrite(str(path), mask)
    masks = load_scene(folder).scene.masks
    assert masks is not None
    assert not masks[1, :9].any()
    assert masks[1, 11:, : WIDTH - CUT - 1].all()
    assert not masks[1, :, WIDTH - CUT + 1 :].any()


@pytest.mark.parametrize("is_stated", [True, False])
def test_previews_take_nothing_from_the_grid_of_the_rows(tmp_path: Path, smooth: Smooth, is_stated: bool) -> None:
    """Whether cameras state the size of the grid, or that of the photos."""
    folder = save_export(tmp_path / "scene", smooth, export_rows(smooth))
    small = WIDTH // 4, HEIGHT // 4
    change_frames(folder, small, [0, 1, 2], resize=True)
    if not is_stated:
        path = folder / "transforms.json"
        document = json.loads(path.read_text())
        for place in (document, *document["frames"]):
            place |= {key: value / 4 for key, value in place.items() if key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
        path.write_text(json.dumps(document))
    load = load_scene(folder)
    assert load.scene.has_own_pixels
    assert (load.scene.cameras.width, load.scene.cameras.height) == (WIDTH, HEIGHT)
    assert load.scene.images is None
    assert noted(load.notes, f"{small[0]} x {small[1]}", "so Gaussians keep their own colours")
