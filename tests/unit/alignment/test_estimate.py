"""Exports of Depth Anything 3 with photos alone: no cameras, no depth maps, a fifth of the pixels missing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import Smooth, da3_rows, depth_map_mask, export_rows, save_export, smooth_scene, with_intrinsics
from sweeps import sweep
from tiny_scene import write_images

from gsmerge.scene.read import Loaded, load_scene
from gsmerge.types import SH_C0

WIDTH, HEIGHT = 144, 108


def textured(fx: float = 170.0, fy: float = 170.0) -> Smooth:
    """Three views with fine texture and the principal point in the middle, as the model has it."""
    tiny = with_intrinsics(smooth_scene(WIDTH, HEIGHT), np.array([[fx, 0, WIDTH / 2], [0, fy, HEIGHT / 2], [0, 0, 1]]))
    rng = np.random.default_rng(2)
    noise = np.stack([cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH, 3)), (0, 0), 1.5) for _ in range(3)])
    images = (tiny.images + 200 * noise).clip(0, 255).astype(np.uint8)
    colors = images.reshape(-1, 1, 3) + rng.normal(0, 3, (3 * WIDTH * HEIGHT, 1, 3))
    sh0 = ((colors / 255).astype(np.float32) - 0.5) / SH_C0
    return replace(tiny, images=images, gaussians=replace(tiny.gaussians, sh0=sh0.astype(np.float32)))


def export(folder: Path, tiny: Smooth, kept: np.ndarray) -> Loaded:
    """Write the kept rows as the model does, with photos beside them, and read them."""
    save_export(folder / "gs_ply", tiny, export_rows(tiny, kept), cameras=False, name="0000.ply")
    write_images(folder / "images", tiny)
    return load_scene(folder)


def pixels_of(loaded: Loaded) -> np.ndarray:
    """The pixel that each row was put to."""
    assert loaded.recovery is not None
    return loaded.recovery.layout.pixel_ids()


@sweep("fy", [171.5, 170.0])
def test_cameras_and_pixels_from_photos(tmp_path: Path, fy: float) -> None:
    tiny = textured(fy=fy)
    kept = da3_rows(tiny)
    loaded = export(tmp_path, tiny, kept)
    assert (pixels_of(loaded) == kept).mean() > 0.999
    cameras = loaded.pixel_scene().cameras
    assert np.allclose(cameras.Ks[:, 0, 0], 170, rtol=0.01)
    assert np.allclose(cameras.Ks[:, 1, 1], fy, rtol=0.01)
    assert np.allclose(cameras.centres, tiny.c2w[:, :3, 3], atol=0.03)
    assert loaded.cameras is not None
    assert loaded.cameras.source == "estimated from the grid"
    assert any("from the Gaussians' own grid" in note for note in loaded.notes)
    assert not any("resized" in note for note in loaded.notes)  # photos have the grid's size
    assert [exporter.name for exporter in loaded.exporters] == ["da3"]
    assert int((~loaded.scene.pixels.shown).sum()) == tiny.depths.size - len(kept)


@pytest.mark.slow
def test_every_other_view(tmp_path: Path) -> None:
    tiny = textured()
    masks = [depth_map_mask(depth) for depth in tiny.depths]
    kept = [np.flatnonzero(mask) + i * mask.size for i, mask in enumerate(masks)]
    loaded = export(tmp_path, tiny, np.concatenate(kept[::2]))
    assert loaded.scene.names == (tiny.names[0], tiny.names[2])
    assert np.allclose(loaded.scene.cameras.centres, tiny.c2w[::2, :3, 3], atol=0.03)
