"""Distances of rows from their pixels are measured, and poses in another convention are recognised."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import smooth_scene
from messages import noted, refuses
from sweeps import sweep
from tiny_scene import Tiny, edited_json, make_tiny

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import C2W_OPENGL, CONVENTIONS, FLIP, W2C_OPENCV, from_viewmats, to_viewmats
from gsmerge.io.photo_files import NO_IMAGES
from gsmerge.reading.alignment import (
    Alignment,
    check_pairs,
    choose_poses,
    explain_misalignment,
    other_conventions,
    sample_pixels,
)
from gsmerge.reading.alignment.explain import misalignment_error
from gsmerge.reading.read_scene import load_scene
from gsmerge.types import SH_C0, Cameras, Gaussians

SMOOTH = smooth_scene(40, 30)


def rewrite_poses(folder: Path, tiny: Tiny, convention: tuple[str, str]) -> None:
    with edited_json(folder / "transforms.json") as data:
        for frame, pose in zip(data["frames"], from_viewmats(tiny.w2c, convention), strict=True):
            frame["transform_matrix"] = pose.tolist()


def some_rows(tiny: Tiny) -> Tiny:
    """Return two thirds of the Gaussians in a random order, a prime number: no pixels."""
    order = np.random.default_rng(0).permutation(len(tiny.gaussians))
    return replace(tiny, gaussians=tiny.gaussians[order[:2399]])


@sweep("true", [c for c in CONVENTIONS if c != C2W_OPENGL], ids=" ".join)
def test_poses_get_the_reading_that_fits_with_a_note(tiny_folder: Path, tiny: Tiny, true: tuple[str, str]) -> None:
    rewrite_poses(tiny_folder, tiny, true)
    loaded = load_scene(tiny_folder, order="view-major")
    assert loaded.alignment.ok
    assert np.allclose(loaded.scene.cameras.viewmats, tiny.w2c)
    assert np.allclose(loaded.cameras.viewmats, tiny.w2c)
    assert loaded.cameras.convention == true
    assert loaded.notes == (
        f"the poses fit when read as {true[0]} matrices with {true[1]} axes,"
        " where this format has camera-to-world with OpenGL axes: read so",
    )


@sweep("true", [c for c in CONVENTIONS if c != C2W_OPENGL], ids=" ".join)
def test_photos_tell_the_reading_of_poses_without_pixels(tmp_path: Path, true: tuple[str, str]) -> None:
    folder = some_rows(SMOOTH).save(tmp_path / "scene")
    rewrite_poses(folder, SMOOTH, true)
    loaded = load_scene(folder)
    assert not loaded.scene.has_own_pixels
    assert np.allclose(loaded.scene.cameras.viewmats, SMOOTH.w2c)
    assert noted(loaded.notes, *true)


def test_poses_that_fit_as_usual_get_no_note(tmp_path: Path) -> None:
    loaded = load_scene(some_rows(SMOOTH).save(tmp_path))
    assert np.allclose(loaded.scene.cameras.viewmats, SMOOTH.w2c)
    assert loaded.notes == ()


def test_two_readings_that_fit_alike_are_noted_where_photos_fit_both() -> None:
    """Cameras in the middle of a ball of Gaussians: both axes see the same; where photos do, too, there is a doubt."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    tiny = make_tiny()
    columns = (3 * points[:, 0] / np.abs(points[:, 2])).clip(-10, 9.5)  # where views see them, ahead or behind
    gaussians = replace(
        tiny.gaussians[np.arange(4000) % 840],
        means=points.astype(np.float32),
        sh0=np.repeat(columns[:, None, None] / 10, 3, -1),
    )
    viewmats = np.tile(np.eye(4), (3, 1, 1))
    viewmats[:, 1, 3] = 0.1, 0.02, -0.1
    viewmats[1, :3, :3] = np.diag([1, -1, -1])
    wide = np.array([[3.0, 0, 10], [0, 3, 7], [0, 0, 1]])
    cameras = Cameras(viewmats, np.tile(wide, (3, 1, 1)), 20, 14)
    photos = np.broadcast_to(0.5 + SH_C0 * ((np.arange(20) - 9.5) / 10)[:, None], (3, 14, 20, 3))
    for images, doubts in ((NO_IMAGES, False), (photos, True)):
        poses, seen, said = choose_poses(gaussians, np.ones(4000, bool), cameras, images, W2C_OPENCV)
        assert poses is None
        assert seen.ok
        assert ("fit as well when read as" in (said or "")) is doubts


def test_a_single_pose_without_rotation_has_one_other_reading() -> None:
    assert [p.description for p in other_conventions(np.eye(4)[None], W2C_OPENCV)] == [
        "world-to-camera matrices with OpenGL axes"
    ]


def test_rows_without_finite_positions_do_not_decide_the_reading(tmp_path: Path, tiny: Tiny) -> None:
    folder = tiny.save(tmp_path / "scene")
    rewrite_poses(folder, tiny, W2C_OPENCV)
    data = bytearray((folder / "scene.ply").read_bytes())
    start = data.index(b"end_header\n") + 11
    data[start + 5 * 68 : start + 5 * 68 + 4] = np.float32(np.nan).tobytes()
    (folder / "scene.ply").write_bytes(data)
    assert load_scene(folder, order="view-major").scene.pixels.shown.sum() == 839


@pytest.mark.slow
def test_poses_that_fit_in_no_reading_are_refused(tmp_path: Path) -> None:
    folder = some_rows(SMOOTH).save(tmp_path / "scene")
    away = SMOOTH.c2w.copy()
    away[:, :3, 3] += 50
    away[:, :3, :3] = away[:, :3, :3] @ np.diag([-1.0, 1, -1])
    rewrite_poses(folder, replace(SMOOTH, c2w=away), C2W_OPENGL)
    with refuses(SceneError, "scene.ply", 3600, 2399, "0 %"):
        load_scene(folder, cameras=folder / "transforms.json")


