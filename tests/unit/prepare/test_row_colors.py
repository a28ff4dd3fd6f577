"""The rows' own colours stand in for photos, or drawings of the Gaussians where those say little."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
from messages import noted

from gsmerge import Scene
from gsmerge.method.geometry.transforms import rgb_to_sh0
from gsmerge.method.raster.photos import scene_pictures
from gsmerge.prepare.row_colors import FAINT_OPACITY, add_row_colors
from gsmerge.runtime.record import record_run
from gsmerge.types import Gaussians, Pixels

WIDTH, HEIGHT = 64, 48
SIDE = 20  # pixels of a square that is changed, in the middle of each view
INNER = (slice(None), slice(HEIGHT // 2 - 4, HEIGHT // 2 + 4), slice(WIDTH // 2 - 4, WIDTH // 2 + 4))


@pytest.fixture(scope="module")
def scene() -> Scene:
    bare = replace(scenes.make_scene(scenes.wall(), scenes.arc(2, WIDTH, HEIGHT)), images=None)
    return replace(bare, gaussians=replace(bare.gaussians, opacities=np.full_like(bare.gaussians.opacities, 0.9)))


def square(scene: Scene) -> np.ndarray:
    """Return a mask ``[v,h,w]`` of a square in the middle of each view."""
    mask = np.zeros_like(scene.pixels.shown)
    mask[:, (HEIGHT - SIDE) // 2 : (HEIGHT + SIDE) // 2, (WIDTH - SIDE) // 2 : (WIDTH + SIDE) // 2] = True
    return mask


def changed(scene: Scene, rows: np.ndarray, **columns: Any) -> Scene:
    """Give some rows other values."""
    new = {name: getattr(scene.gaussians, name).copy() for name in columns}
    for name, values in columns.items():
        new[name][rows.reshape(-1)] = values
    return replace(scene, gaussians=replace(scene.gaussians, **new))


def pictures_of(scene: Scene) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return pictures, masks and notes."""
    with record_run() as record:
        colored, _ = add_row_colors(scene)
    assert colored.gaussians is scene.gaussians
    masks = np.ones_like(scene.pixels.shown) if colored.masks is None else colored.masks
    return colored.images, masks, record.notes


def two_layers(front: Scene, back: Scene) -> Scene:
    """Return two scenes of the same cameras, view by view, as models with several Gaussians per pixel write them."""
    gaussians = Gaussians.concat([front.gaussians, back.gaussians])
    cameras = replace(
        front.cameras, viewmats=np.concatenate([front.cameras.viewmats] * 2), Ks=np.concatenate([front.cameras.Ks] * 2)
    )
    ids = Pixels.of_grid(np.concatenate([front.pixels.shown, back.pixels.shown]))
    return Scene(gaussians, cameras, None, ids, (*front.names, *front.names))


def test_colours_of_solid_rows_are_the_pictures(scene: Scene) -> None:
    pictures, masks, notes = pictures_of(scene)
    np.testing.assert_allclose(pictures, scene_pictures(scene), atol=1e-6)
    assert masks.all()
    assert len(notes) == 1


def test_colours_beyond_white_and_black_are_clipped(scene: Scene) -> None:
    bright = changed(scene, square(scene), sh0=rgb_to_sh0(np.array([1.4, 0.5, -0.4])).astype(np.float32))
    np.testing.assert_allclose(pictures_of(bright)[0][INNER], np.broadcast_to([1, 0.5, 0], (2, 8, 8, 3)), atol=1e-6)


def test_harmonics_give_the_colour_towards_the_own_camera(scene: Scene) -> None:
    """Equal to the colour in a drawing, which blending hides where one Gaussian alone is opaque."""
    g, rng = scene.gaussians, np.random.default_rng(0)
    shN = rng.normal(0, 0.2, (len(g), 3, 3)).astype(np.float32)
    glossy = replace(scene, gaussians=replace(g, shN=shN))
    centres = np.repeat(glossy.cameras.centres, glossy.pixels_per_view, 0)
    x, y, z = ((g.means - centres) / np.linalg.norm(g.means - centres, axis=1, keepdims=True)).T[..., None]
    base = scene_pictures(glossy).reshape(-1, 3)
    expected = base + 0.4886025 * (-y * shN[:, 0] + z * shN[:, 1] - x * shN[:, 2])
    actual = pictures_of(glossy)[0].reshape(-1, 3)
    np.testing.assert_allclose(actual, expected.clip(0, 1), atol=1e-4)
    assert np.abs(actual - base).max() > 0.2


