"""What only one photo shows is left out with its Gaussians, and sound scenes stay as they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scenes
from motions import with_nearer_half

from gsmerge import Scene
from gsmerge.method.kernels import elementary
from gsmerge.prepare.passers_by import NEIGHBORS, leave_out_passers
from gsmerge.prepare.prepare_scene import prepare

VIEWS, WIDTH, HEIGHT = 5, 80, 60
COLORS = np.array([[1.0, 0.1, 0.9], [0.0, 0.9, 0.2]], np.float32)  # stripes, of which no wall here has a colour


@pytest.fixture(scope="module")
def wall() -> Scene:
    return scenes.make_scene(scenes.wall(), scenes.arc(VIEWS, WIDTH, HEIGHT))


def standing(views: list[int], left: int = 12) -> np.ndarray:
    """Return the pixels ``[v,h,w]`` of a striped thing, in each of ``views`` at another place."""
    mask = np.zeros((VIEWS, HEIGHT, WIDTH), bool)
    for i, view in enumerate(views):
        mask[view, 20:50, left + 12 * i : left + 12 * i + 9] = True
    return mask


def with_things(scene: Scene, mask: np.ndarray, share: float = 0.5) -> Scene:
    """Paint stripes on the photos at ``mask [v,h,w]``, and put the Gaussians there at a share of their depth."""
    stripes = COLORS[np.arange(HEIGHT) // 4 % 2][:, None]
    images = np.where(mask[..., None], stripes, scene.images)
    homes = scene.pixels.homes
    eyes = scene.cameras.centres[homes // (HEIGHT * WIDTH)]
    means = scene.gaussians.means
    nearer = np.where(mask.reshape(-1)[homes][:, None], eyes + share * (means - eyes), means)
    return replace(scene, images=images, gaussians=replace(scene.gaussians, means=nearer.astype(means.dtype)))


def assert_unchanged(scene: Scene) -> None:
    kept, gone, change = leave_out_passers(scene)
    assert kept is scene
    assert gone is None
    assert change == ""


@pytest.mark.parametrize("views", [[2], [0, 1, 2, 3, 4]], ids=["in one photo", "in each photo elsewhere"])
def test_a_passer_by_is_left_out_with_its_gaussians(views: list[int], wall: Scene) -> None:
    thing = standing(views)
    scene = with_things(wall, thing)
    kept, gone, change = leave_out_passers(scene)
    assert f"{len(views)} of {VIEWS} photos" in change
    assert f"{100 * gone.mean():.1f} %" in change
    assert gone[thing].mean() > 0.95
    assert gone[~thing].mean() < 0.04
    np.testing.assert_array_equal(kept.masks, ~gone)
    np.testing.assert_array_equal(kept.pixels.shown, ~gone)
    assert not gone.reshape(-1)[kept.pixels.homes].any()
    assert kept.images is scene.images


def test_photos_beyond_the_quick_search_are_searched_once_one_shows_a_passer_by() -> None:
    many = scenes.make_scene(scenes.wall(), scenes.arc(12, WIDTH, HEIGHT))
    mask = np.zeros((12, HEIGHT, WIDTH), bool)
    mask[0, 20:50, 20:29] = True
    mask[1, 20:50, 50:59] = True
    gone = leave_out_passers(with_things(many, mask))[1]
    assert gone[mask].mean() > 0.95
    assert not gone[2:].any()
    beyond = np.zeros_like(mask)
    beyond[1] = mask[1]
    assert_unchanged(with_things(many, beyond))


def test_a_prepared_scene_weighs_no_pixel_of_a_passer_by(wall: Scene) -> None:
    thing = standing([2])
    prepared = prepare(with_things(wall, thing))
    assert any("in no other" in change for change in prepared.changes)
    assert prepared.foreign[thing].mean() > 0.95
    assert (prepared.scene.importance[prepared.foreign] == 0).all()
    assert not prepared.scene.masks[prepared.foreign].any()


@pytest.mark.parametrize("surfaces", [scenes.wall, scenes.two_planes, scenes.pole, scenes.room])
def test_sound_scenes_stay_as_they_are(surfaces: Callable[[], list[scenes.Surface]]) -> None:
    assert_unchanged(scenes.make_scene(surfaces(), scenes.arc(VIEWS, WIDTH, HEIGHT), noise=0.02))


def test_wrong_depth_alone_is_no_passer_by(wall: Scene) -> None:
    assert_unchanged(with_nearer_half(wall, [2]))


def test_a_thing_that_all_photos_show_is_none(wall: Scene) -> None:
    """Also if its depth is wrong in one view."""

    def stripes(points: np.ndarray) -> np.ndarray:
        return np.where(elementary.sin(20 * points[:, 1:2]) > 0, COLORS[:1], COLORS[1:])

    surfaces = [scenes.plane(2.2, stripes, left=-0.2, right=0.2), *scenes.wall()]
    scene = scenes.make_scene(surfaces, scenes.arc(VIEWS, WIDTH, HEIGHT))
    assert_unchanged(scene)
    assert_unchanged(with_nearer_half(scene, [1]))


def test_a_smooth_part_of_one_photo_is_kept(wall: Scene) -> None:
    """As of the sky, or of a plain cupboard, whose depths models guess."""
    thing = standing([2])
    scene = with_things(wall, thing)
    assert_unchanged(replace(scene, images=np.where(thing[..., None], scene.images.mean(), scene.images)))


def test_few_photos_say_nothing(wall: Scene) -> None:
    thing = standing([1])
    scene = with_things(wall, thing)
    assert leave_out_passers(scenes.take_views(scene, range(NEIGHBORS)))[2]
    assert_unchanged(scenes.take_views(scene, range(NEIGHBORS - 1)))
    masks = np.full(thing.shape, True)
    masks[NEIGHBORS - 1 :] = False  # views without a photo
    assert_unchanged(replace(scene, masks=masks))


def test_scenes_without_pixels_or_photos_stay_as_they_are(wall: Scene) -> None:
    scene = with_things(wall, standing([2]))
    assert_unchanged(replace(scene, pixels=None))
    assert_unchanged(replace(scene, pixels=replace(scene.pixels, own=False)))
    assert_unchanged(replace(scene, images=None))


def test_what_masks_leave_out_is_neither_searched_nor_asked(wall: Scene) -> None:
    thing = standing([2])
    scene = with_things(wall, thing)
    assert_unchanged(replace(scene, masks=~thing))
    others = np.full(thing.shape, True)
    others[[0, 1, 3]] = False
    others[[0, 1, 3], :6] = True  # these photos count where they do not see behind the thing
    assert_unchanged(replace(scene, masks=others))