def cameras_of(tiny: Tiny, viewmats: np.ndarray | None = None) -> Cameras:
    return Cameras(tiny.w2c if viewmats is None else viewmats, np.tile(tiny.K, (3, 1, 1)), tiny.width, tiny.height)


def valid_of(tiny: Tiny) -> np.ndarray:
    return np.ones((3, tiny.height, tiny.width), bool)


def check_alignment(gaussians: Gaussians, cameras: Cameras, valid: np.ndarray) -> Alignment:
    return check_pairs(sample_pixels(gaussians, cameras, valid), cameras)


def test_a_scene_with_the_usual_jitter_is_aligned(tiny: Tiny) -> None:
    actual = check_alignment(tiny.gaussians, cameras_of(tiny), valid_of(tiny))
    assert actual.ok
    assert len(actual.median_px) == 3
    assert all(0.05 < m < 0.25 for m in actual.median_px)  # the jitter is 0.2 px along each axis
    assert actual.share_in_front == 1
    assert actual.share_within_1px == 1


def test_a_known_shift_of_one_view_is_measured(tiny: Tiny) -> None:
    moved = cameras_of(tiny)
    Ks = moved.Ks.copy()
    Ks[1, 0, 2] += 3
    actual = check_alignment(tiny.gaussians, replace(moved, Ks=Ks), valid_of(tiny))
    assert not actual.ok
    assert actual.median_px[1] == pytest.approx(3, abs=0.2)
    assert actual.worst_px == actual.median_px[1]
    assert actual.share_within_1px == pytest.approx(2 / 3, abs=0.01)


def test_rows_that_are_set_aside_do_not_count_in_the_alignment(tiny: Tiny) -> None:
    means, valid = tiny.gaussians.means.copy(), valid_of(tiny).reshape(-1)
    means[: len(means) // 2] += 100
    valid[: len(means) // 2] = False
    actual = check_alignment(replace(tiny.gaussians, means=means), cameras_of(tiny), valid)
    assert actual.ok
    assert np.isnan(actual.median_px[0])


def test_a_scene_behind_its_cameras_is_not_aligned(tiny: Tiny) -> None:
    behind = cameras_of(tiny, np.diag([-1.0, -1, -1, 1]) @ tiny.w2c)  # same pixels, but negative depth
    actual = check_alignment(tiny.gaussians, behind, valid_of(tiny))
    assert not actual.ok
    assert actual.share_in_front == 0
    assert actual.median_px == (np.inf,) * 3


def test_alignment_samples_all_columns_of_large_views() -> None:
    tiny = make_tiny(200, 250)
    actual = check_alignment(tiny.gaussians, cameras_of(tiny), valid_of(tiny))
    assert actual.ok
    means = tiny.gaussians.means.reshape(3, 250, 200, 3).copy()
    means[:, :, 1::2] += 50  # every other column: a step of two pixels would miss it
    odd = check_alignment(replace(tiny.gaussians, means=means.reshape(-1, 3)), cameras_of(tiny), valid_of(tiny))
    assert odd.share_within_1px == pytest.approx(0.5, abs=0.02)


def test_shuffled_rows_of_tiny_views_are_not_aligned(tiny: Tiny) -> None:
    small = make_tiny(6, 5)
    assert check_alignment(small.gaussians, cameras_of(small), valid_of(small)).ok
    shuffled = small.gaussians[np.random.default_rng(0).permutation(len(small.gaussians))]
    assert not check_alignment(shuffled, cameras_of(small), valid_of(small)).ok


def test_a_wrong_number_of_rows_is_refused(tiny: Tiny) -> None:
    with refuses(ValueError, "", "3 x 14 x 20", 839):
        check_alignment(tiny.gaussians[:-1], cameras_of(tiny), valid_of(tiny))


def test_viewmats_survive_a_conversion_to_every_convention(tiny: Tiny) -> None:
    for convention in CONVENTIONS:
        assert np.allclose(to_viewmats(from_viewmats(tiny.w2c, convention), convention), tiny.w2c)
    assert np.allclose(to_viewmats(tiny.c2w @ FLIP, ("camera-to-world", "OpenGL")), tiny.w2c)


def test_another_order_of_rows_is_named(tiny: Tiny) -> None:
    good, valid, n = cameras_of(tiny), valid_of(tiny), len(tiny.gaussians)

    def explain(rows: np.ndarray) -> str | None:
        assert not check_alignment(tiny.gaussians[rows], good, valid).ok
        return explain_misalignment(tiny.gaussians[rows], good, valid)

    rows = np.arange(n).reshape(3, tiny.height, tiny.width)
    assert "view fastest" in str(explain(rows.transpose(1, 2, 0).reshape(-1)))
    assert "column-major" in str(explain(rows.transpose(0, 2, 1).reshape(-1)))
    assert explain(np.random.default_rng(0).permutation(n)) is None


def test_the_message_has_the_share_in_front_where_it_explains_the_distance(tiny: Tiny) -> None:
    cameras = cameras_of(tiny)
    shifted = replace(cameras, Ks=cameras.Ks + np.array([[0, 0, 9.0], [0, 0, 0], [0, 0, 0]]))
    behind = cameras_of(tiny, np.diag([-1.0, -1, -1, 1]) @ tiny.w2c)
    for wrong, is_named in ((shifted, False), (behind, True)):
        error = misalignment_error("c.json", check_alignment(tiny.gaussians, wrong, valid_of(tiny)), None)
        assert ("0 % in front" in str(error)) == is_named
