"""What the views see of a state, and how well it shows what they show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from hypothesis import given, settings
from hypothesis import strategies as st
from view_batches import random_gaussians, room

from gsmerge import Cameras, Gaussians
from gsmerge.moments import feature_to_gaussians, scene_members, unaligned_members
from gsmerge.online.batch_photos import MARGIN, REACH, group_errors, groups_in_view, pixel_errors
from gsmerge.online.state import moments_of
from gsmerge.render import contributions, plan_view, prepare
from gsmerge.render.photos import photos_of
from gsmerge.types import FeatureGaussians


def features_of(gaussians: Gaussians) -> FeatureGaussians:
    return replace(scenes.make_features(gaussians.means), **moments_of(gaussians))


def corner_distances(cameras: Cameras, view: int, point: np.ndarray) -> list[float]:
    """How far inside the planes between rays through the picture's corners, and before the eye, a point is."""
    viewmat, K = cameras.viewmats[view], cameras.Ks[view]
    place = viewmat[:3, :3] @ point + viewmat[:3, 3]
    w, h, m = cameras.width, cameras.height, MARGIN
    corners = [
        np.linalg.inv(K) @ np.array([x, y, 1.0]) for x, y in ((-m, -m), (w + m, -m), (w + m, h + m), (-m, h + m))
    ]
    middle = np.linalg.inv(K) @ np.array([w / 2, h / 2, 1.0])
    actual = []
    for one, other in zip(corners, [*corners[1:], corners[0]], strict=True):
        normal = np.cross(one, other)
        normal /= np.linalg.norm(normal)
        actual.append(float(place @ normal) * (1 if middle @ normal > 0 else -1))
    return [*actual, float(place[2])]


@pytest.mark.parametrize("seed", [0, 1])
def test_in_view_of_a_ball_about_each(seed: int) -> None:
    """Balls against the pyramid of what a picture with some pixels about it shows, a plane after the other."""
    gaussians, cameras = random_gaussians(300, seed), scenes.arc(3, 32, 20)
    features = features_of(gaussians)
    actual = groups_in_view(features, cameras)
    assert actual.shape == (3, 300)
    assert 0.1 < actual.mean() < 0.9
    radii = REACH * np.sqrt(np.trace(features.covars.astype(np.float64), axis1=1, axis2=2))
    for view in range(3):
        for g in range(300):
            distances = np.array(corner_distances(cameras, view, features.means[g].astype(np.float64)))
            assert actual[view, g] == (distances > -radii[g]).all()


def test_in_view_of_one_group() -> None:
    cameras = scenes.arc(1, 32, 32, start=-0.5)  # a field of view of 53 degrees, from the zero along z
    places = [[0, 0, 3], [0, 0, -3], [0, 0, -0.01], [9, 0, 3], [0, -9, 3], [1.6, 0, 3], [0, 0, 300]]
    actual = groups_in_view(scenes.make_features(np.array(places, float), sizes=0.05), cameras)
    assert actual.tolist() == [[True, False, True, False, False, True, True]]


def test_nothing_is_in_view_of_nothing() -> None:
    assert groups_in_view(scenes.make_features(np.zeros((0, 3))), scenes.arc(2)).shape == (2, 0)


@given(
    seed=st.integers(0, 10_000),
    size=st.sampled_from([(0.0005, 0.01), (0.005, 0.1), (0.05, 0.5), (0.001, 0.5)]),
    shape=st.sampled_from([(24, 18), (40, 16), (17, 33)]),
    level=st.sampled_from([1, 2]),
)
@settings(max_examples=30, deadline=None, derandomize=True)
def test_what_is_drawn_is_in_view(seed: int, size: tuple[float, float], shape: tuple[int, int], level: int) -> None:
    """Every Gaussian that adds anything to any pixel, with the low-pass of the rasterizer, at either size."""
    gaussians, cameras = random_gaussians(200, seed, size=size), scenes.arc(2, *shape)
    actual = groups_in_view(features_of(gaussians), cameras)
    black = np.zeros((2, shape[1], shape[0], 3), np.float32)
    photos = photos_of(black, cameras, level)
    splats = prepare(gaussians)
    for view in range(2):
        plan = plan_view(splats, **photos.camera(view))
        peaks = contributions(plan)[1]
        drawn = np.flatnonzero(peaks > 0)
        assert len(drawn) > 0
        missed = drawn[~actual[view][drawn]]
        assert len(missed) == 0, (gaussians.means[missed], gaussians.scales[missed], peaks[missed])


