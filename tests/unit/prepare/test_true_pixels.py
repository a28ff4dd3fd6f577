"""Gaussians in any order get homes and fronts in the views, and those that are hidden a least size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
import unaligned_scenes
from sweeps import sweep

from gsmerge import Gaussians, Scene, compact
from gsmerge.method.geometry.frame import canonicalise
from gsmerge.method.geometry.transforms import camera_depths
from gsmerge.method.kernels import elementary
from gsmerge.prepare.true_pixels import HIDDEN_SIZE, LOW_PASS, choose_level, find_pixels, raise_sizes, with_pixels
from gsmerge.types import NO_CAMERAS

WIDTH, HEIGHT = 96, 72


@pytest.fixture(scope="module")
def room() -> Scene:
    return canonicalise(scenes.make_scene(scenes.room(), scenes.arc(3, WIDTH, HEIGHT)))[0]


def depth_errors(scene: Scene, room: Scene) -> np.ndarray:
    """Return logarithms of the depths of fronts over those of the surfaces, of pixels with one."""
    fronts = find_pixels(scene).fronts
    depths, true = (
        np.stack([camera_depths(some.gaussians.means[front], pose) for front, pose in zip(f, poses, strict=True)])
        for some, f, poses in (
            (scene, fronts, scene.cameras.viewmats),
            (room, room.pixels.fronts, room.cameras.viewmats),
        )
    )
    return np.abs(elementary.log(depths / true))[fronts >= 0]


def test_fronts_of_rows_in_any_order_are_those_of_their_surface(room: Scene) -> None:
    scene = unaligned_scenes.shuffled(room)
    pixels = find_pixels(scene)
    assert not pixels.own
    assert pixels.shown.mean() > 0.99
    assert (pixels.homes >= 0).mean() > 0.99
    assert np.median(depth_errors(scene, room)) < 0.01


@pytest.mark.parametrize(("every", "level"), [(1, 1), (4, 2), (16, 3)])
def test_cells_are_as_wide_as_gaussians_are_apart(every: int, level: int, room: Scene) -> None:
    """What lies behind shows through gaps between centres, not between cells."""
    few = np.random.default_rng(0).permutation(WIDTH * HEIGHT)[: WIDTH * HEIGHT // every]
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask.reshape(-1)[few] = True
    assert choose_level(mask, 64.0) in (level, level + 1)
    step = round(every**0.5)
    kept = np.arange(len(room.gaussians)).reshape(3, HEIGHT, WIDTH)[:, ::step, ::step].reshape(-1)
    g = room.gaussians
    scene = unaligned_scenes.without_order(replace(room, gaussians=replace(g, scales=step * g.scales)), kept)
    assert find_pixels(scene).shown.mean() > 0.97
    assert (depth_errors(scene, room) < 0.1).mean() > 0.9


def test_gaps_wider_than_cells_have_no_fronts(room: Scene) -> None:
    kept = np.ones((3, HEIGHT, WIDTH), bool)
    kept[:, 20:40, 30:60] = False
    scene = unaligned_scenes.without_order(room, np.flatnonzero(kept)[np.flatnonzero(kept) < WIDTH * HEIGHT])
    shown = find_pixels(replace(scene, cameras=scene.cameras[[0]], images=None, names=("a",))).shown[0]
    assert not shown[22:38, 32:58].any()
    assert shown[:18].mean() > 0.99


def test_pixels_do_not_depend_on_the_order_of_rows(room: Scene) -> None:
    """Where no two are equally deep."""
    rng, g = np.random.default_rng(4), room.gaussians
    uneven = replace(g, means=g.means + rng.normal(0, 1e-3, g.means.shape).astype(np.float32))
    for every in (1, 9):
        scene = unaligned_scenes.without_order(replace(room, gaussians=uneven[::every], pixels=None))
        order = rng.permutation(len(scene.gaussians))
        one, other = find_pixels(scene), find_pixels(replace(scene, gaussians=scene.gaussians[order]))
        np.testing.assert_array_equal(other.homes, one.homes[order])
        np.testing.assert_array_equal(np.where(other.shown, order[other.fronts], -1), one.fronts)


def test_views_that_look_away_have_no_fronts(room: Scene) -> None:
    viewmats = room.cameras.viewmats.copy()
    viewmats[1] = np.diag([-1.0, 1, -1, 1]) @ viewmats[1]
    away = replace(room, cameras=replace(room.cameras, viewmats=viewmats), pixels=None)
    shown = find_pixels(away).shown
    assert shown.any((1, 2)).tolist() == [True, False, True]


def resized(gaussians: Gaussians, factor: float, every: int = 1) -> Gaussians:
    scales = gaussians.scales.copy()
    scales[::every] *= factor
    return replace(gaussians, scales=scales)


def least_scales(scene: Scene) -> np.ndarray:
    """Return scales: the low-pass where that of the pixel hides a Gaussian, or else what they were."""
    scales, homes = scene.gaussians.scales.copy(), scene.pixels.homes.tolist()
    for row, home in enumerate(homes):
        view = home // scene.pixels_per_view
        depth = camera_depths(scene.gaussians.means[row].astype(float), scene.cameras.viewmats[view])
        pixel = depth / np.sqrt(scene.cameras.Ks[view, 0, 0] * scene.cameras.Ks[view, 1, 1])
        if scales[row].max() * np.sqrt(homes.count(home)) < HIDDEN_SIZE * LOW_PASS * pixel:
            scales[row] = LOW_PASS * pixel
    return scales


@pytest.mark.parametrize(
    ("factor", "every", "noted"), [(1, 1, False), (1 / 30, 1, True), (1e-6, 3, True), (0.03, 15, False)]
)
@pytest.mark.parametrize("own", [True, False])
def test_hidden_gaussians_get_the_size_of_the_low_pass(factor: float, every: int, noted: bool, own: bool) -> None:
    """Unless they are few."""
    room = scenes.make_scene(scenes.room(), scenes.arc(2, 32, 24))
    room = canonicalise(replace(room, gaussians=resized(room.gaussians, factor, every)))[0]
    scene = with_pixels(room if own else unaligned_scenes.shuffled(room))
    seen = scene.pixels.homes >= 0
    raised, change = raise_sizes(scene)
    assert ("far smaller than a pixel" in change) == noted
    assert (raised is scene) == (not noted)
    if noted:
        np.testing.assert_allclose(raised.gaussians.scales[seen], least_scales(scene)[seen], rtol=1e-5)
        assert (raised.gaussians.scales > scene.gaussians.scales)[seen].any(1).mean() > 0.2


def test_sizes_of_a_sound_scene_are_not_raised_for_views_of_few_pixels(room: Scene) -> None:
    cameras = room.cameras
    Ks = cameras.Ks / np.array([[8], [8], [1]], cameras.Ks.dtype)
    small = replace(cameras, Ks=Ks, width=WIDTH // 8, height=HEIGHT // 8)
    scene = with_pixels(Scene(room.gaussians, small, None, None, room.names))
    assert raise_sizes(scene)[0] is scene
    assert raise_sizes(replace(scene, gaussians=resized(scene.gaussians, 0.01)))[0] is not scene


@sweep("factor", [1 / 30, 1e-5])
@pytest.mark.parametrize("kind", ["grid", "shuffled", "no cameras"])
def test_tiny_gaussians_are_merged_as_well_as_sound_ones(kind: str, factor: float) -> None:
    """The input is drawn well by the low-pass alone, and the result is about as good as that of sound Gaussians."""
    sound = scenes.make_scene(scenes.room(), scenes.arc(3, 48, 36), noise=0.03)
    if kind != "grid":
        cameras = {"cameras": NO_CAMERAS, "images": None, "names": ()} if kind == "no cameras" else {}
        sound = replace(unaligned_scenes.shuffled(sound), **cameras)
    scene = replace(sound, gaussians=resized(sound.gaussians, factor))
    settings = {"budget": 600, "fit_steps": 60, "checkpoint": "none"} | (
        {"fit": "none"} if kind == "no cameras" else {}
    )
    reports = [compact(some, **settings).report for some in (sound, scene)]
    assert [report.num_output for report in reports] == [600, 600]
    if kind == "no cameras":
        psnrs = [report.choices["fidelity"]["psnr"] for report in reports]
    else:
        psnrs = [report.psnr_after for report in reports]
        assert psnrs[1] > reports[1].psnr_before
    assert psnrs[1] > psnrs[0] - 1, psnrs  # dB
