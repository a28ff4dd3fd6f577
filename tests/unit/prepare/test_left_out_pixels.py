"""Pixels that no photo shows keep what the input shows, or stay empty where it shows nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from PIL import Image
from saved_cameras import write_transforms
from sweeps import sweep

from gsmerge import Compactor, Gaussians, Scene, compact, read_scene, render, write_ply
from gsmerge.method.raster.metrics import decibels
from gsmerge.prepare.prepare_scene import prepare

WIDTH, HEIGHT = 96, 72
FIT = {"superpixels": 200, "fit_steps": 60, "checkpoint": "none", "poses": "fixed", "new_views": False}


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(4, WIDTH, HEIGHT))


@pytest.fixture(scope="module")
def ball(room: Scene) -> Scene:
    """The Gaussians of the ball without pixels, beside photos of the ball before nothing."""
    near = np.linalg.norm(room.gaussians.means - np.array([0.2, 0.1, 2.6]), axis=1) < 0.55
    gaussians = room.gaussians[np.flatnonzero(near)]
    drawn = render(gaussians, room.cameras)
    return replace(room, gaussians=gaussians, pixels=None, images=drawn.images.clip(0, 1))


def over_both(gaussians: Gaussians, truth: Scene) -> float:
    """Return the lower PSNR (dB) of renders over black and over white, against the truth's own Gaussians."""
    actual, expected = (render(one, truth.cameras) for one in (gaussians, truth.gaussians))
    errors = [
        actual.images + level * (1 - actual.alphas) - expected.images - level * (1 - expected.alphas)
        for level in (0.0, 1.0)
    ]
    return min(decibels(float(np.square(error).mean())) for error in errors)


@sweep("color", [(1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.2, 0.7, 0.3)], ids=["white", "black", "green"])
def test_a_uniform_background_is_no_surface(ball: Scene, color: tuple[float, float, float]) -> None:
    alphas = render(ball.gaussians, ball.cameras).alphas
    scene = replace(ball, images=ball.images + (1 - alphas) * np.float32(color))
    result = compact(scene, **FIT)
    assert any("one colour where the scene shows nothing" in note for note in result.report.choices["changes"])
    beside = alphas[..., 0] < 0.02
    assert render(result.gaussians, ball.cameras).alphas[..., 0][beside].mean() < 0.02
    assert over_both(result.gaussians, ball) > 22


def test_a_background_with_content_is_a_surface(ball: Scene, room: Scene) -> None:
    notes = compact(replace(ball, images=room.images), **FIT).report.notes
    assert not any("one colour" in note for note in notes)


@pytest.mark.slow
def test_what_masks_leave_out_keeps_what_the_input_shows(room: Scene) -> None:
    """Whether the masks are hard or soft, and whether the rows are pixels or not."""
    masks = np.full((4, HEIGHT, WIDTH), True)
    masks[:, :20] = False
    importance = np.ones(masks.shape, np.float32)
    importance[:, 20] = 0.4
    shared = replace(room, pixels=None)
    for scene in (room, shared):
        psnrs = [
            scenes.psnr_of(compact(replace(scene, masks=masks, importance=weights), **FIT).gaussians, room)
            for weights in (None, importance)
        ]
        assert min(psnrs) > scenes.psnr_of(compact(scene, **FIT).gaussians, room) - 2.5


def test_shares_of_emptiness_are_the_transmittance_of_the_input(room: Scene) -> None:
    faint = replace(room, gaussians=replace(room.gaussians, opacities=0.3 * room.gaussians.opacities), pixels=None)
    masks = np.full((4, HEIGHT, WIDTH), True)
    masks[:, :, :30] = False
    prepared = prepare(replace(faint, masks=masks)).scene
    inner = np.s_[:, 10:-10, 5:25]
    expected = 1 - render(prepared.gaussians, prepared.cameras).alphas[..., 0]
    np.testing.assert_allclose(prepared.empty[inner], expected[inner], atol=1e-6)
    assert (prepared.empty[:, :, 31:] == 0).all()


def test_photos_of_an_object_are_compared_without_their_background(ball: Scene, room: Scene) -> None:
    """Its contrast with the object is none of the object's, also of rows that are pixels and in holes of the object."""
    alphas = render(ball.gaussians, ball.cameras).alphas[..., 0]
    inside = alphas > 0.5
    inside[:, 36:40, 40:56] = False
    scene = scenes.shown_in(room, inside)
    for level in (0.0, 1.0):
        photos = np.where(inside[..., None], room.images, np.float32(level))
        prepared = prepare(replace(scene, images=photos))
        assert prepared.reference.score_views == (0, 1, 2, 3)
        assert not (prepared.scene.masks & ~inside).any()
        assert prepared.scene.masks[inside].mean() > 0.6


