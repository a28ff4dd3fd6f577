"""Gaussians in no order belong to the superpixels that show them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
import unaligned_scenes
from messages import refuses

from gsmerge import Scene, compact
from gsmerge.errors import UsageError
from gsmerge.method.facts.scene_size import measure_size
from gsmerge.method.geometry.frame import canonicalise, scene_frame
from gsmerge.method.geometry.pooling import scene_members
from gsmerge.method.stages.assign import assign, find_owners, middle_pixels, owner_pixels
from gsmerge.method.stages.encode import encode, member_rows
from gsmerge.method.stages.superpixels import segment
from gsmerge.method.viewpoints.place_cameras import add_views
from gsmerge.plan.counts import FEW_PIXELS, superpixels_per_view
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.prepare.true_pixels import with_pixels
from gsmerge.runtime.record import record_run
from gsmerge.settings.stages import SegmentOptions
from gsmerge.types import NO_CAMERAS, Groups, make_scene


def make_room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24))


@pytest.fixture(scope="module")
def room() -> Scene:
    return make_room()


@pytest.fixture(scope="module")
def groups() -> Groups:
    return segment(make_room().images, SegmentOptions(), 40)


def test_middle_pixel_of_a_superpixel_is_nearest_to_its_mean() -> None:
    labels = np.array([[0, 0, 0, 2], [0, 0, 0, 2], [0, 0, 0, 2]], np.int32)
    assert middle_pixels(labels, 4).tolist() == [5, 0, 7, 0]


def test_owner_pixels_lie_in_their_superpixel(room: Scene, groups: Groups) -> None:
    owners = find_owners(unaligned_scenes.without_order(room), groups)
    pixels = owner_pixels(owners, groups)
    seen = owners.labels >= 0
    assert seen.mean() > 0.9
    assert (pixels[~seen] == -1).all()
    assert (groups.labels.reshape(-1)[pixels[seen]] == owners.labels[seen]).all()
    assert (pixels[seen] // (32 * 24) == owners.views[seen]).all()


def test_gaussians_belong_to_the_superpixel_of_their_pixel(room: Scene, groups: Groups) -> None:
    """Or, as in the paper, to the one that they show most in."""
    scene = with_pixels(canonicalise(unaligned_scenes.without_order(room))[0])
    np.testing.assert_array_equal(assign(scene, groups).pixels, scene.pixels.homes)
    shown = assign(scene, groups, by_contribution=True)
    np.testing.assert_array_equal(shown.pixels, owner_pixels(find_owners(scene, groups), groups))
    np.testing.assert_array_equal(assign(room, groups, by_contribution=True).pixels, room.pixels.homes)


def test_rows_by_pixel_are_those_of_the_grid(room: Scene, groups: Groups) -> None:
    """Members that know their pixels are grouped as those of a scene in order."""
    order = np.random.default_rng(0).permutation(len(room.gaussians))
    pixels = replace(
        room.pixels, homes=order, fronts=np.argsort(order, kind="stable")[room.pixels.fronts].astype(np.int32)
    )
    scene = replace(room, gaussians=room.gaussians[order], pixels=pixels)
    members, in_order = scene_members(scene), scene_members(room)
    (starts, ids, views), expected = (member_rows(room, each, groups) for each in (members, in_order))
    assert np.array_equal(starts, expected[0])
    assert np.array_equal(views, expected[2])
    labels = groups.labels.reshape(-1)
    assert np.array_equal(labels[order[ids]], labels[expected[1]])
    np.testing.assert_allclose(members.footprints, in_order.footprints[order], rtol=1e-5)
    one, other = (encode(scene, members, groups), encode(room, scene_members(room), groups))
    assert np.allclose(one.means, other.means, atol=1e-6)
    assert np.array_equal(one.views, other.views)


def test_members_without_a_pixel_are_in_no_group(room: Scene, groups: Groups) -> None:
    homes = room.pixels.homes.copy()
    homes[::3] = -1
    scene = replace(room, pixels=replace(room.pixels, homes=homes))
    members = scene_members(scene)
    _, ids, _ = member_rows(scene, members, groups)
    assert sorted(ids) == np.flatnonzero(homes >= 0).tolist()
    focals, centres = scene.cameras.Ks[:, 0, 0], scene.cameras.centres
    away = np.stack([np.linalg.norm(scene.gaussians.means - c, axis=1) for c in centres], 1)
    np.testing.assert_allclose(members.footprints[::3], (away / focals).min(1)[::3], rtol=1e-5)


def test_frame_of_gaussians_in_no_order_is_that_of_the_grid(room: Scene) -> None:
    actual, expected = canonicalise(unaligned_scenes.without_order(room))[1], scene_frame(room)
    assert actual.unit == expected.unit
    assert np.abs(actual.origin - expected.origin).max() < 0.5


def test_share_of_superpixels_is_of_gaussians_where_these_are_fewer(room: Scene) -> None:
    options = SegmentOptions(superpixels="10%")
    whole = unaligned_scenes.without_order(room)
    sizes = [whole, room, *(replace(whole, gaussians=room.gaussians[rows]) for rows in (slice(0, None, 2), slice(1)))]
    assert [superpixels_per_view(measure_size(scene), options) for scene in sizes] == [76, 76, 38, 1]
    assert superpixels_per_view(measure_size(whole), SegmentOptions(superpixels=50)) == 50


def test_few_gaussians_get_half_as_many_superpixels_at_most(room: Scene) -> None:
    """A share of tokens is too few to show the photos; half of them are the most."""
    tokens = replace(measure_size(unaligned_scenes.without_order(room)), rendered=False)
    sizes = [replace(tokens, num_gaussians=count) for count in (1151, 200)]
    assert [superpixels_per_view(size, SegmentOptions(superpixels="10%")) for size in sizes] == [76, 33]
    large = replace(tokens, height=1000, width=1000)
    sizes = [replace(large, num_gaussians=count) for count in (30_000, FEW_PIXELS // 2, FEW_PIXELS)]
    assert [superpixels_per_view(size, SegmentOptions()) for size in sizes] == [3844, 1922, 3844]


def test_unknown_cameras_are_placed(room: Scene) -> None:
    blind = make_scene(room.gaussians, NO_CAMERAS)
    with record_run() as log:
        whole = add_views(blind)
    assert len(whole) == len(whole.names) >= 1
    assert len(log.notes) == 1
    assert "cameras" in log.notes[0]
    with record_run() as log:
        prepared = prepare(blind)
    assert prepared.scene.images.min() >= 0
    assert prepared.scene.images.max() <= 1
    assert "photos" in log.notes[-1]


def test_placed_cameras_see_most_gaussians(room: Scene) -> None:
    blind = add_views(make_scene(room.gaussians, NO_CAMERAS))
    groups = Groups(np.zeros((len(blind), blind.cameras.height, blind.cameras.width), np.int32), (1,) * len(blind))
    owners = find_owners(blind, groups)
    assert (owners.values > 0).mean() > 0.8


def test_scene_that_no_camera_sees_is_refused(room: Scene) -> None:
    scene = replace(unaligned_scenes.without_order(room), gaussians=unaligned_scenes.far_behind(room.gaussians, 500))
    with refuses(UsageError, "", "none of 3", 500):
        compact(scene)