def test_faint_rows_show_what_is_drawn_there(scene: Scene) -> None:
    """Large neighbours behind them are what a photo would show."""
    inside = square(scene)
    green = rgb_to_sh0(np.array([0.0, 1.0, 0.0])).astype(np.float32)
    faint = changed(scene, inside, sh0=green, opacities=FAINT_OPACITY / 2)
    wide = changed(faint, ~inside, scales=scene.gaussians.scales.max() * 8)
    pictures, masks, notes = pictures_of(wide)
    assert masks.all()
    assert noted(notes, "drawings")
    assert np.abs(pictures[INNER] - [0, 1, 0]).mean() > 0.2


def test_faint_rows_with_nothing_behind_them_keep_their_colours(scene: Scene) -> None:
    """A drawing would be black, or what little of the neighbours reaches there."""
    inside = square(scene)
    pictures, masks, _ = pictures_of(changed(scene, inside, opacities=FAINT_OPACITY / 2))
    np.testing.assert_allclose(pictures[INNER], scene_pictures(scene)[INNER], atol=1e-6)
    assert masks[INNER].all()


def test_colours_of_rows_that_others_hide_are_drawn(scene: Scene) -> None:
    """What the file says of their pixels is not what the view shows."""
    astray = np.zeros_like(scene.pixels.shown)
    astray[:, :4, :4] = True  # of each view, brought before the square
    size, rows = scene.pixels_per_view, astray.reshape(-1)
    own = np.arange(len(scene.gaussians)) // size * size + size // 2 + WIDTH // 2  # the middle pixel of its view
    camera = np.repeat(scene.cameras.centres, size, 0)
    means = (camera + 0.5 * (scene.gaussians.means[own] - camera))[rows]
    radius = 0.5 * SIDE / 2 * 3.0 / scene.cameras.Ks[0, 0, 0]
    red = rgb_to_sh0(np.array([1.0, 0.0, 0.0])).astype(np.float32)
    pictures, masks, notes = pictures_of(changed(scene, astray, means=means, scales=radius, sh0=red))
    np.testing.assert_allclose(pictures[INNER], np.broadcast_to([1, 0, 0], (2, 8, 8, 3)), atol=0.05)
    same = np.s_[:, -8:, :4]
    np.testing.assert_allclose(pictures[same], scene_pictures(scene)[same], atol=1e-6)
    assert masks.all()
    assert noted(notes, "drawings")


def test_small_differences_of_the_drawing_are_those_of_its_errors(scene: Scene) -> None:
    """Rows of wrong depth cover a few others; after the blur that is little."""
    rng = np.random.default_rng(0)
    astray = rng.random(scene.pixels.shown.shape) < 0.01
    camera = np.repeat(scene.cameras.centres, scene.pixels_per_view, 0)[astray.reshape(-1)]
    means = camera + 0.7 * (scene.gaussians.means[astray.reshape(-1)] - camera)
    pictures, _, _ = pictures_of(changed(scene, astray, means=means))
    np.testing.assert_allclose(pictures, scene_pictures(scene), atol=1e-6)


def test_layers_of_one_camera_make_one_picture(scene: Scene) -> None:
    """The nearest first, each with what those before it let through, whichever comes first in the file."""
    every = np.ones_like(scene.pixels.shown)
    red, blue = (
        changed(scene, every, sh0=rgb_to_sh0(np.array(rgb)).astype(np.float32), opacities=0.6)
        for rgb in ([1.0, 0, 0], [0, 0, 1.0])
    )
    camera = np.repeat(scene.cameras.centres, scene.pixels_per_view, 0)
    behind = changed(blue, every, means=camera + 1.02 * (scene.gaussians.means - camera))
    for layers in ((red, behind), (behind, red)):
        pictures, _, _ = pictures_of(two_layers(*layers))
        expected = np.array([0.6, 0, 0.4 * 0.6]) / 0.84
        np.testing.assert_allclose(pictures, np.broadcast_to(expected, pictures.shape), atol=1e-5)


def test_pixels_without_a_row_count_where_something_is_drawn_there(scene: Scene) -> None:
    inside = square(scene)
    holes = scenes.shown_in(scene, ~inside)
    _, masks, _ = pictures_of(holes)
    np.testing.assert_array_equal(masks[INNER], False)
    assert masks[:, :4].all()
    covered = changed(holes, np.ones(len(holes.gaussians), bool), scales=scene.gaussians.scales.max() * 8)
    pictures, masks, _ = pictures_of(covered)
    assert masks[INNER].all()
    assert pictures[INNER].min() > 0
