"""Maps of likely errors: what photos of other views show of each surface, against what is drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import Scene
from gsmerge.measure.error_maps import MAX_ERROR, STOPS, UNKNOWN, draw_errors, expected_errors, make_reference
from gsmerge.types import Views

WIDTH, HEIGHT = 64, 48


@pytest.fixture(scope="module")
def wall() -> Scene:
    """A wall that three views see, in canonical units."""
    return scenes.make_scene(scenes.wall(), scenes.arc(3, WIDTH, HEIGHT))


def errors_of(scene: Scene, view: int) -> np.ndarray:
    assert scene.images is not None
    views = Views(scene.cameras, scene.images, scene.names)
    return expected_errors(make_reference(scene.gaussians, views), scene.cameras[[view]], view)


def test_what_other_photos_confirm_is_likely_right(wall: Scene) -> None:
    errors = errors_of(wall, 1)
    assert errors.shape == (HEIGHT, WIDTH)
    assert np.isfinite(errors).mean() > 0.9
    assert np.nanmedian(errors) < 0.03


def test_the_own_photo_does_not_count_and_others_do(wall: Scene) -> None:
    """Brighter by a fifth: in the view's own photo, then in those of both others."""
    assert wall.images is not None
    plain = errors_of(wall, 1)
    for views in ([1], [0, 2]):
        images = wall.images.copy()
        images[views] = np.minimum(images[views] + 0.2, 1)
        errors = errors_of(replace(wall, images=images), 1)
        more = np.nanmedian(errors) - np.nanmedian(plain)
        assert more == pytest.approx(0.2 if views == [0, 2] else 0, abs=0.03)


def test_a_wrong_depth_is_likely_wrong(wall: Scene) -> None:
    """The right half of all views at six tenths of its depth, of a wall with a pattern."""
    means = wall.gaussians.means.reshape(3, HEIGHT, WIDTH, 3).copy()
    for view, eye in enumerate(wall.cameras.centres):
        means[view, :, WIDTH // 2 :] = eye + 0.6 * (means[view, :, WIDTH // 2 :] - eye)
    wrong = replace(wall, gaussians=replace(wall.gaussians, means=means.reshape(-1, 3)))
    errors, plain = errors_of(wrong, 0), errors_of(wall, 0)
    right = slice(WIDTH // 2 + 4, None)
    assert np.nanmean(errors[:, right]) > 2 * np.nanmean(plain[:, right])


def test_where_no_other_photo_looks_nothing_is_known(wall: Scene) -> None:
    assert wall.images is not None
    turned = wall.cameras.viewmats.copy()
    turned[1:] = np.diag([-1.0, 1, -1, 1]) @ turned[1:]
    away = Views(replace(wall.cameras, viewmats=turned), wall.images, wall.names)
    errors = expected_errors(make_reference(wall.gaussians, away), wall.cameras[[0]], 0)
    assert np.isnan(errors).all()
    assert (draw_errors(errors) == UNKNOWN).all()


def test_views_without_a_photo_say_nothing(wall: Scene) -> None:
    """Nor do the pixels that a mask leaves out."""
    masks = np.ones((3, HEIGHT, WIDTH), bool)
    masks[1:] = False
    assert wall.images is not None
    views = Views(wall.cameras, wall.images, wall.names)
    assert np.isnan(expected_errors(make_reference(wall.gaussians, views, masks), wall.cameras[[0]], 0)).all()


def test_colours_go_from_none_to_much() -> None:
    picture = draw_errors(np.array([[0, MAX_ERROR, 9, np.nan, MAX_ERROR / 4]], np.float32))
    assert [tuple(color) for color in picture[0]] == [STOPS[0], STOPS[-1], STOPS[-1], UNKNOWN, STOPS[1]]
