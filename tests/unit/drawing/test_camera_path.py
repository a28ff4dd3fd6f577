"""Cameras of a video stand along a spline or an orbit through the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from messages import refuses
from sweeps import sweep

from gsmerge.drawing.camera_path import (
    HORIZONTAL,
    VERTICAL,
    CameraPath,
    median_camera,
    orbit,
    outside_camera,
    parse_camera_path,
    sample_path,
    spline,
    viewing_depth,
)
from gsmerge.method.geometry.transforms import camera_centres, motion_matrices, project
from gsmerge.method.kernels import elementary
from gsmerge.scoring.fog import fog_cameras
from gsmerge.types import Cameras

DEPTH = 3.0


def make_cameras(centres: Sequence[Sequence[float]], turns: Sequence[Sequence[float]]) -> Cameras:
    """Make cameras at places in the world, turned by rotation vectors (radians)."""
    viewmats = motion_matrices(-np.concatenate([turns, np.zeros((len(turns), 3))], 1))
    viewmats[:, :3, 3] = -(viewmats[:, :3, :3] * np.asarray(centres)[:, None]).sum(-1)
    K = np.array([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]])
    return Cameras(viewmats, np.tile(K, (len(centres), 1, 1)), 32, 24)


@pytest.fixture
def walk() -> Cameras:
    """Make six cameras at uneven distances on a winding way, which turn by more than half a turn."""
    places = [[0, 0, 0], [0.2, 0.1, 0.5], [1, 0, 1], [2.5, -0.1, 1.1], [3, 0, 2], [3, 0.2, 2.3]]
    turns = [[0, 0, 0], [0, 0.4, 0], [0.1, 1.2, 0], [0, 1.8, 0.1], [0, 2.7, 0], [0, 3.6, 0]]
    return make_cameras(places, turns)


def angles_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return angles (radians) between rotations ``[n,4,4]``."""
    cosines = ((a[:, :3, :3] * b[:, :3, :3]).sum((1, 2)) - 1) / 2
    return elementary.arccos(cosines.clip(-1, 1))


def step_lengths(path: Cameras, depth: float = DEPTH) -> np.ndarray:
    """Return how far each camera is from the one before, turns by what they move at the depth."""
    shifts = np.linalg.norm(np.diff(camera_centres(path.viewmats), axis=0), axis=1)
    turns = angles_between(path.viewmats[1:], path.viewmats[:-1])
    return np.sqrt(shifts**2 + (depth * turns) ** 2)


def test_a_spline_passes_through_all_cameras_at_even_speed(walk: Cameras) -> None:
    path = spline(walk, DEPTH, 400)
    np.testing.assert_allclose(path.viewmats[[0, -1]], walk.viewmats[[0, -1]], atol=1e-12)
    steps = step_lengths(path)
    assert steps.max() / steps.min() < 1.03
    for viewmat in walk.viewmats:
        away = np.linalg.norm(camera_centres(path.viewmats) - camera_centres(viewmat), axis=1)
        turned = angles_between(path.viewmats, np.broadcast_to(viewmat, path.viewmats.shape))
        assert np.hypot(away, DEPTH * turned).min() <= 0.6 * steps.max()


