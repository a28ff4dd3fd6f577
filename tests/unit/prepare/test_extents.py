"""Large parts of photos in which a scene shows nothing stay empty, unless photos are asked for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import scenes

from gsmerge import Gaussians, Scene, compact, render
from gsmerge.prepare.fill_holes import LARGE_SIDE, RIM_PIXELS, large_parts
from gsmerge.prepare.prepare_scene import prepare

WIDTH, HEIGHT, THIRD = 96, 72, 24
AROUND = 6  # pixels beside an object into which few Gaussians reach
FIT = {"superpixels": 200, "fit_steps": 30, "checkpoint": "none", "poses": "fixed", "new_views": False}


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(4, WIDTH, HEIGHT))


def without_top(scene: Scene) -> Scene:
    valid = scene.pixels.shown.copy()
    valid[:, :THIRD] = False
    return scenes.shown_in(scene, valid)


def ball_alone(scene: Scene) -> Scene:
    """Return the Gaussians of the ball without pixels, beside photos of the whole room."""
    near = np.linalg.norm(scene.gaussians.means - np.array([0.2, 0.1, 2.6]), axis=1) < 0.55
    return replace(scene, gaussians=scene.gaussians[np.flatnonzero(near)], pixels=None)


def alphas(gaussians: Gaussians, scene: Scene) -> np.ndarray:
    return np.asarray(render(gaussians, scene.cameras).alphas[..., 0])


def compare_extents(scene: Scene, **settings: Any) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return what the input and its result cover, and the notes that name the setting."""
    result = compact(scene, **FIT, **settings)
    notes = [note for note in result.report.notes if "--set extent=photos" in note]
    return alphas(scene.gaussians, scene), alphas(result.gaussians, scene), notes


def test_a_part_without_rows_stays_empty(room: Scene) -> None:
    before, after, notes = compare_extents(without_top(room))
    top = np.s_[:, : THIRD - 2 * RIM_PIXELS]
    assert after[top].mean() <= before[top].mean() + 0.02
    assert after[:, THIRD + RIM_PIXELS :].mean() > 0.9
    assert len(notes) == 1
    assert "4 of 4 views" in notes[0]


def test_thin_rows_are_not_taken_for_empty_parts(room: Scene) -> None:
    """Rows of which a ray meets a sixth show the whole room; without those of the top they show all but the top."""
    for scene, count in ((room, 0), (without_top(room), 1)):
        faint = replace(scene.gaussians, opacities=0.02 * scene.gaussians.opacities)
        _, _, notes = compare_extents(replace(scene, gaussians=faint, pixels=None))
        assert len(notes) == count


def test_photos_fill_an_empty_part_where_that_is_asked_for(room: Scene) -> None:
    _, after, notes = compare_extents(without_top(room), extent="photos")
    assert after[:, :THIRD].mean() > 0.9
    assert notes == []


def test_borders_and_small_holes_are_filled(room: Scene) -> None:
    valid = np.zeros_like(room.pixels.shown)
    valid[:, 3:-3, 3:-3] = True
    valid[:, 30:35, 40:45] = False
    _, after, notes = compare_extents(scenes.shown_in(room, valid))
    assert after.mean() > 0.95
    assert after[:, 30:35, 40:45].mean() > 0.9
    assert notes == []


def test_an_object_stays_alone_beside_photos_of_its_room(room: Scene) -> None:
    scene = ball_alone(room)
    before, after, _ = compare_extents(scene)
    around = np.ones((2 * AROUND + 1,) * 2, np.uint8)
    beside = np.stack([cv2.dilate((alpha > 0.02).astype(np.uint8), around) for alpha in before]) == 0
    assert beside.mean() > 0.3
    assert after[beside].mean() <= before[beside].mean() + 0.02
    assert after[before > 0.95].mean() > 0.8


def test_empty_parts_are_left_out_of_the_masks(room: Scene) -> None:
    scene = prepare(without_top(room)).scene
    assert scene.empty is not None
    assert scene.masks is not None
    empty = scene.empty == 1
    assert not (scene.masks & empty).any()
    assert (scene.images[empty] == 0).all()
    assert empty[:, : THIRD - 2 * RIM_PIXELS].mean() > 0.95  # other views show some of it
    assert not empty[:, THIRD:].any()
    assert prepare(room).scene.empty is None


def test_large_parts_are_those_that_hold_a_large_square() -> None:
    side = round(LARGE_SIDE * WIDTH)
    for width, large in ((side // 2, False), (side + 2, True)):
        empty = np.zeros((HEIGHT, WIDTH), bool)
        empty[10 : 10 + width, 5:90] = True
        actual = large_parts(empty)
        assert actual.any() == large
        assert not (actual & ~empty).any()
    assert not large_parts(np.zeros((HEIGHT, WIDTH), bool)).any()
    assert large_parts(np.ones((HEIGHT, WIDTH), bool)).all()
