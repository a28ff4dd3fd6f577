from __future__ import annotations

from dataclasses import replace

import loose
import numpy as np
import pytest
import scenes

from gsmerge import CompactOptions, PixelScene, UnalignedScene, compact
from gsmerge.errors import UsageError
from gsmerge.moments import scene_members, unaligned_members
from gsmerge.runtime.record import record_run
from gsmerge.stages.assign import (
    ContributionOptions,
    Owners,
    find_owners,
    merge_neighbors,
    middle_pixels,
    owner_pixels,
    seen_depths,
)
from gsmerge.stages.encode import EncodeOptions, encode, group_rows, member_rows
from gsmerge.stages.group import superpixels_per_view
from gsmerge.stages.place_cameras import add_views
from gsmerge.stages.prepare import canonicalise, find_frame, prepare
from gsmerge.stages.segment import SegmentOptions, segment
from gsmerge.types import Groups


@pytest.fixture(scope="module")
def room() -> PixelScene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24))


@pytest.fixture(scope="module")
def groups(room: PixelScene) -> Groups:
    assert room.images is not None
    return segment(room.images, SegmentOptions(), 40)


def test_sizes_must_fit(room: PixelScene) -> None:
    with pytest.raises(ValueError, match="view names"):
        UnalignedScene(room.gaussians, room.cameras, None, ("a",))
    with pytest.raises(ValueError, match="images"):
        UnalignedScene(room.gaussians, room.cameras, np.zeros((3, 24, 31, 3), np.float32), room.names)
    assert len(loose.loosened(room)) == 3


@pytest.mark.parametrize(
    ("name", "value"), [("unseen", "hide"), ("min_owner_weight", -1.0), ("min_owner_weight", np.nan)]
)
def test_options_are_checked(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=f"{name}: expected"):
        ContributionOptions(**{name: value})  # type: ignore[arg-type]


def test_middle_pixels() -> None:
    labels = np.array([[0, 0, 0, 2], [0, 0, 0, 2], [0, 0, 0, 2]], np.int32)
    assert middle_pixels(labels, 4).tolist() == [5, 0, 7, 0]


