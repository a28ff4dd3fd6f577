"""Cameras in any other frame than the Gaussians are found by keypoints, and a mirrored scene is named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import scenes
from sweeps import sweep
from tiny_scene import rotation

from gsmerge import Cameras, Scene
from gsmerge.method.geometry.transforms import Similarity
from gsmerge.reading.alignment.registration.localise import find_frame
from gsmerge.reading.alignment.score import AlignmentInput
from gsmerge.reading.alignment.unaligned import check_cameras, is_mirrored, refine_frame

WIDTH, HEIGHT = 160, 120


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(6, WIDTH, HEIGHT))


def inputs_of(scene: Scene, cameras: Cameras) -> AlignmentInput:
    valid = np.ones(len(scene.gaussians), bool)
    return AlignmentInput(scene.gaussians, valid, cameras, np.asarray(scene.images))


def measure(inputs: AlignmentInput, frame: Similarity) -> float:
    cameras = frame.move_cameras(inputs.cameras)
    return check_cameras(inputs.gaussians, inputs.valid, cameras, inputs.images, foremost=True).color_ratio


def turned(cameras: Cameras, degrees: tuple[float, float, float], scale: float = 1.0) -> Cameras:
    """Return cameras of a world that was turned about its axes, scaled and shifted."""
    world = Similarity(rotation(*np.deg2rad(degrees)), scale, np.array([0.4, -0.2, 0.3]) * (scale != 1))
    return world.move_cameras(cameras)


@sweep(("degrees", "scale"), [((100.0, -30.0, 70.0), 1.7), ((5.0, 0.0, 2.0), 1.0)])
def test_cameras_of_a_turned_world_are_found(room: Scene, degrees: tuple[float, float, float], scale: float) -> None:
    cameras = turned(room.cameras, degrees, scale)
    inputs = inputs_of(room, cameras)
    frame, is_sure = find_frame(inputs, partial(measure, inputs), lambda frame: measure(inputs, frame) < 0.5)
    assert is_sure
    assert np.abs(frame.move_cameras(cameras).viewmats - room.cameras.viewmats).max() < 0.04  # a pixel is 0.012
    assert "rotated by" in frame.description


def test_photos_of_another_scene_show_no_frame(room: Scene) -> None:
    """Matches of wrong places are not refined."""
    other = scenes.make_scene([scenes.plane(3.0, scenes.waves(5))], scenes.arc(6, WIDTH, HEIGHT))
    inputs = inputs_of(replace(room, images=other.images), room.cameras)
    frame, _ = find_frame(inputs, partial(measure, inputs), lambda frame: pytest.fail("no match is right"))
    assert frame is None


def test_photos_without_anything_in_common_show_no_frame(room: Scene) -> None:
    rng = np.random.default_rng(0)
    noise = rng.random((6, HEIGHT // 4, WIDTH // 4, 3)).repeat(4, 1).repeat(4, 2).astype(np.float32)
    inputs = inputs_of(replace(room, images=noise), room.cameras)
    assert find_frame(inputs, partial(measure, inputs), lambda frame: True) == (None, True)
    inputs = inputs_of(replace(room, images=np.full_like(noise, 0.5)), room.cameras)  # too little to see
    assert find_frame(inputs, partial(measure, inputs), lambda frame: True) == (None, False)


def test_a_mirrored_scene_is_named(room: Scene) -> None:
    g = room.gaussians
    flipped = replace(g, means=g.means * np.float32([-1, 1, 1]), quats=g.quats * np.float32([1, 1, -1, -1]))
    assert is_mirrored(inputs_of(replace(room, gaussians=flipped), room.cameras))
    assert not is_mirrored(inputs_of(room, room.cameras))
    assert not is_mirrored(replace(inputs_of(room, room.cameras), images=np.zeros((0, HEIGHT, WIDTH, 3))))


@pytest.mark.parametrize("change", [lambda p: 0.5 * p, lambda p: 0.3 * p**2.2, lambda p: 1 - p, lambda p: p[::-1]])
def test_photos_that_look_otherwise_are_no_mirror(room: Scene, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Turned cameras that see nothing contradict no photo, and are no frame of a mirrored scene."""
    photos = change(np.asarray(room.images)).astype(np.float32)
    assert not is_mirrored(inputs_of(replace(room, images=photos), room.cameras))


@pytest.mark.slow
def test_a_frame_of_few_keypoints_is_refined() -> None:
    """Keypoints of small pictures find a frame that is wrong by a degree or more."""
    ball = scenes.ball((0.1, 0.05, 2.4), 0.4, scenes.waves(1, rate=40.0))
    room = scenes.make_scene([ball, scenes.plane(3.0, scenes.waves(0, rate=40.0))], scenes.arc(4, WIDTH, HEIGHT))
    middle = np.median(room.gaussians.means, 0)
    turn = rotation(*np.deg2rad([0.6, -0.5, 0.3]))
    world = Similarity(turn, 1.008, middle - 1.008 * turn @ middle + [0.004, 0, -0.01])
    inputs = inputs_of(room, world.move_cameras(room.cameras))
    rough = Similarity(np.eye(3), 1.0, np.zeros(3))
    frame = refine_frame(inputs, rough, partial(measure, inputs))
    errors = [np.abs(one.move_cameras(inputs.cameras).viewmats - room.cameras.viewmats).max() for one in (rough, frame)]
    assert errors[0] > 0.02
    assert errors[1] < errors[0] / 3
    true = Similarity(turn.T, 1 / 1.008, -turn.T @ world.shift / 1.008)
    assert refine_frame(inputs, true, partial(measure, inputs)) is true  # it explains the photos as it is
