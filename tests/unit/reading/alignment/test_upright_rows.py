"""Rows that were centred, rescaled and turned upright by unknown amounts are matched with photos."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import Smooth, export_rows, save_export, smooth_scene, turned
from messages import refuses
from sweeps import sweep

from gsmerge.errors import SceneError
from gsmerge.method.kernels import elementary
from gsmerge.reading.alignment.frames import UPRIGHT
from gsmerge.reading.read_scene import Loaded, load_scene
from gsmerge.types import SH_C0

WIDTH, HEIGHT, VIEWS, TRIM = 96, 72, 3, 8


def with_texture(tiny: Smooth) -> Smooth:
    """Return the same surface in colours by which each stretch of pixels is known."""
    noise = np.random.default_rng(1).integers(0, 256, tiny.images.shape).astype(np.float32)
    images = np.stack([cv2.GaussianBlur(image, (0, 0), 1.0) for image in noise])
    images = (128 + 2 * (images - 128)).clip(0, 255).astype(np.uint8)
    colors = (images.reshape(-1, 1, 3) / np.float32(255) - 0.5) / SH_C0
    return replace(tiny, images=images, gaussians=replace(tiny.gaussians, sh0=colors.astype(np.float32)))


@pytest.fixture(scope="module")
def textured() -> Smooth:
    return with_texture(smooth_scene(WIDTH, HEIGHT))


def far_cut(tiny: Smooth, share: float = 0.9) -> np.ndarray:
    """Return indices in the order row, column, view, without borders and the farthest."""
    index = np.arange(tiny.depths.size).reshape(tiny.depths.shape)
    limit = np.quantile(tiny.depths, share)
    kept = np.zeros(index.shape, bool)
    kept[:, TRIM:-TRIM, TRIM:-TRIM] = True
    kept &= tiny.depths < limit
    return index.transpose(1, 2, 0)[kept.transpose(1, 2, 0)]


def upright(tiny: Smooth, rows: np.ndarray, first: int = 0) -> tuple[np.ndarray, float, np.ndarray]:
    """Return rows as pixelSplat's exporter leaves them, its scale, and the centres of the cameras there."""
    means = np.stack([rows[name] for name in "xyz"], 1).astype(np.float64)
    middle = np.median(means, 0)
    scale = 1 / np.quantile(np.abs(means - middle), 0.95, axis=0).max()
    turn = UPRIGHT @ tiny.w2c[first, :3, :3]
    moved = turned(rows, turn, scale=scale, shift=-scale * turn @ middle)
    moved["opacity"] = 1 / (1 + elementary.exp(-rows["opacity"]))
    return moved, scale, scale * (tiny.c2w[:, :3, 3] - middle) @ turn.T


def check_centres(loaded: Loaded, centres: np.ndarray, scale: float) -> None:
    assert np.allclose(loaded.scene.cameras.centres, centres, atol=0.01 * scale)
    assert any("rotated" in note for note in loaded.notes)


@pytest.mark.slow
@sweep("first", [0, 2])
def test_cameras_are_turned_upright_with_rows_whose_far_pixels_were_dropped(
    tmp_path: Path, textured: Smooth, first: int
) -> None:
    kept = far_cut(textured)
    rows, scale, centres = upright(textured, export_rows(textured, kept), first)
    loaded = load_scene(save_export(tmp_path, textured, rows))
    check_centres(loaded, centres, scale)


@pytest.mark.slow
@sweep("photos", ["none", "of another scene"])
def test_upright_rows_without_matching_photos_are_refused(tmp_path: Path, textured: Smooth, photos: str) -> None:
    rows, _, _ = upright(textured, export_rows(textured, far_cut(textured)))
    strange = np.random.default_rng(5).integers(0, 256, textured.images.shape, np.uint8)
    folder = save_export(tmp_path, replace(textured, images=strange), rows)
    if photos == "none":
        for photo in (folder / "images").rglob("*.png"):
            photo.unlink()
    with refuses(SceneError, "scene.ply", "upright", "photos"):
        load_scene(folder, cameras=folder)


def test_upright_rows_too_few_to_be_matched_are_refused(tmp_path: Path, textured: Smooth) -> None:
    rows, _, _ = upright(textured, export_rows(textured, far_cut(textured)[:100]))
    with refuses(SceneError, "scene.ply"):
        load_scene(save_export(tmp_path, textured, rows), cameras=tmp_path)
