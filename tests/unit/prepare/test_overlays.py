"""What all photos show at the same pixels is left out with its Gaussians; what the scene explains stays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scenes
import unaligned_scenes

from gsmerge import Scene
from gsmerge.method.geometry.frame import canonicalise
from gsmerge.method.geometry.transforms import rgb_to_sh0
from gsmerge.method.geometry.views import subset
from gsmerge.prepare.overlays import leave_out_overlays
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.prepare.true_pixels import with_pixels
from gsmerge.settings.stages import PrepareOptions
from gsmerge.types import PicturedScene

VIEWS, WIDTH, HEIGHT = 6, 120, 90
BADGE = np.s_[60:82, 84:112]  # rows and columns of a badge at the lower right


@pytest.fixture(scope="module")
def room() -> Scene:
    return canonicalise(scenes.make_scene(scenes.room(), scenes.arc(VIEWS, WIDTH, HEIGHT)))[0]


def painted(room: Scene, paint: Callable[[np.ndarray, int], None]) -> Scene:
    """Return the scene as a model makes it of photos that were painted: each row has the colour of its pixel."""
    images = room.images.copy()
    for view in range(len(images)):
        paint(images[view], view)
    sh0 = rgb_to_sh0(images.reshape(-1, 1, 3))
    return replace(room, images=images, gaussians=replace(room.gaussians, sh0=sh0))


def paint_badge(photo: np.ndarray, _: int) -> None:
    photo[BADGE] = (0.9, 0.1, 0.1)
    photo[66:76, 90:106] = (1.0, 1.0, 0.9)


def pictured(scene: Scene) -> PicturedScene:
    return PicturedScene.with_pictures(scene, scene.images, scene.masks)


def test_a_badge_on_all_photos_is_left_out_with_its_gaussians(room: Scene) -> None:
    scene = pictured(painted(room, paint_badge))
    left, overlay, change = leave_out_overlays(scene)
    assert overlay is not None
    badge = np.zeros((HEIGHT, WIDTH), bool)
    badge[BADGE] = True
    assert overlay[:, badge].mean() > 0.95
    assert overlay[:, ~badge].mean() < 0.06
    assert not left.masks[overlay].any()
    assert left.masks[~overlay].all()
    assert len(left.gaussians) == len(scene.gaussians) - overlay.sum()
    assert "(lower right): taken for an overlay" in change


def test_gaussians_that_views_share_go_if_they_are_in_front_there_alone(room: Scene) -> None:
    scene = unaligned_scenes.without_order(painted(room, paint_badge))
    scene = with_pixels(scene)
    left, overlay, _ = leave_out_overlays(pictured(scene))
    assert overlay is not None
    assert 0 < len(scene.gaussians) - len(left.gaussians) < 2 * overlay.sum()


def plain_sky(photo: np.ndarray, _: int) -> None:
    photo[:30] = (0.5, 0.7, 0.9)


@pytest.mark.parametrize("paint", [lambda photo, _: None, plain_sky], ids=["nothing", "a plain part"])
def test_what_the_scene_explains_stays(room: Scene, paint: Callable[[np.ndarray, int], None]) -> None:
    scene = pictured(painted(room, paint))
    assert leave_out_overlays(scene) == (scene, None, "")


def test_pixels_that_do_not_count_say_nothing(room: Scene) -> None:
    """Photos that were cropped are extended by black pixels, which all of them have at the same places."""
    masks = np.full((VIEWS, HEIGHT, WIDTH), True)
    masks[:, :, :14] = False
    images = room.images * masks[..., None]
    assert leave_out_overlays(pictured(replace(room, images=images)))[1] is not None
    assert leave_out_overlays(pictured(replace(room, images=images, masks=masks)))[1] is None


def test_too_few_photos_decide_nothing(room: Scene) -> None:
    scene = pictured(subset(painted(room, paint_badge), [0, 2, 4]))
    assert leave_out_overlays(scene) == (scene, None, "")


def test_a_prepared_scene_weighs_no_pixel_of_an_overlay(room: Scene) -> None:
    scene = painted(room, paint_badge)
    prepared = prepare(scene)
    assert prepared.foreign is not None
    assert (prepared.scene.importance[prepared.foreign] == 0).all()
    assert any("overlay" in change for change in prepared.changes)
    kept = prepare(scene, PrepareOptions(look="photos"))
    assert kept.foreign is None
