"""Photos at the state's size, and which of them are kept."""

from __future__ import annotations

import numpy as np
import pytest
from view_batches import room

from gsmerge import Cameras
from gsmerge.geometry import project
from gsmerge.online.batch_photos import (
    BatchPhotos,
    concat_cameras,
    resize_cameras,
    resize_photos,
    update_replay,
    view_ids,
)
from gsmerge.online.state import Replay

NOTHING = Replay(np.zeros((0, 2, 3, 3), np.uint8), np.zeros(0, np.int64))


def batch_photos(first: int, count: int) -> BatchPhotos:
    """Pictures of 3 x 2 pixels, each of its number."""
    images = np.broadcast_to(np.arange(first, first + count)[:, None, None, None] / np.float32(255), (count, 2, 3, 3))
    cameras = Cameras(np.stack([np.eye(4)] * count), np.stack([np.eye(3)] * count), 3, 2)
    return BatchPhotos(np.ascontiguousarray(images, np.float32), cameras)


def kept(sizes: list[int], most: int, start: int = 0) -> Replay:
    """What is kept of batches of given sizes."""
    actual, first = NOTHING, start
    for size in sizes:
        actual = update_replay(actual, batch_photos(first, size), np.arange(first, first + size), first + size, most)
        first += size
    return actual


@pytest.mark.parametrize("most", [1, 2, 3, 4, 7, 16])
@pytest.mark.parametrize("num_views", [1, 2, 5, 6, 8, 9, 23])
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


@pytest.mark.parametrize("start", [1, 3, 7])
@pytest.mark.parametrize("most", [1, 2, 5])
def test_views_without_photos_before(start: int, most: int) -> None:
    """Where the first photo is no even one, one is kept all the same."""
    actual = kept([1, 1, 1], most, start)
    assert 1 <= len(actual) <= most
    assert actual.views.tolist() == kept([3], most, start).views.tolist()
    assert actual.images[:, 0, 0, 0].tolist() == actual.views.tolist()


def test_views_that_come_again_are_kept_once() -> None:
    many = kept([4], 4)
    again = update_replay(many, batch_photos(10, 3), np.array([1, 4, 1]), 5, 8)
    assert again.views.tolist() == [0, 1, 2, 3, 4]
    assert again.images[:, 0, 0, 0].tolist() == [0, 1, 2, 3, 11]


def test_photos_of_views_that_came_without() -> None:
    actual = update_replay(kept([1, 1], 8, 4), batch_photos(0, 3), np.array([0, 2, 1]), 6, 8)
    assert actual.views.tolist() == [0, 1, 2, 4, 5]
    assert actual.images[:, 0, 0, 0].tolist() == [0, 2, 1, 4, 5]


def test_known_cameras_are_found() -> None:
    cameras = room(6).cameras
    some, others = cameras[np.array([4, 0, 4])], cameras[np.array([5, 4, 3])]
    assert view_ids(some, others).tolist() == [3, 0, 4]
    assert view_ids(some[:0], others).tolist() == [0, 1, 2]
    assert view_ids(some, others[:0]).tolist() == []


def test_no_photos_are_kept_where_none_are_wanted() -> None:
    actual = kept([3, 2], 0)
    assert actual.images.shape == (0, 2, 3, 3)
    assert len(actual.views) == 0


def test_fewer_may_be_wanted_later() -> None:
    many = kept([8], 8)
    few = update_replay(many, batch_photos(8, 1), np.array([8]), 9, 3)
    assert few.views.tolist() == [0, 4, 8]


def test_colours_are_rounded() -> None:
    one = batch_photos(0, 1)
    values = np.linspace(0, 1, 18, dtype=np.float32).reshape(1, 2, 3, 3)
    actual = update_replay(NOTHING, BatchPhotos(values, one.cameras), np.array([0]), 1, 4)
    assert actual.images.dtype == np.uint8
    np.testing.assert_allclose(actual.images / 255, values, atol=0.5 / 255 + 1e-6)


def test_pictures_of_the_states_size_are_left_as_they_are() -> None:
    scene = room(2)
    assert scene.images is not None
    actual = resize_photos(scene.images, scene.cameras, 36, 24)
    assert actual.images is not None
    np.testing.assert_array_equal(actual.images, scene.images)
    assert actual.cameras is scene.cameras


@pytest.mark.parametrize("size", [(18, 12), (12, 8), (18, 24)])
def test_pictures_of_another_size_are_averages(size: tuple[int, int]) -> None:
    scene = room(2)
    assert scene.images is not None
    actual = resize_photos(scene.images, scene.cameras, *size)
    w, h = size
    means = scene.images.reshape(2, h, 24 // h, w, 36 // w, 3).mean((2, 4))
    np.testing.assert_allclose(actual.images, means, atol=1e-5)
    assert len(actual) == 2


def test_larger_pictures_keep_the_view() -> None:
    scene = room(1)
    assert scene.images is not None
    actual = resize_photos(scene.images, scene.cameras, 72, 48)
    assert actual.images.shape == (1, 48, 72, 3)
    assert float(np.abs(actual.images.mean((1, 2)) - scene.images.mean((1, 2))).max()) < 0.01


def test_the_same_points_are_at_the_same_share_of_the_picture() -> None:
    cameras = room(3).cameras
    points = np.array([[0.1, -0.2, 3.0], [0.5, 0.4, 2.0]])
    large, small = (project(points, c)[0] for c in (cameras, resize_cameras(cameras, 9, 12)))
    np.testing.assert_allclose(small, large * np.array([9 / 36, 12 / 24]), atol=1e-9)
    assert resize_cameras(cameras, 9, 12).viewmats.dtype == np.float64


def test_joined_cameras_come_one_after_the_other() -> None:
    first, second = room(2).cameras, room(3).cameras
    actual = concat_cameras(first, second)
    assert (len(actual), actual.width, actual.height) == (5, 36, 24)
    np.testing.assert_array_equal(actual.viewmats[2:], second.viewmats.astype(np.float64))
    np.testing.assert_array_equal(actual.Ks[:2], first.Ks.astype(np.float64))


def test_photos_at_half_size() -> None:
    scene = room(2)
    assert scene.images is not None
    actual = resize_photos(scene.images, scene.cameras, 36, 24).photos(2)
    assert (actual.width, actual.height, len(actual)) == (18, 12, 2)