def test_a_spline_has_no_corners(walk: Cameras) -> None:
    steps = np.diff(camera_centres(spline(walk, DEPTH, 1000).viewmats), axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    assert (steps[1:] * steps[:-1]).sum(1).min() > 0.995
    straight = np.diff(camera_centres(walk.viewmats), axis=0)
    straight /= np.linalg.norm(straight, axis=1, keepdims=True)
    assert (straight[1:] * straight[:-1]).sum(1).min() < 0.8  # while the way itself has some


def test_a_spline_of_cameras_that_only_turn_turns_evenly() -> None:
    turns = [[0, 0.0, 0], [0, 0.3, 0], [0, 1.5, 0], [0, 1.7, 0]]
    path = spline(make_cameras(np.tile([1.0, 2, 3], (4, 1)).tolist(), turns), DEPTH, 35)
    np.testing.assert_allclose(camera_centres(path.viewmats), np.tile([1, 2, 3], (35, 1)), atol=1e-12)
    np.testing.assert_allclose(angles_between(path.viewmats[1:], path.viewmats[:-1]), 1.7 / 34, rtol=0.01)
    assert np.allclose(path.viewmats[:, 1, :3], [0, 1, 0])  # upright between upright ones


def test_repeated_cameras_count_once_in_a_spline(walk: Cameras) -> None:
    path = spline(walk[[0, 0, 1, 2, 3, 3, 3, 4, 5]], DEPTH, 50)
    np.testing.assert_allclose(path.viewmats, spline(walk, DEPTH, 50).viewmats, atol=1e-12)


def test_a_spline_of_one_camera_is_refused(walk: Cameras) -> None:
    with refuses(ValueError, "spline", 2, 1):
        spline(walk[[2, 2, 2]], DEPTH, 50)


def test_a_spline_of_two_cameras_runs_straight_between_them(walk: Cameras) -> None:
    two = walk[[0, 2]]
    two.Ks[1, 0, 0] = 80
    path = spline(two, DEPTH, 5)
    line = np.linspace([0, 0, 0], [1, 0, 1], 5)
    np.testing.assert_allclose(camera_centres(path.viewmats), line, atol=0.01)
    np.testing.assert_allclose(path.Ks[:, 0, 0], np.linspace(40, 80, 5), atol=0.3)
    assert (path.width, path.height) == (32, 24)


def test_a_spline_far_from_the_origin_is_the_same(walk: Cameras) -> None:
    shift = np.array([3e6, -5e6, 100.0])
    far = replace(walk, viewmats=walk.viewmats.copy())
    far.viewmats[:, :3, 3] -= (far.viewmats[:, :3, :3] * shift).sum(-1)
    moved = camera_centres(spline(far, DEPTH, 40).viewmats) - shift
    np.testing.assert_allclose(moved, camera_centres(spline(walk, DEPTH, 40).viewmats), atol=1e-6)


@sweep("count", [60, 2, 7])
def test_an_orbit_goes_evenly_around_the_middle_it_looks_at(walk: Cameras, count: int) -> None:
    path = orbit(walk, DEPTH, count)
    centres = camera_centres(path.viewmats)
    home = walk.viewmats[median_camera(walk)]
    focus = camera_centres(home) + DEPTH * home[2, :3]
    pixels, depths = project(focus[None], path)
    np.testing.assert_allclose(pixels[:, 0], np.tile([16.0, 12], (count, 1)), atol=1e-9)
    assert (depths > 0.9 * DEPTH).all()
    np.testing.assert_allclose((path.viewmats[:, 0, :3] * home[1, :3]).sum(1), 0, atol=1e-12)
    assert ((path.viewmats[:, 1, :3] * home[1, :3]).sum(1) > 0.9).all()
    assert np.linalg.det(path.viewmats[:, :3, :3]) == pytest.approx(1)
    if count > 2:
        steps = np.linalg.norm(centres - np.roll(centres, 1, 0), axis=1)
        assert steps.max() / steps.min() < (1.01 if count > 50 else 1.2)


@sweep(("apart", "radius"), [(0.0, HORIZONTAL[0] * DEPTH), (0.5, 0.5), (9.0, HORIZONTAL[1] * DEPTH)], often=2)
def test_an_orbit_is_as_wide_as_the_cameras_stand_within_limits(apart: float, radius: float) -> None:
    places = [[-apart, 0, 0], [0, 0, 0], [apart, 0, 0]]
    cameras = make_cameras(places, np.zeros((3, 3)).tolist())
    centres = camera_centres(orbit(cameras, DEPTH, 100).viewmats)
    assert median_camera(cameras) == (1 if apart else 0)
    assert np.abs(centres).max(0)[:2] == pytest.approx([radius, VERTICAL[0] * DEPTH], rel=0.01)


def test_the_median_camera_is_not_one_that_looks_elsewhere() -> None:
    places = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [1.1, 0, 0]]
    turns = [[0, 0, 0], [0, 3, 0], [0, 0.1, 0], [0, 0.1, 0]]
    assert median_camera(make_cameras(places, turns)) == 3


