"""A batch against a state: what is in view and how well it is shown, colours batch by batch, photos that are kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from hypothesis import given, settings
from hypothesis import strategies as st
from unaligned_scenes import without_order
from view_batches import fed, random_gaussians, room, same_group, state_of

from gsmerge import Cameras, Gaussians, Scene
from gsmerge.fit import FitOptions
from gsmerge.fit.color import Drawn, draw, fit_colors
from gsmerge.pooling import feature_to_gaussians, scene_members, unaligned_members
from gsmerge.raster import contributions, prepare, tile_view
from gsmerge.raster.photos import Photos, photos_of, scene_photos
from gsmerge.raster.weights import apply
from gsmerge.states.groups import moments_of, share
from gsmerge.states.state import GroupSet, Replay
from gsmerge.states.view_batch import (
    BatchPhotos,
    fit_batch_colors,
    group_errors,
    groups_in_view,
    pixel_errors,
    resize_photos,
    update_replay,
    view_ids,
)
from gsmerge.types import SH_C0, FeatureGaussians


def features_of(gaussians: Gaussians) -> FeatureGaussians:
    return replace(scenes.make_features(gaussians.means), **moments_of(gaussians))


@given(
    seed=st.integers(0, 10_000),
    size=st.sampled_from([(0.0005, 0.01), (0.005, 0.1), (0.05, 0.5), (0.001, 0.5)]),
    shape=st.sampled_from([(24, 18), (40, 16), (17, 33)]),
    level=st.sampled_from([1, 2]),
)
@settings(max_examples=12, deadline=None, derandomize=True)
def test_what_is_drawn_is_in_view(seed: int, size: tuple[float, float], shape: tuple[int, int], level: int) -> None:
    """Every Gaussian that adds anything to any pixel, with the low-pass of the rasterizer, at either size."""
    gaussians, cameras = random_gaussians(200, seed, size=size), scenes.arc(2, *shape)
    actual = groups_in_view(features_of(gaussians), cameras)
    black = np.zeros((2, shape[1], shape[0], 3), np.float32)
    photos = photos_of(black, cameras, level)
    splats = prepare(gaussians)
    for view in range(2):
        tiled = tile_view(splats, **photos.camera(view))
        peaks = contributions(tiled)[1]
        drawn = np.flatnonzero(peaks > 0)
        assert len(drawn) > 0
        missed = drawn[~actual[view][drawn]]
        assert len(missed) == 0, (gaussians.means[missed], gaussians.scales[missed], peaks[missed])


def test_what_is_behind_or_beside_is_not_in_view() -> None:
    cameras = scenes.arc(2)
    places = cameras.centres[0] + np.array([[0, 0, 3], [0, 0, -3], [9, 0, 3], [0, 9, 3]])
    gaussians = replace(random_gaussians(4, 0), means=places.astype(np.float32))
    assert groups_in_view(features_of(gaussians), cameras)[0].tolist() == [True, False, False, False]
    assert groups_in_view(scenes.make_features(np.zeros((0, 3))), cameras).shape == (2, 0)


def test_pixel_errors_by_hand() -> None:
    """Squared differences, and light that comes through."""
    scene = room(2)
    gaussians = scene.gaussians[:400]  # a part of the first view
    pictures = photos_of(scene.images, scene.cameras)
    actual = pixel_errors(gaussians, pictures, 24, 36)
    images, alphas = scenes.images_of(gaussians, scene.cameras)
    expected = ((images.clip(0, 1) - scene.images.astype(np.float64)) ** 2).mean(-1) + (1 - alphas) ** 2
    np.testing.assert_allclose(actual, expected, atol=1e-4)
    assert actual.dtype == np.float32
    assert (actual[0, -4:] >= 1 - 1e-4).all()  # nothing is there
    assert actual[0, 4:8, 4:20].mean() < 0.2


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
    unaligned = scenes.take_views(room(2), [0, 1])
    pixels = np.array([-1, 5, -1, -1, 7, 40] + [0] * (len(unaligned.gaussians) - 6))
    members = unaligned_members(without_order(unaligned), pixels)
    errors = np.zeros((2, 24, 36), np.float32)
    errors[0, 0, 5] = 0.5
    actual = group_errors(grouped([2, 2, 2], np.arange(6)), members, errors)
    np.testing.assert_allclose(actual, [0.75, 1.0, 0.0])


FEW = FitOptions(holdout=0.05)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return room(6)


@pytest.fixture(scope="module")
def groups(scene: Scene) -> GroupSet:
    """Groups of all views, their colours off by a little."""
    actual = share(state_of(fed([scene], fit_colors=False))).groups
    noise = np.random.default_rng(0).normal(0, 0.1 / SH_C0, actual.features.sh0.shape).astype(np.float32)
    sh0 = actual.features.sh0 + noise
    return replace(actual, features=replace(actual.features, sh0=sh0), colors=replace(actual.colors, sh0=sh0))


@pytest.fixture(scope="module")
def batch_photos(scene: Scene) -> BatchPhotos:
    """Photos, in the state's own frame, with noise of their own."""
    state = state_of(fed([scene], fit_colors=False))
    rng = np.random.default_rng(0)
    images = scene.images + rng.normal(0, 0.15, scene.images.shape).astype(np.float32)
    return BatchPhotos(images.clip(0, 1), state.cameras)