def test_pixel_errors_by_hand() -> None:
    """Squared differences, and light that comes through."""
    scene = room(2)
    gaussians = scene.gaussians[:400]  # a part of the first view
    assert scene.images is not None
    pictures = photos_of(scene.images, scene.cameras)
    actual = pixel_errors(gaussians, pictures, 24, 36)
    images, alphas = scenes.images_of(gaussians, scene.cameras)
    expected = ((images.clip(0, 1) - scene.images.astype(np.float64)) ** 2).mean(-1) + (1 - alphas) ** 2
    np.testing.assert_allclose(actual, expected, atol=1e-4)
    assert actual.dtype == np.float32
    assert (actual[0, -4:] >= 1 - 1e-4).all()  # nothing is there
    assert actual[0, 4:8, 4:20].mean() < 0.2


def test_pixel_errors_of_another_size_repeat() -> None:
    scene = room(2)
    assert scene.images is not None
    pictures = photos_of(scene.images, scene.cameras, 2)
    small, large = (pixel_errors(scene.gaussians, pictures, h, w) for h, w in ((12, 18), (24, 36)))
    np.testing.assert_array_equal(small.repeat(2, 1).repeat(2, 2), large)


def test_nothing_shows_nothing() -> None:
    scene = room(1)
    assert scene.images is not None
    actual = pixel_errors(scene.gaussians[:0], photos_of(scene.images, scene.cameras), 24, 36)
    assert (actual >= 1).all()


def grouped(sizes: list[int], rows: np.ndarray) -> FeatureGaussians:
    """Groups of given sizes."""
    starts = np.concatenate([[0], np.cumsum(sizes)])
    features = scenes.make_features(np.zeros((len(sizes), 3)))
    return replace(features, starts=starts, members=rows)


def test_group_errors_against_a_loop() -> None:
    rng = np.random.default_rng(0)
    scene = room(2)
    rows = rng.permutation(2 * 36 * 24)[:60]
    sizes = [1, 5, 20, 30, 4]
    features, errors = grouped(sizes, rows), rng.random((2, 24, 36)).astype(np.float32)
    actual = group_errors(features, scene_members(scene), errors)
    first = 0
    for g, size in enumerate(sizes):
        pixels = [(row // 864, row % 864 // 36, row % 36) for row in rows[first : first + size]]
        assert actual[g] == pytest.approx(np.mean([errors[p] for p in pixels]), rel=1e-5)
        first += size


def test_members_of_no_pixel_count_as_fully_wrong() -> None:
    loose = scenes.take_views(room(2), [0, 1])
    pixels = np.array([-1, 5, -1, -1, 7, 40] + [0] * (len(loose.gaussians) - 6))
    from unaligned_scenes import loosened

    members = unaligned_members(loosened(loose), pixels)
    errors = np.zeros((2, 24, 36), np.float32)
    errors[0, 0, 5] = 0.5
    actual = group_errors(grouped([2, 2, 2], np.arange(6)), members, errors)
    np.testing.assert_allclose(actual, [0.75, 1.0, 0.0])


def test_groups_of_a_scene_show_their_own_pixels() -> None:
    """The errors of what is there are small, of half a scene large on the other half."""
    scene = room(2)
    assert scene.images is not None
    pictures = photos_of(scene.images, scene.cameras)
    whole = pixel_errors(scene.gaussians, pictures, 24, 36)
    half = pixel_errors(scene.gaussians[(scene.gaussians.means[:, 0] < 0)], pictures, 24, 36)
    rows = np.arange(2 * 864)
    right = rows[scene.gaussians.means[:, 0] > 0.4]
    features = grouped([len(right)], right)
    members = scene_members(scene)
    assert group_errors(features, members, whole)[0] < 0.05
    assert group_errors(features, members, half)[0] > 0.5
    assert feature_to_gaussians(features).means.shape == (1, 3)
