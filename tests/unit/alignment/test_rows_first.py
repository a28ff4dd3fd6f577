"""Rows that show their grid and their views, whose cameras lie in any world, in any convention and order."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import Smooth, export_rows, home, save_export, smooth_scene, turned
from model_files import MODELS
from model_rows import check_cameras, check_pixels, take_views
from motions import random_motions
from sweeps import sweep
from tiny_scene import edited_json, rotation

from gsmerge.io.cameras.camera_file import C2W_OPENGL, CONVENTIONS, from_viewmats
from gsmerge.scene.read import load_scene

SMOOTH = smooth_scene(64, 48)
INNER = np.arange(3 * 48 * 64).reshape(3, 48, 64)[:, 8:-8, 8:-8]


def save(folder: Path, scene: Smooth, rows: np.ndarray, convention: tuple[str, str] = C2W_OPENGL) -> Path:
    """Write rows and photos, and the cameras of a scene in a convention."""
    save_export(folder, scene, rows)
    with edited_json(folder / "transforms.json") as data:
        for frame, pose in zip(data["frames"], from_viewmats(scene.w2c, convention), strict=True):
            frame["transform_matrix"] = pose.tolist()
    return folder


@sweep("convention", CONVENTIONS, ids=" ".join, often=2)
def test_trimmed_rows_in_a_world_of_their_own(tmp_path: Path, convention: tuple[str, str]) -> None:
    rows = export_rows(SMOOTH, INNER.transpose(1, 2, 0).reshape(-1))
    moved = turned(rows, rotation(0.7, -2.0, 1.1), scale=2.3, shift=np.array([4.0, -1, 9]))
    loaded = load_scene(save(tmp_path, SMOOTH, moved, convention))
    assert home(loaded.pixel_scene(), SMOOTH) == 1
    assert loaded.alignment is not None
    assert loaded.alignment.worst_px < 0.5
    assert loaded.cameras is not None
    assert loaded.cameras.convention == convention


@pytest.mark.parametrize("convention", [C2W_OPENGL, CONVENTIONS[0]], ids=" ".join)
def test_one_view_has_its_own_pose(tmp_path: Path, convention: tuple[str, str]) -> None:
    """It cannot tell in which convention its camera is: any pose is moved to where the rows show it."""
    one = take_views(SMOOTH, 1)
    rows = turned(export_rows(one, INNER[0].reshape(-1)), rotation(0.7, -2.0, 1.1), shift=np.array([4.0, -1, 9]))
    loaded = load_scene(save(tmp_path, one, rows, convention))
    assert home(loaded.pixel_scene(), one) == 1
    assert loaded.alignment is not None
    assert loaded.alignment.worst_px < 0.5


def test_trimmed_rows_and_cameras_that_are_off(tmp_path: Path) -> None:
    """In the first camera's frame, where grids of other sizes fit to a pixel at another scale."""
    rows = turned(export_rows(SMOOTH, INNER.transpose(1, 2, 0).reshape(-1)), SMOOTH.w2c[0, :3, :3])
    off = np.linalg.inv(random_motions(3, 0.3, 0.004) @ SMOOTH.w2c)
    loaded = load_scene(save(tmp_path, replace(SMOOTH, c2w=off), rows))
    assert home(loaded.pixel_scene(), SMOOTH) == 1
    assert loaded.recovery is not None
    assert loaded.recovery.best.frame.kind == "first"


def test_rows_of_half_the_size_of_the_only_cameras(tmp_path: Path) -> None:
    """Lyra 2's, of which a border is missing, without photos."""
    export = MODELS["Lyra 2"](tmp_path / "out")
    loaded = load_scene(export.path)
    check_pixels(loaded.pixel_scene(), export)
    check_cameras(replace(loaded.scene, images=export.scene.images / np.float32(255)), export)
