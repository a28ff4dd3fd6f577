"""Photos larger than what Gaussians without pixels can show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import export_rows, save_export, smooth_scene
from tiny_scene import Tiny

from gsmerge.io import load_scene

SMOOTH = smooth_scene(48, 36)
LARGE = replace(
    SMOOTH,
    K=SMOOTH.K * np.array([[4.0], [4], [1]]),
    width=192,
    height=144,
    images=np.stack([cv2.resize(image, (192, 144), interpolation=cv2.INTER_CUBIC) for image in SMOOTH.images]),
)
NOTE = "views of 192 x 144 are worked on at 96 x 72: no side is longer than 96 pixels (max_side)"


def save(folder: Path, *, shuffled: bool = True, tiny: Tiny = LARGE) -> Path:
    order = np.random.default_rng(0).permutation(3 * 36 * 48)[:3000] if shuffled else None
    return save_export(folder, tiny, export_rows(SMOOTH, order))


@pytest.mark.parametrize("order", ["auto", "none"])
def test_views_of_unaligned_scenes_are_resized(tmp_path: Path, order: str) -> None:
    loaded = load_scene(save(tmp_path), order=order, max_side=96)
    scene = loaded.scene
    assert not scene.aligned
    assert NOTE in loaded.notes
    assert scene.images is not None
    assert scene.images.shape == (3, 72, 96, 3)
    assert (scene.cameras.width, scene.cameras.height) == (96, 72)
    assert np.allclose(scene.cameras.Ks, SMOOTH.K * np.array([[2.0], [2], [1]]))
    small = np.stack([cv2.resize(image, (96, 72), interpolation=cv2.INTER_AREA) for image in LARGE.images])
    assert np.abs(scene.images * 255 - small).max() < 0.6


def test_small_enough_views_stay(tmp_path: Path) -> None:
    loaded = load_scene(save(tmp_path), max_side=192)
    assert loaded.scene.cameras.width == 192
    assert not any("max_side" in note for note in loaded.notes)
    assert load_scene(tmp_path).scene.cameras.width == 192


def test_cameras_without_photos_are_resized_too(tmp_path: Path) -> None:
    folder = save(tmp_path)
    for path in (folder / "images").rglob("*.png"):
        path.unlink()
    loaded = load_scene(folder, max_side=96)
    assert loaded.scene.images is None
    assert (loaded.scene.cameras.width, loaded.scene.cameras.height) == (96, 72)
    assert NOTE in loaded.notes


def test_scenes_with_pixels_keep_their_grid(tmp_path: Path) -> None:
    loaded = load_scene(save(tmp_path, shuffled=False), max_side=16)
    assert loaded.scene.aligned
    assert loaded.scene.cameras.width == 48


@pytest.mark.parametrize("shuffled", [False, True])
def test_memory_is_bounded_before_pixels_are_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shuffled: bool
) -> None:
    """More photos than fit are resized first; a grid that they were resized to is found all the same."""
    monkeypatch.setattr("gsmerge.io.scene_files._MAX_BYTES", 3 * 100 * 75 * 12)
    loaded = load_scene(save(tmp_path, shuffled=shuffled), max_side=96)
    assert NOTE in loaded.notes
    assert loaded.scene.aligned != shuffled
    size = (96, 72) if shuffled else (48, 36)
    assert (loaded.scene.cameras.width, loaded.scene.cameras.height) == size


def test_photos_that_may_be_the_grid_are_never_resized(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsmerge.io.scene_files._MAX_BYTES", 0)
    loaded = load_scene(save(tmp_path, shuffled=False, tiny=SMOOTH), max_side=16)
    assert loaded.pixel_scene().valid.all()
    assert loaded.notes == ()


@pytest.mark.parametrize("value", [0, 15, -3, 99.5, True, "many"])
def test_sizes_that_make_no_sense(tmp_path: Path, value: object) -> None:
    with pytest.raises(ValueError, match="max_side: expected a whole number of at least 16"):
        load_scene(tmp_path, max_side=value)
