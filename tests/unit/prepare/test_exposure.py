"""Some exposures are to be compensated, and others are better left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import Scene
from gsmerge.method.geometry.frame import canonicalise
from gsmerge.method.geometry.transforms import camera_distances
from gsmerge.method.kernels import elementary
from gsmerge.prepare.exposure import (
    FOLLOWS,
    UNEXPECTED,
    equalise_exposure,
    is_metered,
    root_mean_square,
    share_unexpected,
)
from gsmerge.prepare.photo_change import CLIPPED
from gsmerge.prepare.surfaces import FARTHER_VIEWS, NEAREST_VIEWS, choose_partners
from gsmerge.prepare.true_pixels import with_pixels
from gsmerge.runtime.record import record_run

VIEWS = range(5)


def grey(*gains: float) -> np.ndarray:
    """Return the same logarithmic gain for red, green and blue."""
    return np.repeat(np.array(gains)[:, None], 3, 1)


def row(count: int) -> np.ndarray:
    """Return distances of cameras side by side."""
    return np.abs(np.subtract.outer(np.arange(count), np.arange(count))).astype(float)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return canonicalise(scenes.make_scene(scenes.room(), scenes.arc(len(VIEWS), 64, 48)))[0]


def test_size_of_gains_is_their_root_mean_square() -> None:
    assert root_mean_square(grey(0.9, 1.1)) == pytest.approx(0.1)


def test_each_of_few_views_is_compared_with_all_others_and_of_many_with_some() -> None:
    few, many = choose_partners(row(NEAREST_VIEWS + FARTHER_VIEWS + 1)), choose_partners(row(200))
    assert all(sorted({*others, view}) == list(range(len(few))) for view, others in enumerate(few.tolist()))
    assert many.shape == (200, NEAREST_VIEWS + FARTHER_VIEWS)
    assert set(range(100 - NEAREST_VIEWS // 2, 101 + NEAREST_VIEWS // 2)) - {100} <= set(many[100])
    assert many[100].min() == 0  # some are far away
    assert (np.diff(many) > 0).all()


def test_gains_of_many_views_are_solved_from_some_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("NEAREST_VIEWS", "FARTHER_VIEWS"):
        monkeypatch.setattr(f"gsmerge.prepare.surfaces.{name}", 4)
    count = 16
    scene, _ = canonicalise(scenes.make_scene(scenes.room(), scenes.arc(count, 24, 16)))
    gains = grey(*np.random.default_rng(0).uniform(-0.2, 0.2, count))
    images = (scene.images * elementary.exp(gains)[:, None, None]).clip(0, 1).astype(np.float32)
    with record_run() as record:
        equalise_exposure(replace(scene, images=images), range(count), "per-photo")
    solved = elementary.log(np.array(record.choices["exposure"]))
    np.testing.assert_allclose(solved - solved.mean(0), gains - gains.mean(0), atol=0.03)


def test_gains_that_follow_the_light_of_places_are_metered() -> None:
    places, gains = grey(-0.4, 0.1, 0.3, 0.0), grey(0.1, -0.2, 0.3, -0.2)
    assert is_metered(np.zeros((4, 3)), -places)
    assert is_metered(places - 0.9 * places, -0.9 * places)
    assert not is_metered(places + gains, gains)  # whatever the places
    assert not is_metered(gains, gains)


def test_gains_that_make_up_for_half_of_the_light_are_metered() -> None:
    places = grey(-0.4, 0.1, 0.3, 0.0)
    slopes = [(-share * (1 - share)) / share**2 for share in (0.5, 0.7)]  # photos brighter where gains are lower
    assert max(slopes) < FOLLOWS
    assert all(is_metered((1 - share) * places, -share * places) for share in (0.5, 0.7))


def test_drift_of_exposure_is_expected_unlike_a_change_at_every_photo() -> None:
    for count in (4, 5, 12):
        assert share_unexpected(grey(*np.linspace(-1, 1, count)), row(count)) < UNEXPECTED
        assert share_unexpected(grey(*[0.2, -0.2] * (count // 2)), row(count // 2 * 2)) > 1
    gains = np.random.default_rng(0).normal(size=(2000, 3))
    assert share_unexpected(gains, row(2000)) == pytest.approx(1, abs=0.05)


def test_two_views_say_nothing_of_drift() -> None:
    assert share_unexpected(grey(0.2, -0.2), row(2)) >= 1


def test_distance_of_cameras_counts_place_and_direction() -> None:
    poses = [scenes.look_at(np.array([x, 0.0, 0.0]), np.array([x, 0.0, z])) for x, z in ((0, 1), (2, 1), (0, -1))]
    cameras = scenes.Cameras(np.stack(poses), scenes.intrinsics(3, 8, 8), 8, 8)
    np.testing.assert_allclose(camera_distances(cameras), [[0, 2, 2], [2, 0, 4], [2, 4, 0]], atol=1e-9)


def test_small_gains_are_left_without_a_word(scene: Scene) -> None:
    assert equalise_exposure(scene, VIEWS, "auto") == (scene, "")


def test_clipped_pixels_do_not_count_where_other_photos_show_more(scene: Scene) -> None:
    gains = elementary.exp(grey(0.4, -0.1, -0.1, -0.1, -0.1))[:, None, None]
    images = (gains * scene.images).clip(0, 1).astype(np.float32)
    masks = equalise_exposure(replace(scene, images=images), VIEWS, "per-photo")[0].masks
    clipped = (images[0] >= CLIPPED).any(-1)
    assert masks[0, clipped].mean() < 0.1  # borders and edges are seen by no other
    assert masks[0, ~clipped].all()
    assert masks[1:].all()


def test_photos_beside_gaussians_of_no_pixels_are_brought_to_one_exposure(scene: Scene) -> None:
    factors = elementary.exp(np.array([0.25, -0.2, 0.2, -0.25, 0.0]))[:, None, None, None].astype(np.float32)
    points = with_pixels(replace(scene, pixels=None))
    images = (0.6 * scene.images * factors).clip(0, 1)
    even, change = equalise_exposure(replace(points, images=images), VIEWS, "auto")
    assert even.gaussians is points.gaussians
    assert "photos are brought to their mean exposure" in change
    bright = scene.images > 0.2  # noise of the darkest levels counts nowhere
    ratios = (even.images / np.maximum(scene.images, 0.05))[bright]
    np.testing.assert_allclose(ratios / np.median(ratios), 1, atol=0.05)
