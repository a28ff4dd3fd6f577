"""Depths of Gaussians or of depth maps: those that other views confirm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import intrinsics, look_at, make_scene, room

from gsmerge.alignment import choose_depths
from gsmerge.geometry import camera_centres, camera_depths
from gsmerge.kernels.elementary import cos, sin
from gsmerge.types import Cameras, Scene

VIEWS, WIDTH, HEIGHT = 5, 64, 48
EYES = np.array([[-0.7, 0.2, 0], [-0.3, -0.3, 0.7], [0, 0.3, -0.6], [0.4, -0.2, 0.4], [0.8, 0.1, -0.2]])


def scene_from(eyes: np.ndarray) -> tuple[Scene, np.ndarray, np.ndarray]:
    """A right scene, its depth maps ``[v,hw]`` along z and the distances."""
    poses = np.stack([look_at(eye, np.array([0.0, 0.0, 3.0])) for eye in eyes])
    scene = make_scene(room(), Cameras(poses, intrinsics(len(eyes), WIDTH, HEIGHT), WIDTH, HEIGHT))
    means = scene.gaussians.means.reshape(len(eyes), -1, 3)
    distances = np.linalg.norm(means - camera_centres(poses)[:, None], axis=2)
    return scene, camera_depths(means, poses[:, None]), distances


RIGHT, MAPS, LENGTHS = scene_from(EYES)
ALONG = MAPS / LENGTHS  # what a depth along z becomes, taken as the distance
BY_VIEW = np.array([1.1, 0.9, 1.05, 0.95, 1.1])[:, None] * np.ones_like(MAPS)


def moved_by(factors: np.ndarray, scene: Scene = RIGHT) -> Scene:
    """The right scene with each Gaussian so many times as far from its camera."""
    g, centres = scene.gaussians, camera_centres(scene.cameras.viewmats)[:, None]
    means = centres + (g.means.reshape(len(scene), -1, 3) - centres) * factors[..., None]
    scales = (g.scales * factors.reshape(-1, 1)).astype(np.float32)
    return replace(scene, gaussians=replace(g, means=means.reshape(-1, 3), scales=scales))


def maps_of(factors: np.ndarray | float = 1.0) -> np.ndarray:
    return (MAPS * factors).reshape(VIEWS, HEIGHT, WIDTH)


@pytest.mark.parametrize("photos", [True, False])
@pytest.mark.parametrize("factors", [ALONG, BY_VIEW, ALONG * BY_VIEW], ids=["along", "by view", "both"])
def test_gaussians_are_wrong(factors: np.ndarray, photos: bool) -> None:
    scene = moved_by(factors) if photos else replace(moved_by(factors), images=None)
    chosen, count = choose_depths(scene, maps_of(1.7), 1 / 1.7)
    assert count == len(scene.gaussians)
    assert np.allclose(chosen.gaussians.means, RIGHT.gaussians.means, atol=1e-4)
    assert np.allclose(chosen.gaussians.scales, RIGHT.gaussians.scales, rtol=1e-4)


def test_unit_of_the_maps_is_not_that_of_the_cameras() -> None:
    factors = BY_VIEW / np.median(BY_VIEW)
    chosen, count = choose_depths(moved_by(factors), maps_of(1.7), 1.0)
    assert count == 4 * WIDTH * HEIGHT  # one view is as far off as the median is
    assert np.allclose(chosen.gaussians.means, RIGHT.gaussians.means, atol=1e-4)


@pytest.mark.parametrize("factors", [1.0, 1.01, ALONG, BY_VIEW], ids=["same", "nearly", "along", "by view"])
def test_right_gaussians_stay(factors: np.ndarray | float) -> None:
    """Bit for bit: the scene itself is returned."""
    chosen, count = choose_depths(RIGHT, maps_of(factors), 1.0)
    assert chosen is RIGHT
    assert count == 0


def test_one_view_is_wrong() -> None:
    factors = np.ones_like(MAPS)
    factors[2] = 1.1
    chosen, count = choose_depths(moved_by(factors), maps_of(), 1.0)
    assert count == WIDTH * HEIGHT
    assert np.allclose(chosen.gaussians.means, RIGHT.gaussians.means, atol=1e-4)


@pytest.mark.slow
def test_many_views_with_little_parallax() -> None:
    """The nearest views of a film hardly contradict any depth: those farther away are asked, too."""
    t = np.linspace(-1, 1, 40)
    scene, maps, distances = scene_from(np.stack([0.9 * t, 0.2 * sin(3 * t), 0.4 * cos(4 * t)], 1))
    wrong = moved_by(maps / distances, scene)
    _, count = choose_depths(wrong, maps.reshape(40, HEIGHT, WIDTH), 1.0)
    assert count == len(wrong.gaussians)


def test_each_is_wrong_in_half_of_the_pixels() -> None:
    """Most of the wrong half of the Gaussians is placed anew, and hardly any of the right one."""
    left = np.tile(np.arange(WIDTH) < WIDTH // 2, HEIGHT)
    wrong = moved_by(np.where(left, BY_VIEW, 1))
    chosen, _ = choose_depths(wrong, maps_of(np.where(left, 1, BY_VIEW)), 1.0)
    placed = (chosen.gaussians.means != wrong.gaussians.means).any(1).reshape(VIEWS, -1)
    assert placed[:, left].mean() > 0.6
    assert placed[:, ~left].mean() < 0.05


def test_maps_without_depths_are_left_alone() -> None:
    scene, nowhere = moved_by(ALONG), maps_of()
    nowhere[:, :20] = np.nan
    nowhere[:, 20:40] = 0
    nowhere[:, 40:] = np.inf
    assert choose_depths(scene, nowhere, 1.0) == (scene, 0)
    some = maps_of()
    some[:, :20] = np.nan
    chosen, count = choose_depths(scene, some, 1.0)
    assert count == VIEWS * (HEIGHT - 20) * WIDTH
    assert np.isfinite(chosen.gaussians.means).all()