@sweep("way", ["state read from its file", "state", "blocks"])
def test_what_is_empty_stays_empty_in_blocks_and_states(way: str, ball: Scene, room: Scene, tmp_path: Path) -> None:
    """Blocks share views where they meet, and a state keeps which pixels of its pictures count."""
    alphas = render(ball.gaussians, ball.cameras).alphas[..., 0]
    inside = alphas > 0.5
    photos = np.where(inside[..., None], room.images, np.float32(0))
    scene = replace(scenes.shown_in(room, inside), images=photos, masks=inside)
    if way == "blocks":
        result = compact(scene, **FIT, blocks=2)
    else:
        compactor = Compactor(superpixels=200, checkpoint="none")
        compactor.extend(scenes.take_views(scene, [0, 1]))
        compactor.extend(scenes.take_views(scene, [2, 3]))
        if "file" in way:
            compactor.save(tmp_path / "ball.gsm")
            compactor = Compactor.load(tmp_path / "ball.gsm")
        result = compactor.compact(**FIT)
    drawn = render(result.gaussians, room.cameras)
    assert drawn.alphas[..., 0][alphas < 0.02].mean() < 0.02
    assert over_both(result.gaussians, ball) > 22


def test_large_gaussians_do_not_eat_the_edge_of_an_object(ball: Scene) -> None:
    """As in trained objects and results: the edge of the photo is as sharp as before."""
    alphas = render(ball.gaussians, ball.cameras).alphas
    large = compact(
        replace(ball, images=ball.images, masks=alphas[..., 0] > 0.5), **FIT | {"superpixels": 60}
    ).gaussians
    prepared = prepare(replace(ball, gaussians=large, images=ball.images + 1 - alphas))
    solid = alphas[..., 0] > 0.95
    assert prepared.scene.masks[solid].mean() > 0.9


@pytest.mark.parametrize("part", ["an object", "all but the sky"])
@sweep("has_pixels", [True, False])
def test_what_was_cut_away_stays_empty_beside_photos_of_the_whole(part: str, has_pixels: bool, room: Scene) -> None:
    if part == "an object":
        near = np.linalg.norm(room.gaussians.means - np.array([0.2, 0.1, 2.6]), axis=1) < 0.55
    else:
        near = np.arange(len(room.gaussians)) % (HEIGHT * WIDTH) >= HEIGHT // 3 * WIDTH
    cut = scenes.shown_in(room, near.reshape(room.images.shape[:3]))
    result = compact(cut if has_pixels else replace(cut, pixels=None), **FIT).gaussians
    empty = render(cut.gaussians, cut.cameras).alphas[..., 0] < 0.02
    assert empty.mean() > 0.2
    assert render(result, cut.cameras).alphas[..., 0][empty].mean() < 0.05
    assert over_both(result, cut) > 27.5


@sweep("is_opaque", [True, False], ids=["masks", "transparency"])
def test_cut_out_photos_of_an_object_leave_its_surroundings_empty(is_opaque: bool, ball: Scene, tmp_path: Path) -> None:
    """Whether soft masks lie beside them, or the photos are transparent there and white below that."""
    alphas = render(ball.gaussians, ball.cameras).alphas
    colors = ball.images + 1 - alphas
    for view, name in enumerate(ball.names):
        levels = (255 * np.concatenate([colors[view], alphas[view]], 2).clip(0, 1)).round().astype(np.uint8)
        (tmp_path / "images").mkdir(exist_ok=True)
        Image.fromarray(levels[..., :3] if is_opaque else levels).save(tmp_path / "images" / name)
        if is_opaque:
            (tmp_path / "masks").mkdir(exist_ok=True)
            Image.fromarray(levels[..., 3]).save(tmp_path / "masks" / name)
    write_ply(tmp_path / "scene.ply", ball.gaussians)
    write_transforms(tmp_path / "transforms.json", ball.cameras, [f"images/{name}" for name in ball.names])
    result = compact(read_scene(tmp_path), **FIT).gaussians

    assert render(result, ball.cameras).alphas[alphas < 0.02].mean() < 0.02
    assert over_both(result, ball) > 36.5


def test_faint_pixels_of_a_removed_background_stay_empty(ball: Scene, room: Scene) -> None:
    """A model gives every pixel a row, those of the white background next to no opacity."""
    alphas = render(ball.gaussians, ball.cameras).alphas
    rows = alphas.reshape(-1) < 0.5
    opacities, sh0 = room.gaussians.opacities.copy(), room.gaussians.sh0.copy()
    opacities[rows], sh0[rows] = 0.01, 1.77
    white = replace(room.gaussians, opacities=opacities, sh0=sh0)
    photos = np.where(alphas > 0.5, room.images, np.float32(1))
    result = compact(replace(room, gaussians=white, images=photos), **FIT).gaussians
    assert render(result, room.cameras).alphas[alphas < 0.02].mean() < 0.03
    assert over_both(result, ball) > over_both(white, ball)
