"""Photos and depths are those of rooms whose geometry is known by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsmerge.research.generate.objects import build_room
from gsmerge.research.generate.photograph import (
    Light,
    Pinhole,
    Room,
    find_exposure,
    light_room,
    render_light,
    screen_boxes,
    tone_map,
    trace,
)
from gsmerge.research.generate.shapes import LYING, Material, blob, box, pack_shapes, place_shapes, quad
from gsmerge.research.generate.synthetic_scene import draw_path, is_usable, look_at
from gsmerge.research.generate.textures import KINDS, Palette

LOOK = Material(0)
LENS = Pinhole(40, 30, 40.0)
WHITE = np.ones((32, 32, 3), np.float32)
DOWN = Light(np.array([0.0, -1.0, 0.0]), np.array([0.0, -5.0, 0.0]), np.ones(3), 0.2 * np.ones(3), 0.01)


def test_screen_box_of_a_shape_holds_all_its_pixels() -> None:
    """Near, far, beside and around the camera."""
    rng = np.random.default_rng(2)
    shapes = [box(p - 0.3, p + 0.3, LOOK) for p in rng.uniform(-2, 2, (20, 3))]
    shapes += [blob((0, 1, 0), (3, 1, 3), LOOK, rng, 0.3), quad((0, 0, 3), (2, 2), LOOK)]
    shapes = place_shapes(shapes, (0.1, 0, 0.4), yaw=0.3)
    given, c2w = pack_shapes(shapes), look_at(np.array([0.2, 0.1, -1.0]), np.array([0.3, 0.2, 2.0]), 0.1)
    rects = screen_boxes(given, c2w, LENS, 1)
    together = trace(given, c2w, LENS, 1)
    for m in range(len(shapes)):
        y, x = np.nonzero(together.ids == m)
        assert len(x) == 0 or (x.min() >= rects[m, 0] and x.max() < rects[m, 2])
        assert len(y) == 0 or (y.min() >= rects[m, 1] and y.max() < rects[m, 3])
    assert 8 < (rects[:, 2] > rects[:, 0]).sum() < len(shapes)


def test_a_thing_throws_shade_on_the_ground() -> None:
    ground = replace(quad((0, 0, 0), (4, 4), LOOK, LYING), shell=True)
    shapes = (ground, box((-0.5, -1, -0.5), (0.5, -0.6, 0.5), LOOK))
    view = light_room(Room(shapes, (WHITE,), DOWN, np.zeros(3), (1, 2)))
    from_side = look_at(np.array([0.0, -0.45, -3.0]), np.array([0.0, 0.0, 0.0]))
    lens = Pinhole(60, 60, 60.0)
    image, hits = render_light(view, from_side, lens, 1), trace(view.shapes, from_side, lens, 1)
    y, x = np.mgrid[:60, :60] + 0.5
    rays = np.stack([(x - 30) / 60, (y - 30) / 60, np.ones_like(x)], -1) @ from_side[:3, :3].T
    world = from_side[:3, 3] + rays * hits.depth[..., None]
    on_ground = hits.ids == 0
    under = on_ground & (np.abs(world[..., 0]) < 0.35) & (np.abs(world[..., 2]) < 0.35)
    beside = on_ground & (np.abs(world[..., 0]) > 0.9) & (np.abs(world[..., 2]) < 1.5)
    assert under.sum() > 10
    assert image[under].mean() < 0.4 * image[beside].mean()


def test_exposure_meets_the_brightness() -> None:
    pictures = [np.random.default_rng(0).uniform(0, 30, (20, 20, 3)).astype(np.float32)]
    gain = find_exposure(pictures, 0.45)
    assert tone_map(pictures[0] * gain).mean() == pytest.approx(0.45, abs=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_textures_of_a_seed_are_equal_and_not_flat(kind: str) -> None:
    picture = KINDS[kind](np.random.default_rng(5), 128)
    again = KINDS[kind](np.random.default_rng(5), 128)
    np.testing.assert_array_equal(picture, again)
    assert picture.shape == (128, 128, 3)
    assert 0 <= picture.min() <= picture.max() <= 1
    assert picture.std() > 0.002


@pytest.mark.parametrize("kind", ["plain", "plaster", "granite", "marble", "wood", "tiles", "bricks", "bark"])
@pytest.mark.parametrize("axis", [0, 1])
def test_textures_have_no_seam(axis: int, kind: str) -> None:
    picture = KINDS[kind](np.random.default_rng(1), 256).astype(float)
    steps = np.abs(np.diff(picture, axis=axis)).mean(tuple({0, 1, 2} - {axis}))
    seam = np.abs(np.take(picture, 0, axis) - np.take(picture, -1, axis)).mean()
    assert seam < 1.6 * steps.max()


@pytest.mark.slow
def test_rooms_are_seen_from_their_paths() -> None:
    built = build_room(Palette(np.random.default_rng(3), 64))
    assert len(built.shapes) > 20
    view, rng = pack_shapes(built.shapes), np.random.default_rng(0)
    worth = []
    for _ in range(8):
        pose = draw_path(built, rng, 6)
        for s in (0.0, 0.5, 1.0):
            rotation = pose(s)[:3, :3]
            np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-9)
            assert np.linalg.det(rotation) == pytest.approx(1)
            worth.append(is_usable(trace(view, pose(s), LENS, 1)))
    assert np.mean(worth) > 0.3
