"""Cameras under which Gaussians lie on the centres of pixels: rows in any order, with any missing, and added ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import Smooth, export_rows, save_export, smooth_scene, turned
from messages import refuses
from model_rows import merge_voxels, take_views
from tiny_scene import rotation

from gsmerge.alignment.centres import CentreCheck, check_centres, find_rows, sample_points
from gsmerge.errors import SceneError
from gsmerge.kernels.matrices import invert, matmul
from gsmerge.scene.read import load_scene
from gsmerge.types import Cameras, Gaussians

WIDTH, HEIGHT = 64, 48


def on_centres(scene: Smooth) -> Smooth:
    """Return a scene whose Gaussians lie on the rays of their pixels' centres."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(x - scene.K[0, 2]) / scene.K[0, 0], (y - scene.K[1, 2]) / scene.K[1, 1], np.ones_like(x)], -1)
    means = [matmul((rays * depth[..., None]).reshape(-1, 3), pose[:3, :3].T) + pose[:3, 3]
             for depth, pose in zip(scene.depths, scene.c2w, strict=True)]  # fmt: skip
    return replace(scene, gaussians=replace(scene.gaussians, means=np.concatenate(means).astype(np.float32)))


JITTER = smooth_scene(WIDTH, HEIGHT)
EXACT = on_centres(JITTER)
COUNT = len(EXACT.gaussians)


def cameras_of(scene: Smooth) -> Cameras:
    return Cameras(scene.w2c, np.tile(scene.K, (len(scene.c2w), 1, 1)), scene.width, scene.height)


def check_of(scene: Smooth, cameras: Cameras | None = None) -> CentreCheck:
    means = scene.gaussians.means
    return check_centres(sample_points(means, np.ones(len(means), bool)), cameras or cameras_of(scene))


def read(scene: Smooth, rows: np.ndarray) -> np.ndarray | None:
    """Return the pixels that are found for some rows of a scene."""
    means = scene.gaussians.means[rows]
    return find_rows(means, np.ones(len(rows), bool), cameras_of(scene), check_of(scene))


# What chance gives


@pytest.mark.parametrize("views", [1, 2, 7, 128])
def test_distances_by_chance(views: int) -> None:
    """Points that lie anywhere: half of them are nearer than the median that chance gives, and no camera is right."""
    rng = np.random.default_rng(0)
    viewmats = np.tile(np.eye(4), (views, 1, 1))
    viewmats[:, :3, 3] = rng.uniform(-0.1, 0.1, (views, 3))
    cameras = Cameras(viewmats, np.tile(np.diag([500.0, 500, 1]), (views, 1, 1)), 400, 300)
    cameras.Ks[:, :2, 2] = 200, 150
    points = np.concatenate([rng.uniform(-0.2, 0.2, (20_000, 2)), np.ones((20_000, 1))], 1).astype(np.float32)
    check = check_centres(points, cameras)
    assert check.px == pytest.approx(check.chance_px, rel=0.06)
    assert check.chance_px == pytest.approx(np.sqrt((1 - 0.5 ** (1 / views)) / np.pi), rel=0.01)
    assert not check.ok
    assert check.share_right < 0.2


def test_points_about_centres_and_on_them() -> None:
    about, exact = check_of(JITTER), check_of(EXACT)
    assert about.ok
    assert not about.tells_pixels
    assert exact.tells_pixels
    assert exact.px < 1e-3


@pytest.mark.parametrize("scene", [JITTER, EXACT], ids=["about", "on"])
def test_at_a_wrong_scale_one_camera_alone_shows_its_points(scene: Smooth) -> None:
    c2w = scene.c2w.copy()
    c2w[:, :3, 3] = c2w[0, :3, 3] + 1.3 * (c2w[:, :3, 3] - c2w[0, :3, 3])
    assert not check_of(scene, replace(cameras_of(scene), viewmats=invert(c2w))).ok


