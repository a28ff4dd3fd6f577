"""Depths of pixels that an exporter dropped, from the photos of other views."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import da3_rows, export_rows, save_export, smooth_scene
from messages import noted
from tiny_scene import make_tiny, write_colmap_text, write_images

from gsmerge.alignment import guess_depths
from gsmerge.scene.read import load_scene
from gsmerge.types import Cameras, Scene, grid_ids

WIDTH, HEIGHT, NEAR, FAR, FLOOR = 96, 64, 3.0, 6.0, 32
K = np.array([[80.0, 0, 48], [0, 80, 32], [0, 0, 1]])


def scene_of(*, moved: float) -> Scene:
    """Three views of a far wall above a near one, each ``moved`` to the right; the far wall and borders are missing."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    depth = np.where(y < FLOOR, FAR, NEAR)
    viewmats = np.tile(np.eye(4), (3, 1, 1))
    means, images = [], []
    for view in range(3):
        viewmats[view, 0, 3] = -moved * view
        rays = np.stack([(x - 48) / 80, (y - 32) / 80, np.ones_like(x)], -1)
        world = rays * depth[..., None] + np.array([moved * view, 0, 0])
        u, v = world[..., 0], world[..., 1]
        colors = [np.sin(9 * u + 3 * v), np.sin(5 * u - 8 * v), np.sin(2 * u * v + 4 * v)]
        images.append(0.5 + 0.4 * np.stack(colors, -1))
        means.append(world.reshape(-1, 3))
    kept = np.zeros((3, HEIGHT, WIDTH), bool)
    kept[:, FLOOR:-2, 3:-3] = True
    count = kept.size
    tiny = make_tiny().gaussians
    gaussians = replace(tiny[np.arange(count) % len(tiny)], means=np.concatenate(means).astype(np.float32))
    cameras = Cameras(viewmats, np.tile(K, (3, 1, 1)), WIDTH, HEIGHT)
    photos = np.stack(images).astype(np.float32)
    return Scene(gaussians, cameras, photos, grid_ids(kept), ("a", "b", "c"), ~kept)


def test_far_pixels_lie_where_the_photos_agree() -> None:
    scene = scene_of(moved=0.5)
    maps = guess_depths(scene, scene.images)
    far = maps[:, 6 : FLOOR - 6, 10:-10]
    assert (np.abs(np.log(far / FAR)) < 0.1).mean() > 0.9


def test_kept_pixels_and_borders_have_the_depths_of_rows() -> None:
    scene = scene_of(moved=0.5)
    maps = guess_depths(scene, scene.images)
    assert np.allclose(maps[:, FLOOR:], NEAR, rtol=1e-5)


def test_far_pixels_are_no_nearer_than_the_farthest_row() -> None:
    """Without parallax no depth agrees better than another."""
    scene = scene_of(moved=0.0)
    maps = guess_depths(scene, scene.images)
    assert np.allclose(maps[:, 2:FLOOR], NEAR, rtol=1e-5)


def test_holes_between_rows_have_the_depth_beside_them() -> None:
    """Single pixels missing from the near wall: the photos do not speak for another depth."""
    scene = scene_of(moved=0.5)
    holes = np.random.default_rng(0).random(scene.valid.shape) < 0.1
    holes[:, :FLOOR] = False
    kept = scene.valid & ~holes
    maps = guess_depths(replace(scene, pixel_ids=grid_ids(kept), missing=~kept), scene.images)
    assert (np.abs(np.log(maps[:, FLOOR + 8 : -8, 8:-8] / NEAR)) < 0.01).mean() > 0.98


@pytest.mark.parametrize("photos", [True, False])
def test_dropped_pixels_come_back_with_cameras_and_photos(tmp_path: Path, photos: bool) -> None:
    """Rows of Depth Anything 3 with COLMAP's cameras in the place of its depth maps."""
    tiny = smooth_scene(96, 72)
    folder = save_export(tmp_path, tiny, export_rows(tiny, da3_rows(tiny)), cameras=False)
    write_colmap_text(folder / "sparse" / "0", tiny)
    if photos:
        write_images(folder / "images", tiny)
    loaded = load_scene(folder)
    scene = loaded.pixel_scene()
    back = scene.valid & scene.missing
    assert np.array_equal(np.flatnonzero(scene.stored.reshape(-1)), da3_rows(tiny))
    assert back.any() == photos
    assert noted(loaded.notes, "put back") == photos
    if photos:
        assert scene.valid.all()
        c2w = np.repeat(tiny.c2w, 96 * 72, axis=0)
        depths = ((scene.gaussians.means - c2w[:, :3, 3]) * c2w[:, :3, 2]).sum(1)
        assert np.median(np.abs(np.log(depths / tiny.depths.reshape(-1)))[back.reshape(-1)]) < 0.1
