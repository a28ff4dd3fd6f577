"""A result has the look of its Gaussians, unless that of the photos is asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scenes
import unaligned_scenes
from messages import noted

from gsmerge import CompactResult, Scene, compact, render
from gsmerge.geometry.transforms import rgb_to_sh0, sh0_to_rgb
from gsmerge.prepare.compare_photos import _note_hidden, have_other_tones
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.prepare.row_colors import PHOTOS, ROW_COLORS
from gsmerge.runtime.record import record_run
from gsmerge.types import PicturedScene

Colors = np.ndarray
FIT = {"superpixels": 200, "fit_steps": 30, "checkpoint": "none", "poses": "fixed", "new_views": False}


def grey(colors: Colors) -> Colors:
    return np.repeat((colors @ np.array([0.3, 0.59, 0.11]))[..., None], 3, -1)


def false_colors(colors: Colors) -> Colors:
    return np.stack([1 - colors[..., 2], colors[..., 0], (2 * colors[..., 1]) % 1], -1)


def styled(colors: Colors) -> Colors:
    """Draw in green inks on pale paper."""
    light = grey(colors)[..., 0]
    return np.stack([1 - 0.9 * light, 0.9 - 0.4 * light**2, 0.3 + 0.6 * np.abs(2 * light - 1)], -1).clip(0, 1)


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(4, 96, 72))


def with_look(scene: Scene, look: Callable[[Colors], Colors]) -> Scene:
    """Return the scene with other colours of its Gaussians beside the same photos."""
    colors = look(sh0_to_rgb(scene.gaussians.sh0[:, 0]).clip(0, 1).astype(np.float64))
    return replace(scene, gaussians=replace(scene.gaussians, sh0=rgb_to_sh0(colors.astype(np.float32))[:, None]))


def distances(result: CompactResult, scene: Scene) -> tuple[float, float]:
    """Return the mean difference of colours from the scene's own Gaussians and from its photos."""
    shown, own = (render(each, scene.cameras).images for each in (result.gaussians, scene.gaussians))
    return float(np.abs(shown - own).mean()), float(np.abs(shown - scene.images).mean())


@pytest.mark.parametrize(("rows", "is_noted"), [(1, True), (0, False)])
def test_photos_that_differ_are_noted_from_a_percent_of_their_pixels(rows: int, is_noted: bool, room: Scene) -> None:
    hidden = np.zeros(room.images.shape[:3], bool)
    hidden[0, :rows] = hidden[0, -1, :9] = True
    with record_run() as record:
        _note_hidden(room, hidden, range(4))
    assert noted(record.notes, "1 of 4 photos differ in part", "2 %") == is_noted


@pytest.mark.parametrize(
    "look",
    [grey, false_colors, styled, lambda colors: colors[..., ::-1]],
    ids=["grey", "false colours", "styled", "BGR"],
)
def test_a_scene_keeps_its_look_beside_other_photos(look: Callable[[Colors], Colors], room: Scene) -> None:
    scene = with_look(room, look)
    result = compact(scene, **FIT)
    assert result.report.psnr_reference == ROW_COLORS
    assert len([note for note in result.report.notes if "--set look=photos" in note]) == 1
    own, photos = distances(result, scene)
    assert own < 0.6 * photos  # clearly nearer to its own look


@pytest.mark.parametrize("look", [grey, false_colors, styled])
def test_the_look_of_photos_is_taken_where_that_is_asked_for(look: Callable[[Colors], Colors], room: Scene) -> None:
    scene = with_look(room, look)
    result = compact(scene, **FIT, look="photos")
    assert result.report.psnr_reference == PHOTOS
    assert not noted(result.report.notes, "look")
    own, photos = distances(result, scene)
    assert photos < 0.6 * own  # clearly nearer to the look of the photos


def test_photos_of_another_scene_are_noted_as_no_look(room: Scene) -> None:
    other = scenes.make_scene(scenes.wall(9), scenes.arc(4, 96, 72)).images
    notes = compact(replace(room, images=other), **FIT).report.notes
    assert noted(notes, "4 of 4", "do not show what the Gaussians show")
    assert not [note for note in notes if "look=photos" in note]


def test_photos_of_a_mildly_different_grade_are_followed(room: Scene) -> None:
    result = compact(with_look(room, lambda colors: 0.95 * colors**0.93 + 0.01), **FIT)
    assert result.report.psnr_reference == PHOTOS
    assert not [note for note in result.report.notes if "look" in note]


@pytest.mark.parametrize("change", [None, lambda photo: 0.8 * photo, lambda photo: photo**1.5], ids=["none", "*", "^"])
def test_the_tone_of_gaussians_does_not_depend_on_what_hides_them(change: Callable | None) -> None:
    """A dark wall in front of every view darkens drawings; the colours of all Gaussians are those of the photos."""
    scene = scenes.make_scene(scenes.room(), scenes.arc(4, 48, 36))
    pictured = PicturedScene.with_pictures(unaligned_scenes.shuffled(scene), scene.images, None)
    dark = np.flatnonzero(pictured.gaussians.sh0.mean((1, 2)) < np.quantile(pictured.gaussians.sh0.mean((1, 2)), 0.2))
    means = pictured.gaussians.means.copy()
    means[dark] = scene.cameras.centres.mean(0) + 0.5 * (means[dark] - scene.cameras.centres.mean(0))
    near = replace(pictured, gaussians=replace(pictured.gaussians, means=means))
    near = near if change is None else replace(near, images=change(scene.images))
    assert have_other_tones(near, range(4)) == (change is not None)
    nothing = replace(near, gaussians=near.gaussians[:0])
    assert have_other_tones(nothing, range(4))  # which says nothing against what drawings say


@pytest.mark.parametrize(("opacity", "size"), [(0.5, 1.0), (1.0, 0.35)], ids=["thin", "sparse"])
def test_photos_stay_beside_gaussians_that_draw_them_dark(opacity: float, size: float, room: Scene) -> None:
    """Light passes through thin Gaussians and between sparse ones, whose colours are those of the photos."""
    scene = unaligned_scenes.voxels(room, 0.06)
    g = scene.gaussians
    dark = replace(scene, gaussians=replace(g, opacities=opacity * g.opacities, scales=np.float32(size) * g.scales))
    assert render(dark.gaussians, dark.cameras).images.mean() < 0.8 * room.images.mean()
    with record_run() as record:
        prepared = prepare(dark)
    assert prepared.reference.name == PHOTOS
    assert prepared.reference.score_views == (0, 1, 2, 3)
    assert not noted(record.notes, "tone")
    assert np.abs(prepared.scene.images - room.images).mean() < 0.01