@pytest.mark.parametrize("factor", [2, 1.5])
def test_pixels_of_another_size_have_other_centres(factor: float) -> None:
    cameras = cameras_of(EXACT)
    Ks = cameras.Ks * np.array([factor, factor, 1])[:, None]
    other = Cameras(cameras.viewmats, Ks, round(factor * WIDTH), round(factor * HEIGHT))
    assert not check_of(EXACT, other).ok


def test_far_from_the_origin_centres_are_rounded_away() -> None:
    """A mean of 24 bits at 1e5 is known to 0.004, a tenth of a pixel: in its place, but of no pixel; at 1e6 neither."""
    for away, ok in ((1e5, True), (1e6, False)):
        move = np.array([away, -away, away])
        c2w = EXACT.c2w.copy()
        c2w[:, :3, 3] += move
        means = (EXACT.gaussians.means.astype(np.float64) + move).astype(np.float32)
        far = replace(EXACT, c2w=c2w, gaussians=replace(EXACT.gaussians, means=means))
        assert check_of(far).ok == ok
        assert not check_of(far).tells_pixels


def test_few_points_and_points_in_one_place_show_nothing() -> None:
    cameras = cameras_of(EXACT)
    assert not check_centres(EXACT.gaussians.means[:40], cameras).ok
    assert not check_centres(
        sample_points(np.tile(EXACT.gaussians.means[:1], (900, 1)), np.ones(900, bool)), cameras
    ).ok


def test_voxels_are_on_no_centres() -> None:
    assert not check_of(replace(EXACT, gaussians=merge_voxels(EXACT, 0.2))).tells_pixels


# Rows and their pixels


