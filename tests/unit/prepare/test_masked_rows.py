"""Gaussians of masked pixels leave the scene where other views see something else, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
import unaligned_scenes

from gsmerge import Scene
from gsmerge.method.geometry.frame import canonicalise
from gsmerge.method.geometry.transforms import rgb_to_sh0
from gsmerge.method.geometry.views import subset, take_rows
from gsmerge.prepare.masked_rows import drop_masked, find_covered
from gsmerge.prepare.prepare_scene import prepare

VIEWS, WIDTH, HEIGHT = 4, 48, 36
SQUARE = np.s_[10:22, 18:32]  # rows and columns of a masked part


@pytest.fixture(scope="module")
def room() -> Scene:
    return canonicalise(scenes.make_scene(scenes.room(), scenes.arc(VIEWS, WIDTH, HEIGHT)))[0]


def masked(room: Scene, views: tuple[int, ...]) -> Scene:
    masks = np.full((VIEWS, HEIGHT, WIDTH), True)
    for view in views:
        masks[view][SQUARE] = False
    return replace(room, masks=masks)


def with_passer_by(room: Scene, view: int) -> Scene:
    """Return the scene with something red half way before a view's square, which a mask hides."""
    scene = masked(room, (view,))
    hidden = ~scene.masks.reshape(-1)
    means = scene.gaussians.means.copy()
    eye = scene.cameras.centres[view]
    means[hidden] = eye + 0.5 * (means[hidden] - eye)
    sh0 = scene.gaussians.sh0.copy()
    sh0[hidden] = rgb_to_sh0(np.array([1.0, 0.0, 0.0], np.float32))
    return replace(scene, gaussians=replace(scene.gaussians, means=means.astype(np.float32), sh0=sh0))


def test_what_a_mask_hides_leaves_the_scene_where_others_see_through_it(room: Scene) -> None:
    scene = with_passer_by(room, 1)
    left, foreign, change = drop_masked(scene)
    assert foreign is not None
    assert np.array_equal(foreign, ~scene.masks)
    assert len(left.gaussians) == len(room.gaussians) - foreign.sum()
    assert f"{100 * foreign.mean():.1f} % of the Gaussians" in change


def test_of_two_parts_of_a_mask_the_one_goes_that_others_deny(room: Scene) -> None:
    scene = with_passer_by(room, 1)
    alone = ~scene.masks
    masks = scene.masks.copy()
    masks[1, 26:32, 4:14] = False
    masks[1, 2:6:2, 2:40:2] = False  # and of many small ones none
    _, foreign, _ = drop_masked(replace(scene, masks=masks))
    assert np.array_equal(foreign, alone)


def test_a_sound_surface_behind_a_mask_stays(room: Scene) -> None:
    scene = masked(room, (0, 1, 2))
    assert drop_masked(scene) == (scene, None, "")
    assert find_covered(scene) is None


@pytest.mark.parametrize("change", ["no masks", "all counts", "shared rows", "two views"])
def test_nothing_is_dropped_where_nothing_can_be_compared(room: Scene, change: str) -> None:
    scene = with_passer_by(room, 1)
    if change == "no masks":
        scene = replace(scene, masks=None)
    elif change == "all counts":
        scene = replace(scene, masks=np.full_like(scene.masks, True))
    elif change == "shared rows":
        scene = replace(unaligned_scenes.without_order(scene), masks=scene.masks)
    else:
        scene = subset(scene, [0, 1])
    assert drop_masked(scene) == (scene, None, "")


def test_masked_pixels_weigh_nothing_where_other_views_cover_them(room: Scene) -> None:
    """Their Gaussians are gone already, as some exports have it."""
    scene = masked(room, (1,))
    gone = take_rows(scene, np.flatnonzero(scene.masks.reshape(-1)))
    covered = find_covered(gone)
    assert covered is not None
    assert np.array_equal(covered, ~scene.masks)
    prepared = prepare(gone)
    assert (prepared.scene.importance[covered] == 0).all()
    assert (prepared.scene.importance[~covered] == 1).all()


def test_a_background_that_was_taken_away_stays_empty(room: Scene) -> None:
    depth = np.linalg.norm(room.gaussians.means - np.median(room.gaussians.means, 0), axis=1)
    near = depth < np.quantile(depth, 0.3)
    cut = take_rows(replace(room, masks=near.reshape(VIEWS, HEIGHT, WIDTH)), np.flatnonzero(near))
    covered = find_covered(cut)
    assert covered is None or covered.mean() < 0.03
