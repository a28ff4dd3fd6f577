"""Scenes of one place, each in its own frame and unit, are found in one another and joined."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from messages import names, refuses
from sharp_files import split_views
from tiny_scene import rotation

from gsmerge import Cameras, Gaussians, Scene, render
from gsmerge.errors import SceneError
from gsmerge.method.geometry.transforms import Similarity, camera_centres
from gsmerge.method.geometry.views import subset
from gsmerge.reading.alignment.registration import keypoints
from gsmerge.reading.alignment.registration.join import join_scenes, move_scene
from gsmerge.reading.alignment.registration.register import DIGITS, fit_similarities, register
from gsmerge.research.generate import GenerateOptions, NoiseOptions, make_synthetic_scene
from gsmerge.types import NO_CAMERAS, Pixels

VIEWS, WIDTH, HEIGHT = 6, 144, 96
SCALES = (1.1, 0.8, 1.25, 0.93, 1.0, 0.87)
PATHS = [Path(f"{name}.ply") for name in "abcdef"]


@cache
def made_scene(seed: int, views: int = VIEWS) -> Scene:
    """Return a photographed room with the depth errors of a network."""
    ranges = NoiseOptions(sh_degrees=(0,), constant_opacity=0.0, unit=(1.0, 1.0))
    options = GenerateOptions(views=views, width=WIDTH, height=HEIGHT, ranges=ranges)
    made = make_synthetic_scene(seed, 0, options)
    ids = Pixels.of_grid(np.ones((views, HEIGHT, WIDTH), bool))
    return Scene(made.gaussians, made.cameras, np.stack(made.images), ids, tuple("abcdef"[:views]))


@pytest.fixture(scope="module")
def place() -> Scene:
    return made_scene(2)


@pytest.fixture(scope="module")
def parts() -> list[Scene]:
    return split_views(made_scene(2), SCALES)


def test_registration_finds_the_views_up_to_a_similarity(place: Scene, parts: list[Scene]) -> None:
    """Within half a degree and one per cent of the truth, and the first file stays; three pairs take a second."""
    joined = join_scenes(parts[:3], PATHS[:3])
    assert joined.used == (0, 1, 2)
    true, found = place.cameras.viewmats[:3], joined.scene.cameras.viewmats
    centres = [camera_centres(poses)[None] for poses in (found, true)]
    _, scales, _ = fit_similarities(*centres, np.ones((1, 3)))
    # the rotation of all views at once, and what each is off by then
    turns = found[:, :3, :3].swapaxes(1, 2) @ true[:, :3, :3]
    u, _, v = np.linalg.svd(turns.sum(0))
    chords = np.linalg.norm(turns - u @ v, axis=(1, 2)) / np.sqrt(8)
    assert np.degrees(2 * np.arcsin(chords)).max() < 0.5
    apart = [one[0] - one[0].mean(0) for one in centres]
    missed = np.linalg.norm(scales[0] * apart[0] @ (u @ v) - apart[1], axis=1)
    assert missed.max() < 0.01 * np.linalg.norm(apart[1], axis=1).max()
    own = np.array([fact["scale"] for fact in joined.facts])
    assert np.abs(own * SCALES[:3] / SCALES[0] - 1).max() < 0.01
    assert np.array_equal(joined.scene.gaussians.means[: WIDTH * HEIGHT], parts[0].gaussians.means)
    assert np.array_equal(joined.scene.images, np.concatenate([part.images for part in parts[:3]]))
    assert joined.scene.names == ("a", "b", "c")
    assert names(joined.notes[0], "3 of 3", "a.ply")


@pytest.mark.slow
def test_a_view_of_another_place_is_left_out(parts: list[Scene]) -> None:
    stranger = split_views(made_scene(5, 2), SCALES[:2])[1]
    joined = join_scenes([stranger, *parts[:2]], PATHS[:3])
    assert joined.used == (1, 2)
    assert [fact["joined"] for fact in joined.facts] == [False, True, True]
    assert names(joined.notes[0], "2 of 3", "b.ply")
    assert joined.notes[1].startswith("a.ply ")
    with refuses(SceneError, "a.ply", "two of 2", "--images"):
        join_scenes([stranger, parts[0]], PATHS[:2])


@pytest.mark.slow
def test_files_of_several_views_are_joined(place: Scene) -> None:
    """Each with frame and unit of its own: two exports of one room."""
    turn, shift = rotation(0.5, -1.0, 2.2), np.array([4.0, -3, 2])
    other = move_scene(subset(place, [1, 3, 5]), Similarity(turn, 1.6, shift))
    joined = join_scenes([subset(place, [0, 2, 4]), other], PATHS[:2])
    true = place.cameras.viewmats[[0, 2, 4, 1, 3, 5]]
    assert abs(joined.facts[1]["scale"] * 1.6 - 1) < 0.01
    apart = camera_centres(joined.scene.cameras.viewmats) - camera_centres(true)
    assert np.linalg.norm(apart, axis=1).max() < 0.03


@pytest.mark.slow
def test_files_without_photos_are_joined_by_their_base_colours(parts: list[Scene]) -> None:
    bare = [replace(part, images=None) for part in parts[:2]]
    assert join_scenes(bare, PATHS[:2]).used == (0, 1)
    joined = join_scenes([bare[0], parts[1]], PATHS[:2])
    assert joined.scene.images is None
    assert "photos" in joined.notes[-1]


@pytest.mark.slow
def test_keypoints_moved_by_a_rounding_error_move_no_place(parts: list[Scene], monkeypatch: pytest.MonkeyPatch) -> None:
    """Places are rounded, and what moves keypoints by a rounding error moves no place."""
    places = register(parts[:2]).similarities
    assert places[1].scale == round(places[1].scale, DIGITS)

    def shaken(scene: Scene) -> list[keypoints.PhotoKeypoints]:
        found = keypoints.find_keypoints(scene)
        return [replace(each, pixels=each.pixels * (1 + 2e-16), points=each.points * (1 + 2e-16)) for each in found]

    monkeypatch.setattr("gsmerge.reading.alignment.registration.register.find_keypoints", shaken)
    other = register(parts[:2]).similarities[1]
    for name in ("rotation", "scale", "shift"):
        assert np.array_equal(getattr(other, name), getattr(places[1], name))


def test_finding_keypoints_leaves_the_settings_of_opencv(parts: list[Scene]) -> None:
    before = cv2.useOptimized()
    keypoints.find_keypoints(parts[0])
    assert cv2.useOptimized() == before


def test_files_that_cannot_be_joined_are_refused(parts: list[Scene]) -> None:
    unaligned = replace(parts[1], pixels=None)
    with refuses(SceneError, "b.ply", "1 camera", "no pixels"):
        join_scenes([parts[0], unaligned], PATHS[:2])
    bare = replace(unaligned, cameras=NO_CAMERAS, images=None, names=())
    with refuses(SceneError, "b.ply", "no cameras"):
        join_scenes([parts[0], bare], PATHS[:2])
    small = replace(parts[1].cameras, width=HEIGHT, height=WIDTH)
    pixels = Pixels.of_grid(np.ones((1, WIDTH, HEIGHT), bool))
    tall = replace(parts[1], cameras=small, images=parts[1].images.reshape(1, WIDTH, HEIGHT, 3), pixels=pixels)
    with refuses(SceneError, "b.ply", "144 x 96", "a.ply", "96 x 144"):
        join_scenes([parts[0], tall], PATHS[:2])
    g = parts[1].gaussians
    shiny = replace(parts[1], gaussians=replace(g, shN=np.zeros((len(g), 3, 3), np.float32)))
    with refuses(SceneError, "b.ply", "degree 0", "a.ply", 1):
        join_scenes([parts[0], shiny], PATHS[:2])


def test_similarities_of_exact_points_are_exact() -> None:
    rng = np.random.default_rng(0)
    p, turn, shift = rng.normal(size=(5, 4, 3)), rotation(0.4, -1.2, 2.0), np.array([3.0, -2, 1])
    rotations, scales, shifts = fit_similarities(p, 1.7 * p @ turn.T + shift, np.ones((5, 4)))
    assert np.allclose(rotations, turn)
    assert np.allclose(scales, 1.7)
    assert np.allclose(shifts, shift)


@pytest.mark.parametrize("degree", [0, 4])
def test_a_moved_scene_looks_the_same(degree: int) -> None:
    """Gaussians, harmonics and cameras move together."""
    rng, num = np.random.default_rng(1), (degree + 1) ** 2 - 1
    n = 24
    means = np.concatenate([rng.uniform(-1, 1, (n, 2)), rng.uniform(3, 5, (n, 1))], 1)
    quats = rng.normal(size=(n, 4))
    gaussians = Gaussians(
        means=means.astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=rng.uniform(0.1, 0.5, (n, 3)).astype(np.float32),
        opacities=rng.uniform(0.2, 0.9, n).astype(np.float32),
        sh0=rng.normal(size=(n, 1, 3)).astype(np.float32),
        shN=0.2 * rng.normal(size=(n, num, 3)).astype(np.float32),
    )
    K = np.array([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]])
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, 3] = (0.2, -0.1, 0.3)
    scene = Scene(gaussians, Cameras(poses, np.tile(K, (2, 1, 1)), 32, 24), None, None, ("a", "b"))
    moved = move_scene(scene, Similarity(rotation(0.5, -1.0, 2.2), 1.6, np.array([4.0, -3, 2])))
    before, after = (render(one.gaussians, one.cameras).images for one in (scene, moved))
    assert np.abs(before - after).max() < 2e-4
    if num:
        plain = render(replace(moved.gaussians, shN=gaussians.shN), moved.cameras).images
        assert np.abs(before - plain).max() > 0.02