def some(batch_photos: BatchPhotos, *views: int) -> BatchPhotos:
    return BatchPhotos(batch_photos.images[list(views)], batch_photos.cameras[list(views)])


def rms(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.sqrt(((SH_C0 * (one - other)) ** 2).mean()))


@pytest.fixture(scope="module")
def drawn(groups: GroupSet, scene: Scene) -> tuple[Gaussians, Photos, Drawn]:
    gaussians = state_of(fed([scene], fit_colors=False)).frame.leave(feature_to_gaussians(groups.features))
    photos = scene_photos(scene, 2)
    return gaussians, photos, draw(gaussians, photos)


def test_what_is_held_fast_stays(drawn: tuple[Gaussians, Photos, Drawn]) -> None:
    gaussians, photos, views = drawn
    precision = np.full(len(gaussians), 1e9)
    assert rms(fit_colors(gaussians, views, photos, FEW, 0, precision)[0].sh0, gaussians.sh0) < 1e-6
    precision[::2] = 0
    actual, report = fit_colors(gaussians, views, photos, FEW, 0, precision)
    assert report.accepted
    assert rms(actual.sh0[1::2], gaussians.sh0[1::2]) < 1e-6
    assert rms(actual.sh0[::2], gaussians.sh0[::2]) > 0.02


def dense(view: object, column: int, count: int) -> np.ndarray:
    """One column of a view's blending weights."""
    one = np.zeros((count, 1), np.float32)
    one[column] = 1
    return apply(view, one).reshape(-1).astype(np.float64)


def test_only_colours_in_view_and_what_holds_them_change(groups: GroupSet, batch_photos: BatchPhotos) -> None:
    one, means = some(batch_photos, 0), groups.features.means.copy()
    means[[3, 50]] += 30
    groups = replace(groups, features=replace(groups.features, means=means))
    actual, report = fit_batch_colors(groups, one, FEW)
    assert report.accepted
    seen = groups_in_view(groups.features, one.cameras)[0]
    assert 0 < seen.sum() < len(groups)
    for row in np.flatnonzero(~seen):
        assert same_group(actual, int(row), groups, int(row))
    np.testing.assert_array_equal(actual.features.sh0, groups.features.sh0)
    assert scenes.identical(actual.children, groups.children)
    assert (actual.colors.precision[seen] >= groups.colors.precision[seen]).all()
    assert float(actual.colors.precision.sum()) > 0


def test_what_is_held_is_the_diagonal_of_the_equations(groups: GroupSet, batch_photos: BatchPhotos) -> None:
    """Squares of the blending weights in half-size photos."""
    actual, _ = fit_batch_colors(groups, batch_photos, FEW)
    views = draw(replace(feature_to_gaussians(groups.features), sh0=groups.colors.sh0), batch_photos.photos(2)).views
    for g in range(0, len(groups), 7):
        expected = sum(float((dense(view, g, len(groups)) ** 2).sum()) for view in views)
        assert float(actual.colors.precision[g]) == pytest.approx(expected, rel=1e-3, abs=1e-5)
    twice, _ = fit_batch_colors(actual, batch_photos, FEW)
    np.testing.assert_allclose(twice.colors.precision, 2 * actual.colors.precision, rtol=1e-5)


def test_one_batch_after_the_other_is_near_all_at_once(groups: GroupSet, batch_photos: BatchPhotos) -> None:
    """Batches of other tints, which say different things: nearer than where earlier ones are forgotten."""
    steady = scenes.tuned(FEW, min_gain=1.0, max_gain=1.0)
    sides = np.array([1, -1, 1, -1, 1, -1], np.float32)[:, None, None, None]
    images = 0.6 * batch_photos.images + 0.2 + sides * np.array((0.1, 0.0, -0.1), np.float32)
    tinted = BatchPhotos(images, batch_photos.cameras)
    joint, _ = fit_batch_colors(groups, tinted, steady)
    after = forgetful = groups
    for batch in (some(tinted, 0, 2, 4), some(tinted, 1, 3, 5)):
        after, report = fit_batch_colors(after, batch, steady)
        assert report.accepted
        unknown = replace(forgetful.colors, precision=np.zeros_like(groups.colors.precision))
        forgetful, _ = fit_batch_colors(replace(forgetful, colors=unknown), batch, steady)
    assert rms(after.colors.sh0, joint.colors.sh0) < 0.8 * rms(forgetful.colors.sh0, joint.colors.sh0)
    assert rms(after.colors.sh0, joint.colors.sh0) < 0.7 * rms(joint.colors.sh0, groups.colors.sh0)
    np.testing.assert_allclose(after.colors.precision, joint.colors.precision, rtol=1e-4, atol=1e-4)