def orders() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    every, kept = np.arange(COUNT), np.sort(rng.permutation(COUNT)[: 6 * COUNT // 10])
    return {
        "in order": every,
        "some dropped": kept,
        "views side by side": every.reshape(3, -1).T.reshape(-1),
        "views side by side, some dropped": kept[np.argsort(kept % (WIDTH * HEIGHT), kind="stable")],
    }


@pytest.mark.parametrize("order", orders())
@pytest.mark.parametrize("scene", [JITTER, EXACT], ids=["about", "on"])
def test_rows_in_the_order_of_pixels(scene: Smooth, order: str) -> None:
    rows = orders()[order]
    ids = read(scene, rows)
    assert ids is not None
    assert np.mean(ids == rows) > 0.99


def test_rows_in_any_order_where_they_lie_on_centres() -> None:
    rows = np.random.default_rng(0).permutation(COUNT)[: COUNT // 2]
    assert np.array_equal(read(EXACT, rows), rows)
    assert read(JITTER, rows) is None


def test_rows_that_are_not_valid_have_no_pixel() -> None:
    means = EXACT.gaussians.means.copy()
    means[::7] = np.nan
    valid = np.isfinite(means[:, 0])
    ids = find_rows(means, valid, cameras_of(EXACT), check_of(EXACT))
    assert np.array_equal(ids, np.where(valid, np.arange(COUNT), -1))


def test_cameras_of_one_pose_share_their_rows() -> None:
    """Which of two equal views a row is of cannot be told: each pixel of both has one row."""
    twins = take_views(EXACT, 2)
    twins = replace(twins, c2w=twins.c2w[[0, 0]], depths=twins.depths[[0, 1]])
    ids = read(on_centres(replace(twins)), np.random.default_rng(0).permutation(COUNT // 3 * 2))
    assert np.array_equal(np.sort(ids), np.arange(COUNT // 3 * 2))


def test_cameras_at_one_place() -> None:
    """A panorama: views are told apart by where their pixels look."""
    c2w = np.tile(EXACT.c2w[0], (3, 1, 1))
    for view, angle in enumerate((-0.3, 0.0, 0.35)):
        c2w[view, :3, :3] = matmul(c2w[view, :3, :3], rotation(0.0, angle, 0.1 * view))
    scene = on_centres(replace(EXACT, c2w=c2w))
    rows = np.random.default_rng(0).permutation(COUNT)
    assert np.array_equal(read(scene, rows), rows)


def test_several_rows_of_a_pixel_have_no_layout() -> None:
    assert read(EXACT, np.random.default_rng(0).permutation(np.tile(np.arange(COUNT), 2))) is None


# Files


def save_rows(folder: Path, scene: Smooth, rows: np.ndarray) -> Path:
    return save_export(folder, scene, export_rows(scene, rows))


@pytest.mark.parametrize("frame", ["same", "first", "scaled"])
def test_a_file_in_any_order(tmp_path: Path, frame: str) -> None:
    """Every row comes to its pixel; at another scale than the cameras' colours show it, and centres how exactly."""
    order, first = np.random.default_rng(0).permutation(COUNT)[: 4 * COUNT // 5], EXACT.w2c[0, :3, :3]
    rows = export_rows(EXACT, order)
    rows = turned(rows, first if frame == "first" else np.eye(3), scale=1.4 if frame == "scaled" else 1.0)
    loaded = load_scene(save_export(tmp_path, EXACT, rows))
    assert loaded.recovery is not None
    assert loaded.recovery.best.layout.order == "unordered"
    stored = loaded.pixel_scene().pixels.shown.reshape(-1)
    assert np.array_equal(np.flatnonzero(stored), np.sort(order))


def test_rows_about_their_centres_in_any_order_have_cameras(tmp_path: Path) -> None:
    order = np.random.default_rng(0).permutation(COUNT)
    rows = turned(export_rows(JITTER, order), JITTER.w2c[0, :3, :3])
    loaded = load_scene(save_export(tmp_path, JITTER, rows))
    assert not loaded.scene.has_own_pixels
    assert len(loaded.scene.gaussians) == COUNT
    assert np.allclose(loaded.scene.cameras.viewmats[0, :3, :3], np.eye(3), atol=1e-6)


def test_an_edited_file_keeps_its_cameras_and_every_row(tmp_path: Path) -> None:
    """Three fifths of the rows lie on centres, objects were added; colours of photos are those of something else."""
    rng = np.random.default_rng(0)
    kept = EXACT.gaussians[np.sort(rng.permutation(COUNT)[: 6 * COUNT // 10])]
    added = EXACT.gaussians[rng.permutation(COUNT)[: 4 * COUNT // 10]]
    means = added.means + rng.uniform(-0.2, 0.2, added.means.shape).astype(np.float32)
    gaussians = Gaussians.concat([kept, replace(added, means=means)])
    edited = replace(EXACT, gaussians=gaussians)
    loaded = load_scene(save_rows(tmp_path, edited, np.arange(len(gaussians))))
    assert not loaded.scene.has_own_pixels
    assert len(loaded.scene.gaussians) == len(gaussians)
    assert np.allclose(loaded.scene.cameras.viewmats, EXACT.w2c)


def test_the_hint_of_an_order_stays(tmp_path: Path) -> None:
    folder = save_rows(tmp_path, EXACT, np.random.default_rng(0).permutation(COUNT))
    assert load_scene(folder, order="unordered").scene.has_own_pixels
    assert not load_scene(folder, order="none").scene.has_own_pixels
    with refuses(SceneError, "scene.ply", "order=view-major"):
        load_scene(folder, order="view-major")


def test_cameras_that_see_nothing_are_refused(tmp_path: Path) -> None:
    c2w = EXACT.c2w.copy()
    c2w[:, :3, 3] += 100
    folder = save_rows(tmp_path, replace(EXACT, c2w=c2w), np.random.default_rng(0).permutation(COUNT))
    for photo in (folder / "images").rglob("*.png"):
        photo.unlink()
    with refuses(SceneError, "scene.ply", "0 % of the Gaussians", "cameras"):
        load_scene(folder, cameras=folder)
