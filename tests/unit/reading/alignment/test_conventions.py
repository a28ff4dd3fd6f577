"""Cameras that are some pixels off are moved to their Gaussians; those that are far off are not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import motions
import numpy as np
import pytest
import scenes
from messages import names, noted, refuses
from saved_cameras import write_transforms
from tiny_scene import Tiny, make_tiny

from gsmerge.errors import SceneError
from gsmerge.io import write_gaussians
from gsmerge.method.geometry.transforms import pose_changes, project_points
from gsmerge.reading.alignment.conventions import move_cameras
from gsmerge.reading.alignment.score import max_correctable_px, sample_pixels
from gsmerge.reading.read_scene import load_scene
from gsmerge.types import Cameras

NAMES = ("a", "b", "c")


@pytest.fixture(scope="module")
def large() -> Tiny:
    return make_tiny(200, 140)


def cameras_of(tiny: Tiny, viewmats: np.ndarray | None = None) -> Cameras:
    return Cameras(tiny.w2c if viewmats is None else viewmats, np.tile(tiny.K, (3, 1, 1)), tiny.width, tiny.height)


def moved_viewmats(tiny: Tiny, degrees: float, shift: float) -> np.ndarray:
    """Return the tiny scene's viewmats, each turned and moved in its own frame."""
    return np.asarray(motions.random_motions(3, degrees, shift) @ tiny.w2c)


def test_a_known_motion_of_cameras_is_measured(large: Tiny) -> None:
    wrong = cameras_of(large, moved_viewmats(large, 0.7, 0.02))
    pairs = sample_pixels(large.gaussians, wrong, np.ones(len(large.gaussians), bool))
    moved = move_cameras(pairs, wrong, NAMES)
    assert 1.5 < moved.worst_px < max_correctable_px(200, 140)
    degrees, distances = pose_changes(large.w2c, moved.cameras.viewmats)
    assert degrees.max() < 0.05  # of the 0.7 that they were turned
    assert distances.max() < 0.004  # of the 0.02 that they were moved
    assert [move["view"] for move in moved.moves] == list(NAMES)
    assert [move["degrees"] for move in moved.moves] == pytest.approx([0.7] * 3, abs=0.05)
    assert "degrees" in moved.note


def test_cameras_that_fit_stay_bit_for_bit_beside_one_that_is_off(large: Tiny) -> None:
    viewmats = large.w2c
    viewmats[1] = moved_viewmats(large, 0.7, 0.02)[1]
    pairs = sample_pixels(large.gaussians, cameras_of(large), np.ones(len(large.gaussians), bool))
    moved = move_cameras(pairs, cameras_of(large, viewmats), NAMES)
    np.testing.assert_array_equal(moved.cameras.viewmats[[0, 2]], viewmats[[0, 2]])
    assert [move["degrees"] > 0 for move in moved.moves] == [False, True, False]


@pytest.mark.parametrize(
    ("factor", "shift", "found"),
    [(1, 4, "-4.00 to cx"), (1, 8, "-8.00 to cx"), (1.05, 0, "fx by 0.9523"), (0.92, 0, "fx by 1.087")],
)
def test_wrong_intrinsics_are_refused_with_their_correction(
    factor: float, shift: float, found: str, large: Tiny
) -> None:
    pairs = sample_pixels(large.gaussians, cameras_of(large), np.ones(len(large.gaussians), bool))
    cameras = cameras_of(large)
    Ks = cameras.Ks * np.array([[factor, 1, 1], [1, factor, 1], [1, 1, 1]])
    Ks[:, 0, 2] += shift
    with refuses(SceneError, "Ks", found):
        move_cameras(pairs, replace(cameras, Ks=Ks), NAMES)


def test_a_principal_point_assumed_in_the_middle_is_corrected(large: Tiny) -> None:
    """Formats such as INRIA's store none."""
    Ks = cameras_of(large).Ks
    Ks[:, :2, 2] = large.width / 2, large.height / 2
    true = Ks + np.array([[0, 0, 4], [0, 0, -2], [0, 0, 0]])
    points = sample_pixels(large.gaussians, cameras_of(large), np.ones(len(large.gaussians), bool))
    pixels = np.empty_like(points.pixels, np.float64)
    for view in range(3):
        own = points.views == view
        pixels[own] = project_points(points.points[own], large.w2c[view], true[view])[0]
    moved = move_cameras(replace(points, pixels=pixels), replace(cameras_of(large), Ks=Ks), NAMES)
    assert np.allclose(moved.cameras.Ks, true, atol=0.05)
    assert "(4.0, -2.0) px from the middle" in moved.note
    np.testing.assert_array_equal(moved.cameras.viewmats, large.w2c)


def test_a_file_with_other_intrinsics_is_refused_with_the_remedy(large: Tiny, tmp_path: Path) -> None:
    cameras = cameras_of(large)
    cameras.Ks[:, 0, 2] += 4
    large.save(tmp_path)
    write_transforms(tmp_path / "transforms.json", cameras, large.names)
    with refuses(SceneError, "transforms.json", "4.0 px", "-4.00"):
        load_scene(tmp_path, order="view-major", cameras=tmp_path / "transforms.json")


def test_cameras_that_are_far_off_are_not_moved(large: Tiny) -> None:
    wrong = cameras_of(large, moved_viewmats(large, 8.0, 0.02))
    assert move_cameras(sample_pixels(large.gaussians, wrong, np.ones(84000, bool)), wrong, NAMES) is None
    assert max_correctable_px(480, 360) == 12
    assert max_correctable_px(20, 14) == 1.5  # in small pictures twelve pixels are much


def save_with(tiny: Tiny, folder: Path, viewmats: np.ndarray) -> Path:
    tiny.save(folder)
    write_transforms(folder / "transforms.json", cameras_of(tiny, viewmats), tiny.names)
    return folder


@pytest.mark.slow
def test_a_file_whose_cameras_are_off_is_read_with_a_note(large: Tiny, tmp_path: Path) -> None:
    load = load_scene(save_with(large, tmp_path / "scene", moved_viewmats(large, 0.7, 0.02)))
    assert load.scene.has_own_pixels
    assert pose_changes(large.w2c, load.scene.cameras.viewmats)[0].max() < 0.05  # degrees
    assert sum(names(note, "cameras", "median") for note in load.notes) == 1
    assert len(load.moves) == 3


@pytest.mark.parametrize("wrong", ["cameras", "Gaussians"])
def test_photos_tell_whether_cameras_or_gaussians_are_off(wrong: str, tmp_path: Path) -> None:
    """Cameras and the Gaussians of each view have different poses; photos agree under one of the two."""
    right = scenes.make_scene(scenes.room(), scenes.arc(3, 96, 72))
    moved = motions.disagreeing(right, 1.5, 0.02)
    rows, poses = (right, moved) if wrong == "cameras" else (moved, right)
    write_gaussians(tmp_path / "scene.ply", rows.gaussians)
    write_transforms(tmp_path / "transforms.json", poses.cameras, right.names)
    for name, image in zip(right.names, right.images, strict=True):
        cv2.imwrite(str(tmp_path / name), (255 * image[..., ::-1]).round())
    loaded = load_scene(tmp_path, order="view-major")
    assert noted(loaded.notes, f"the {wrong} are off")
    assert len(loaded.moves) == (3 if wrong == "cameras" else 0)
    assert pose_changes(right.cameras.viewmats, loaded.scene.cameras.viewmats)[0].max() < 0.1
    assert np.abs(loaded.scene.gaussians.means - right.gaussians.means).max() < 0.02
