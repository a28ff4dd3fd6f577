"""Poses alone are given: the focal length follows from the Gaussians' pixels, or from the photos."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import Smooth, export_rows, home, save_export, smooth_scene, with_intrinsics
from messages import noted, refuses
from tiny_scene import FLIP, save_json, write_images, write_npz

from gsmerge.errors import SceneError
from gsmerge.kernels import elementary
from gsmerge.scene.read import load_scene
from gsmerge.types import SH_C0

FOCAL = 110.0
CENTRED = with_intrinsics(smooth_scene(96, 72), np.array([[FOCAL, 0, 48], [0, FOCAL, 36], [0, 0, 1]]))
SCENE = replace(CENTRED, names=("2.png", "10.png", "11.png"))
ROWS = np.arange(3 * 72 * 96).reshape(3, 72, 96)


def frame_list(folder: Path, tiny: Smooth) -> None:
    """As VicaSplat's demo writes it: camera to world, OpenCV axes."""
    frames = zip(tiny.names, tiny.c2w.tolist(), strict=True)
    save_json(folder / "transforms.json", [{"file_path": f"context/{n}", "transform_matrix": m} for n, m in frames])


def nerfstudio(folder: Path, tiny: Smooth) -> None:
    frames = zip(tiny.names, (tiny.c2w @ FLIP).tolist(), strict=True)
    frames = [{"file_path": f"context/{n}", "transform_matrix": m} for n, m in frames]
    save_json(folder / "transforms.json", {"camera_model": "PINHOLE", "frames": frames})


def pose_list(folder: Path, tiny: Smooth) -> None:
    np.savetxt(folder / "camera_poses.txt", tiny.c2w.reshape(3, 16))


def da3(folder: Path, tiny: Smooth) -> None:
    write_npz(folder / "results.npz", tiny, intrinsics=None)


def dump(folder: Path, tiny: Smooth) -> None:
    np.savez(folder / "views.npz", c2w=tiny.c2w, images=tiny.images)


def write(folder: Path, tiny: Smooth, rows: np.ndarray, cameras: Callable[[Path, Smooth], None]) -> Path:
    save_export(folder, tiny, rows, cameras=False, name="gaussians.ply")
    cameras(folder, tiny)
    write_images(folder / "context", tiny)
    return folder


@pytest.mark.parametrize("cameras", [frame_list, nerfstudio, pose_list, da3, dump])
def test_rows_that_are_pixels_show_it(tmp_path: Path, cameras: Callable[[Path, Smooth], None]) -> None:
    loaded = load_scene(write(tmp_path, SCENE, export_rows(SCENE), cameras))
    assert home(loaded.pixel_scene(), SCENE) == 1
    np.testing.assert_allclose(loaded.scene.cameras.Ks, np.tile(SCENE.K, (3, 1, 1)), atol=0.3)
    assert noted(loaded.notes, "intrinsics", "rays")
    assert loaded.alignment is not None
    assert loaded.alignment.worst_px < 0.5


def test_trimmed_rows_and_another_principal_point(tmp_path: Path) -> None:
    tiny = with_intrinsics(SCENE, np.array([[FOCAL, 0, 44], [0, 104, 38], [0, 0, 1]]))
    rows = ROWS[:, 8:-8, 8:-8].transpose(1, 2, 0).reshape(-1)
    loaded = load_scene(write(tmp_path, tiny, export_rows(tiny, rows), frame_list))
    assert home(loaded.pixel_scene(), tiny, np.isin(ROWS.reshape(-1), rows)) == 1
    np.testing.assert_allclose(loaded.scene.cameras.Ks, np.tile(tiny.K, (3, 1, 1)), atol=0.3)


def test_photos_larger_than_the_grid(tmp_path: Path) -> None:
    folder = write(tmp_path, SCENE, export_rows(SCENE), frame_list)
    for path in (folder / "context").iterdir():
        assert cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), None, fx=2, fy=2))
    loaded = load_scene(folder)
    assert home(loaded.pixel_scene(), SCENE) == 1
    assert loaded.scene.cameras.Ks[0, 0, 0] == pytest.approx(FOCAL, rel=0.005)


OBLONG = np.array([[FOCAL, 0, 44], [0, 80, 38], [0, 0, 1]])


@pytest.mark.parametrize(("views", "K"), [(1, SCENE.K), pytest.param(3, OBLONG, marks=pytest.mark.slow)])
def test_photos_show_it_where_rows_are_no_pixels(tmp_path: Path, views: int, K: np.ndarray) -> None:
    """VicaSplat's rows: sorted by opacity, the least opaque dropped, not on the rays; a search of seconds."""
    rng = np.random.default_rng(0)
    scene = with_intrinsics(SCENE, K)
    means = scene.gaussians.means + rng.normal(0, 0.01, scene.gaussians.means.shape).astype(np.float32)
    colors = 0.5 + 0.45 * elementary.sin(9 * means.astype(np.float64) + np.array([0, 1, 2]))
    sh0 = ((colors - 0.5) / SH_C0).astype(np.float32)[:, None]
    images = (255 * colors).round().astype(np.uint8).reshape(3, 72, 96, 3)
    tiny = replace(scene, images=images, gaussians=replace(scene.gaussians, means=means, sh0=sh0))
    order = np.argsort(-tiny.gaussians.opacities[: views * 72 * 96], kind="stable")
    rows = export_rows(tiny, order[: int(0.7 * len(order))], rest=72)
    one = replace(tiny, names=tiny.names[:views], c2w=tiny.c2w[:views], images=images[:views])
    loaded = load_scene(write(tmp_path, one, rows, frame_list))
    assert not loaded.scene.has_own_pixels
    np.testing.assert_allclose(loaded.scene.cameras.Ks[0], K, rtol=0.02, atol=0.1)
    assert noted(loaded.notes, "intrinsics", "colours")


def test_what_shows_no_focal_length_is_refused(tmp_path: Path) -> None:
    """Without photos and size; and photos of another scene."""
    folder = write(tmp_path / "a", SCENE, export_rows(SCENE), frame_list)
    for path in (folder / "context").iterdir():
        path.unlink()
    with refuses(SceneError, "transforms.json", "intrinsics", "photos"):
        load_scene(folder, cameras=folder / "transforms.json")
    frames = json.loads((folder / "transforms.json").read_text())
    save_json(folder / "transforms.json", [frame | {"w": 96, "h": 72} for frame in frames])
    assert load_scene(folder).scene.cameras.Ks[0, 0, 0] == pytest.approx(FOCAL, rel=0.005)
    noise = np.random.default_rng(0).integers(0, 256, SCENE.images.shape, np.uint8)
    other = replace(SCENE, images=noise)
    some = np.random.default_rng(0).permutation(ROWS.size)[:9000]
    with refuses(SceneError, "transforms.json", "intrinsics", "focal"):
        load_scene(write(tmp_path / "b", other, export_rows(other, some), frame_list), cameras=tmp_path / "b")