def test_views_that_see_nothing_say_nothing(groups: GroupSet, batch_photos: BatchPhotos) -> None:
    away = batch_photos.cameras[:1]
    turn = np.diag([-1.0, 1, -1, 1])
    away = replace(away, viewmats=turn @ away.viewmats)
    actual, report = fit_batch_colors(groups, BatchPhotos(batch_photos.images[:1], away), FEW)
    assert not report.accepted
    np.testing.assert_array_equal(actual.colors.sh0, groups.colors.sh0)
    np.testing.assert_array_equal(actual.colors.precision, groups.colors.precision)


NOTHING = Replay(np.zeros((0, 2, 3, 3), np.uint8), np.zeros(0, np.int64))


def numbered_photos(first: int, count: int) -> BatchPhotos:
    """Pictures of 3 x 2 pixels, each of its number."""
    images = np.broadcast_to(np.arange(first, first + count)[:, None, None, None] / np.float32(255), (count, 2, 3, 3))
    cameras = Cameras(np.stack([np.eye(4)] * count), np.stack([np.eye(3)] * count), 3, 2)
    return BatchPhotos(np.ascontiguousarray(images, np.float32), cameras)


def kept(sizes: list[int], most: int, start: int = 0) -> Replay:
    """What is kept of batches of given sizes."""
    actual, first = NOTHING, start
    for size in sizes:
        actual = update_replay(actual, numbered_photos(first, size), np.arange(first, first + size), first + size, most)
        first += size
    return actual


@pytest.mark.parametrize(("most", "num_views"), [(1, 5), (2, 9), (3, 1), (4, 8), (7, 23), (16, 6)])
def test_kept_photos_do_not_depend_on_the_batches(most: int, num_views: int) -> None:
    """At most so many, every so many-th of all, whatever the sizes of the batches were."""
    rng = np.random.default_rng(most)
    whole = kept([num_views], most)
    views = whole.views.tolist()
    assert 1 <= len(views) <= most
    assert len(views) > min(most, num_views) / 2
    step = views[1] - views[0] if len(views) > 1 else num_views
    assert views == list(range(0, num_views, step))
    assert whole.images[:, 0, 0, 0].tolist() == views
    cuts = [[1] * num_views, [num_views - num_views // 2, num_views // 2]]
    cuts += [np.diff([0, *sorted(rng.integers(0, num_views, 3)), num_views]).tolist() for _ in range(3)]
    for sizes in cuts:
        actual = kept([size for size in sizes if size], most)
        assert actual.views.tolist() == views, sizes
        np.testing.assert_array_equal(actual.images, whole.images)


@pytest.mark.parametrize(("start", "most"), [(1, 1), (3, 2), (7, 5)])
def test_views_without_photos_before(start: int, most: int) -> None:
    """Where the first photo is no even one, one is kept all the same."""
    actual = kept([1, 1, 1], most, start)
    assert 1 <= len(actual) <= most
    assert actual.views.tolist() == kept([3], most, start).views.tolist()
    assert actual.images[:, 0, 0, 0].tolist() == actual.views.tolist()


def test_views_that_come_again_or_came_without_photos_are_kept_once() -> None:
    again = update_replay(kept([4], 4), numbered_photos(10, 3), np.array([1, 4, 1]), 5, 8)
    assert again.views.tolist() == [0, 1, 2, 3, 4]
    assert again.images[:, 0, 0, 0].tolist() == [0, 1, 2, 3, 11]
    before = update_replay(kept([1, 1], 8, 4), numbered_photos(0, 3), np.array([0, 2, 1]), 6, 8)
    assert before.views.tolist() == [0, 1, 2, 4, 5]
    assert before.images[:, 0, 0, 0].tolist() == [0, 2, 1, 4, 5]


def test_known_cameras_are_found() -> None:
    cameras = room(6).cameras
    some, others = cameras[np.array([4, 0, 4])], cameras[np.array([5, 4, 3])]
    assert view_ids(some, others).tolist() == [3, 0, 4]
    assert view_ids(some[:0], others).tolist() == [0, 1, 2]
    assert view_ids(some, others[:0]).tolist() == []


def test_fewer_may_be_wanted_later() -> None:
    many = kept([8], 8)
    few = update_replay(many, numbered_photos(8, 1), np.array([8]), 9, 3)
    assert few.views.tolist() == [0, 4, 8]


@pytest.mark.parametrize("size", [(12, 8), (18, 24)])
def test_pictures_of_another_size_are_averages(size: tuple[int, int]) -> None:
    scene = room(2)
    actual = resize_photos(scene.images, scene.cameras, *size)
    w, h = size
    means = scene.images.reshape(2, h, 24 // h, w, 36 // w, 3).mean((2, 4))
    np.testing.assert_allclose(actual.images, means, atol=1e-5)
    assert len(actual) == 2