def test_owner_pixels_lie_in_their_superpixel(room: PixelScene, groups: Groups) -> None:
    owners = find_owners(loose.loosened(room), groups)
    pixels = owner_pixels(owners, groups)
    seen = owners.labels >= 0
    assert seen.mean() > 0.9
    assert (pixels[~seen] == -1).all()
    assert (groups.labels.reshape(-1)[pixels[seen]] == owners.labels[seen]).all()
    assert (pixels[seen] // (32 * 24) == owners.views[seen]).all()


def test_faint_ones_count_as_unseen() -> None:
    groups = Groups(np.zeros((1, 2, 2), np.int32), (1,))
    owners = Owners(np.array([0.2, 0.5, 0.0], np.float32), np.array([0, 0, -1]), np.array([0, 0, -1]))
    assert owner_pixels(owners, groups, 0.3).tolist() == [-1, 0, -1]
    assert owner_pixels(owners, groups).tolist() == [0, 0, -1]


def test_rows_by_pixel_are_those_of_the_grid(room: PixelScene, groups: Groups) -> None:
    """Members that know their pixels are grouped as those of a scene in order."""
    scene, pixels = loose.loosened(room), np.arange(len(room.gaussians))
    members = unaligned_members(scene, pixels)
    for actual, expected in zip(member_rows(scene, members, groups), group_rows(room, groups), strict=True):
        assert (actual == expected).all()
    np.testing.assert_allclose(members.footprints, scene_members(room).footprints, rtol=1e-5)
    one, other = (
        encode(scene, members, groups, EncodeOptions()),
        encode(room, scene_members(room), groups, EncodeOptions()),
    )
    assert np.allclose(one.means, other.means, atol=1e-6)
    assert np.array_equal(one.views, other.views)


def test_members_without_a_pixel_are_in_no_group(room: PixelScene, groups: Groups) -> None:
    pixels = np.arange(len(room.gaussians))
    pixels[::3] = -1
    members = unaligned_members(loose.loosened(room), pixels)
    _, ids, _ = member_rows(loose.loosened(room), members, groups)
    assert sorted(ids) == np.flatnonzero(pixels >= 0).tolist()
    scene = loose.loosened(room)
    focals, centres = scene.cameras.Ks[:, 0, 0], scene.cameras.centres
    away = np.stack([np.linalg.norm(scene.gaussians.means - c, axis=1) for c in centres], 1)
    np.testing.assert_allclose(members.footprints[::3], (away / focals).min(1)[::3], rtol=1e-5)


def test_frame_is_that_of_the_grid(room: PixelScene) -> None:
    actual, expected = canonicalise(loose.loosened(room))[1], find_frame(room)
    assert actual.unit == expected.unit
    assert np.abs(actual.origin - expected.origin).max() < 0.5


def test_depths_are_those_of_the_surfaces(room: PixelScene) -> None:
    depths, valid = seen_depths(loose.loosened(room))
    _, expected, _ = scenes.trace(scenes.room(), room.cameras)
    assert valid.mean() > 0.99
    error = (depths.reshape(3, -1) / expected - 1)[valid.reshape(3, -1)]
    assert np.median(np.abs(error)) < 0.01


def test_density_is_of_the_gaussians_where_those_are_fewer(room: PixelScene) -> None:
    options = CompactOptions().with_settings({"superpixels": "10%"})
    whole = loose.loosened(room)
    assert superpixels_per_view(whole, options) == superpixels_per_view(room, options) == 76
    assert superpixels_per_view(replace(whole, gaussians=room.gaussians[::2]), options) == 38
    assert superpixels_per_view(replace(whole, gaussians=room.gaussians[:1]), options) == 1
    assert superpixels_per_view(whole, options.with_settings({"superpixels": 50})) == 50


def test_unknown_cameras_are_placed(room: PixelScene) -> None:
    blind = UnalignedScene(room.gaussians, loose.NO_CAMERAS, None, ())
    with record_run() as log:
        whole = add_views(blind)
    assert len(whole) == len(whole.names) >= 1
    assert len(log.notes) == 1
    assert "no cameras" in log.notes[0]
    with record_run() as log:
        prepared = prepare(blind, CompactOptions())
    assert prepared.scene.images is not None
    assert prepared.scene.images.min() >= 0
    assert prepared.scene.images.max() <= 1
    assert "no photos" in log.notes[-1]


def test_placed_cameras_see_most(room: PixelScene) -> None:
    blind = add_views(UnalignedScene(room.gaussians, loose.NO_CAMERAS, None, ()))
    groups = Groups(np.zeros((len(blind), blind.cameras.height, blind.cameras.width), np.int32), (1,) * len(blind))
    owners = find_owners(blind, groups, near=1e-3)
    assert (owners.values > 0).mean() > 0.8


def test_neighbours_are_merged(room: PixelScene) -> None:
    merged = merge_neighbors(room.gaussians, loose.loosened(room), 50, CompactOptions())
    assert len(merged) == 50
    low, high = room.gaussians.means.min(0), room.gaussians.means.max(0)
    assert ((merged.means >= low - 1e-5) & (merged.means <= high + 1e-5)).all()
    all_of_them = merge_neighbors(room.gaussians[:20], loose.loosened(room), 20, CompactOptions())
    assert np.allclose(all_of_them.means.sum(0), room.gaussians.means[:20].sum(0), atol=1e-4)


@pytest.mark.parametrize("settings", [{}, {"budget": 150}], ids=str)
def test_unseen_ones_are_dropped_or_kept(room: PixelScene, settings: dict) -> None:
    hidden = loose.far_behind(room.gaussians, 600)
    scene = replace(loose.loosened(room), gaussians=type(hidden).concat([room.gaussians, hidden]))
    options = {"superpixels": "10%", "fit": "none", **settings}
    dropped, kept = (compact(scene, unseen=unseen, **options) for unseen in ("drop", "keep"))
    behind = [int((result.gaussians.means[:, 2] < -5).sum()) for result in (dropped, kept)]
    assert behind[0] == 0
    assert behind[1] > 20
    assert any("no view sees" in note for note in kept.report.notes)
    if "budget" in settings:
        assert len(kept.gaussians) <= 150
        assert len(kept.gaussians) > 140


def test_nothing_seen_at_all(room: PixelScene) -> None:
    scene = replace(loose.loosened(room), gaussians=loose.far_behind(room.gaussians, 500))
    for unseen in ("drop", "keep"):
        with pytest.raises(UsageError, match="none of 3 sees any of 500 Gaussians"):
            compact(scene, unseen=unseen)


def test_members_of_a_grid_need_no_pixels(room: PixelScene) -> None:
    members = prepare(room, CompactOptions()).members
    assert members is not None
    assert members.pixels is None