@sweep("turn", [90.0, 20.0])
def test_an_orbit_of_an_angle_turns_by_it_at_one_distance(walk: Cameras, turn: float) -> None:
    path = orbit(walk, DEPTH, 60, turn)
    home = walk.viewmats[median_camera(walk)]
    centres, focus = camera_centres(path.viewmats), camera_centres(home) + DEPTH * home[2, :3]
    np.testing.assert_allclose(np.linalg.norm(centres - focus, axis=1), DEPTH)
    np.testing.assert_allclose(project(focus[None], path)[0][:, 0], np.tile([16.0, 12], (60, 1)), atol=1e-9)
    np.testing.assert_allclose((path.viewmats[:, 0, :3] * home[1, :3]).sum(1), 0, atol=1e-12)  # upright
    x, y, z = ((path.viewmats[:, 2, :3] * axis).sum(1) for axis in home[:3, :3])
    assert np.degrees(np.arctan2(x, z)).max() == pytest.approx(turn, rel=0.01)
    assert np.degrees(np.arcsin(np.abs(y))).max() == pytest.approx(turn / 2, rel=0.01)
    steps = np.linalg.norm(centres - np.roll(centres, 1, 0), axis=1)
    assert steps.max() / steps.min() < 1.01


@sweep("kind", ["orbit:30", "spline", "orbit"], often=2)
def test_a_path_that_steps_back_keeps_its_directions(kind: str, walk: Cameras) -> None:
    path, back = (sample_path(parse_camera_path(text), walk, DEPTH, 20) for text in (kind, f"{kind},back:0.5"))
    if kind == "spline":  # even speed is another one farther away: the ends are the same cameras
        path, back = path[[0, -1]], back[[0, -1]]
    np.testing.assert_allclose(back.viewmats[:, :3, :3], path.viewmats[:, :3, :3], atol=1e-12)
    shifts = camera_centres(back.viewmats) - camera_centres(path.viewmats)
    np.testing.assert_allclose(shifts, -0.5 * DEPTH * path.viewmats[:, 2, :3], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "path"),
    [
        ("orbit", CameraPath("orbit")),
        ("orbit:45", CameraPath("orbit", 45)),
        ("orbit:7.5,back:0.5", CameraPath("orbit", 7.5, 0.5)),
        ("spline,back:2", CameraPath("spline", None, 2)),
        ("orbits.json", None),
        ("orbit.json", None),
        ("room/orbit:45", None),
    ],
)
def test_camera_paths_are_read_from_text(text: str, path: CameraPath | None) -> None:
    assert parse_camera_path(text) == path


@pytest.mark.parametrize(
    ("text", "place", "found"),
    [
        ("orbit:", "path, orbit", "''"), ("orbit:0", "path, orbit", "'0'"), ("orbit:90.5", "path, orbit", "'90.5'"),
        ("orbit:nan", "path, orbit", "'nan'"), ("orbit,back:-1", "path, back", "'-1'"),
        ("spline,back:inf", "path, back", "'inf'"), ("orbit,back=1", "path", "orbit,back=1"),
        ("orbit:9,back:1,back:1", "path", "orbit[:DEGREES][,back:SHARE]"), ("spline:9", "path", "spline:9"),
    ],
)  # fmt: skip
def test_impossible_camera_paths_are_refused(text: str, place: str, found: str) -> None:
    with refuses(ValueError, place, found):
        parse_camera_path(text)


def test_the_camera_outside_is_one_that_fog_is_measured_with(walk: Cameras) -> None:
    middle = walk[[median_camera(walk)] * 3]
    means = np.random.default_rng(1).uniform(-4, 4, (500, 3)).astype(np.float32)
    camera, distance = outside_camera(middle, means)
    assert distance == pytest.approx(1.5 * viewing_depth(middle, means))
    given = SimpleNamespace(means=means)
    assert any(np.array_equal(camera.viewmats, one.viewmats) for _, one, _ in fog_cameras(given, middle))


@sweep("kind", ["orbit:40", "spline,back:0.5", "orbit"], often=2)
def test_a_path_moves_with_its_scene(kind: str, walk: Cameras) -> None:
    means = np.random.default_rng(1).uniform(-4, 4, (500, 3))
    motion = motion_matrices(np.array([[0.3, -1.1, 0.7, 4, -2, 1]]))[0]
    moved = replace(walk, viewmats=walk.viewmats @ np.linalg.inv(motion))
    path = sample_path(parse_camera_path(kind), walk, viewing_depth(walk, means), 30)
    depth = viewing_depth(moved, means @ motion[:3, :3].T + motion[:3, 3])
    other = sample_path(parse_camera_path(kind), moved, depth, 30)
    np.testing.assert_allclose(other.viewmats @ motion, path.viewmats, atol=1e-9)


def test_a_path_of_one_frame_is_refused(walk: Cameras) -> None:
    with refuses(ValueError, "frames", 2, 1):
        sample_path(CameraPath("orbit"), walk, DEPTH, 1)
