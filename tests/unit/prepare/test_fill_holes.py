"""Pixels that no Gaussian covers are filled with Gaussians; large parts stay empty unless photos are asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scenes
from exports import da3_rows, export_rows, save_export, smooth_scene
from messages import noted
from sweeps import sweep
from tiny_scene import write_npz

from gsmerge import Scene, compact
from gsmerge.method.geometry.transforms import camera_depths, rgb_to_sh0
from gsmerge.method.kernels import elementary
from gsmerge.method.raster import render
from gsmerge.prepare.fill_holes import LARGE_SIDE, RIM_PIXELS, fill_holes, large_parts
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.prepare.true_pixels import with_pixels
from gsmerge.reading.read_scene import load_scene
from gsmerge.runtime.record import record_run
from gsmerge.types import Cameras, Gaussians, PicturedScene, Pixels

WIDTH, HEIGHT, NEAR, FAR, FLOOR = 96, 64, 3.0, 6.0, 24
K = np.array([[80.0, 0, 48], [0, 80, 32], [0, 0, 1]])


def make_walls(*, moved: float = 0.5, floor: int = FLOOR) -> PicturedScene:
    """Make three views, each ``moved`` to the right, of a far wall above a near one; the near one alone has rows."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    depth = np.where(y < floor, FAR, NEAR)
    viewmats = np.tile(np.eye(4), (3, 1, 1))
    means, images = [], []
    for view in range(3):
        viewmats[view, 0, 3] = -moved * view
        rays = np.stack([(x - 48) / 80, (y - 32) / 80, np.ones_like(x)], -1)
        world = rays * depth[..., None] + np.array([moved * view, 0, 0])
        u, v = world[..., 0], world[..., 1]
        colors = [elementary.sin(9 * u + 3 * v), elementary.sin(5 * u - 8 * v), elementary.sin(2 * u * v + 4 * v)]
        images.append(0.5 + 0.4 * np.stack(colors, -1))
        means.append(world.reshape(-1, 3))
    kept = np.zeros((3, HEIGHT, WIDTH), bool)
    kept[:, floor:-2, 3:-3] = True
    photos, count = np.stack(images).astype(np.float32), kept.size
    gaussians = Gaussians(
        means=np.concatenate(means).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scales=np.full((count, 3), 0.03, np.float32),
        opacities=np.full(count, 0.9, np.float32),
        sh0=rgb_to_sh0(photos.reshape(-1, 1, 3)),
        shN=np.zeros((count, 0, 3), np.float32),
    )
    cameras = Cameras(viewmats, np.tile(K, (3, 1, 1)), WIDTH, HEIGHT)
    return PicturedScene(gaussians[kept.reshape(-1)], cameras, photos, Pixels.of_grid(kept), ("a", "b", "c"))


def without_pixels(scene: PicturedScene) -> PicturedScene:
    """Return the same rows, those that are there, in no order."""
    rows = np.random.default_rng(0).permutation(len(scene.gaussians))
    return with_pixels(replace(scene, gaussians=scene.gaussians[rows], pixels=None))


def new_in(filled: PicturedScene, scene: PicturedScene) -> np.ndarray:
    """Return the mask ``[v,h,w]`` of the pixels that showed nothing before."""
    return filled.pixels.shown & ~scene.pixels.shown


def filled_everywhere(scene: PicturedScene) -> PicturedScene:
    """Fill the scene where its pictures show something: everywhere."""
    return fill_holes(scene, np.ones(scene.images.shape[:3], bool), everywhere=True)


def depths_of(scene: PicturedScene) -> np.ndarray:
    """Return the depth of each pixel's Gaussian ``[v,h,w]``."""
    means = scene.gaussians.means[scene.pixels.fronts]
    return np.stack([camera_depths(*pair) for pair in zip(means, scene.cameras.viewmats[:, None, None], strict=True)])


def test_filled_far_pixels_lie_where_the_photos_agree() -> None:
    filled = filled_everywhere(make_walls())
    far = (slice(None), slice(6, FLOOR - 6), slice(10, -10))
    assert filled.pixels.shown[far].all()
    assert (np.abs(np.log(depths_of(filled)[far] / FAR)) < 0.1).mean() > 0.9


def test_filling_keeps_rows_before_those_marked_as_filled() -> None:
    scene = make_walls()
    filled, count = filled_everywhere(scene), len(scene.gaussians)
    assert all(np.array_equal(values[:count], getattr(scene.gaussians, name))
               for name, values in vars(filled.gaussians).items())  # fmt: skip
    assert np.array_equal(filled.filled, np.arange(len(filled.gaussians)) >= count)
    new = new_in(filled, scene)
    assert np.array_equal(np.sort(filled.pixels.homes[count:]), np.flatnonzero(new))
    assert np.array_equal(filled.pixels.fronts[~new], scene.pixels.fronts[~new])


def test_filled_pixels_without_parallax_have_the_depth_beside_them() -> None:
    filled = filled_everywhere(make_walls(moved=0.0))
    new = new_in(filled, make_walls())
    assert new[:, :FLOOR].any()
    assert np.allclose(depths_of(filled)[new], NEAR, rtol=1e-3)


def test_filled_holes_between_rows_have_the_depth_beside_them() -> None:
    """Squares missing from the near wall: the photos do not speak for another depth."""
    scene = make_walls()
    kept = scene.pixels.shown.copy()
    kept[:, 40:48, 12:-12] = False
    filled = filled_everywhere(scenes.shown_in(scene, kept))
    inner = np.zeros_like(kept)
    inner[:, 42:46, 20:-20] = True
    inner &= filled.pixels.shown
    assert inner.sum() > 100
    assert (np.abs(np.log(depths_of(filled)[inner] / NEAR)) < 0.02).mean() > 0.95


def test_filled_rows_follow_the_rows_of_a_scene_without_pixels() -> None:
    scene = without_pixels(make_walls())
    filled = filled_everywhere(scene)
    count = len(scene.gaussians)
    assert all(np.array_equal(values[:count], getattr(scene.gaussians, name))
               for name, values in vars(filled.gaussians).items())  # fmt: skip
    before, after = (render(some.gaussians, some.cameras).alphas for some in (scene, filled))
    assert (before < 0.5).mean() > 0.3
    assert (after > 0.5).mean() > 0.99


def test_a_part_of_what_photos_show_is_not_filled() -> None:
    scene = without_pixels(make_walls(floor=40))
    assert filled_everywhere(scene) is scene


def test_only_pixels_that_are_shown_are_filled() -> None:
    scene = make_walls()
    shown = np.zeros_like(scene.pixels.shown)
    shown[1, 4:12] = True
    new = new_in(fill_holes(scene, shown, everywhere=True), scene)
    assert new.any()
    assert not (new & ~shown).any()


def test_nothing_is_filled_where_everything_is_covered() -> None:
    scene = make_walls()
    full = replace(filled_everywhere(scene), filled=None)
    assert filled_everywhere(full) is full
    unordered = without_pixels(full)
    assert filled_everywhere(unordered) is unordered


def test_views_that_show_no_gaussian_stay_empty() -> None:
    scene = make_walls()
    viewmats = scene.cameras.viewmats.copy()
    viewmats[2, :3, :3] = np.diag([-1, 1, -1])  # looks away
    turned = replace(scene, cameras=replace(scene.cameras, viewmats=viewmats))
    assert not new_in(filled_everywhere(turned), scene)[2].any()


@pytest.mark.parametrize("photos", [True, False])
def test_dropped_pixels_are_filled_where_cameras_are_known(tmp_path: Path, photos: bool) -> None:
    """Rows of Depth Anything 3 with cameras in the place of its depth maps, with photos or their own colours."""
    tiny = smooth_scene(96, 72)
    folder = save_export(tmp_path, tiny, export_rows(tiny, da3_rows(tiny)))
    loaded = load_scene(folder).scene
    scene = loaded if photos else replace(loaded, images=None)
    assert np.array_equal(np.flatnonzero(scene.pixels.shown.reshape(-1)), da3_rows(tiny))
    prepared = prepare(scene)
    added = len(prepared.scene.gaussians) - len(scene.gaussians)
    usual = "which is usual"  # Depth Anything 3 leaves out the borders of all views
    assert noted(prepared.changes, f"{added} Gaussians added at pixels that no Gaussian covered", usual)
    alphas = render(prepared.scene.gaussians, prepared.scene.cameras).alphas
    assert (alphas > 0.5).mean() > 0.99
    assert np.array_equal(prepared.input_scene.pixels.shown, scene.pixels.shown)


def test_a_view_that_lost_its_rows_is_named_among_what_is_filled(tmp_path: Path) -> None:
    """Its missing rows are no borders that a model left out, also if the other views have no borders."""
    tiny = smooth_scene(96, 72)
    kept = da3_rows(tiny)
    scene = load_scene(save_export(tmp_path, tiny, export_rows(tiny, kept))).scene
    shown = scene.pixels.shown.copy()
    shown[1] = False
    prepared = prepare(scenes.shown_in(PicturedScene.with_pictures(scene, scene.images, None), shown))
    assert noted(prepared.changes, "Gaussians added", scene.names[1])
    assert not noted(prepared.changes, "which is usual")


def test_views_whose_photos_do_not_show_the_scene_stay_empty() -> None:
    scene = make_walls()
    images = scene.images.copy()
    images[1] = np.random.default_rng(0).random(images[1].shape)
    prepared = prepare(replace(scene, images=images))
    assert prepared.reference.score_views == (0, 2)
    assert new_in(prepared.scene, scene).any((1, 2)).tolist() == [True, False, True]


def test_shares_of_a_budget_do_not_count_filled_gaussians() -> None:
    """Not of the file and the Gaussians that were added."""
    scene = without_pixels(make_walls())
    count = len(scene.gaussians)
    assert len(compact(scene, budget="10%", fill=True, effort="draft").gaussians) == round(0.1 * count)


def test_depth_maps_of_the_model_fill_what_it_dropped(tmp_path: Path) -> None:
    """In whatever unit they are. A map that does not belong to the views, or has no depth, is named and not used."""
    named = list[bool]()
    tiny = smooth_scene(96, 72)
    folder = save_export(tmp_path, tiny, export_rows(tiny, da3_rows(tiny)), cameras=False)
    dropped = ~np.isin(np.arange(tiny.depths.size), da3_rows(tiny)).reshape(tiny.depths.shape)

    def errors_of(maps: np.ndarray) -> np.ndarray:
        """Return by which share the depths of what is filled differ from the truth."""
        write_npz(folder / "results.npz", tiny, depth=maps.astype(np.float32))
        with record_run() as record:
            prepared = prepare(load_scene(folder).scene)
        named.append(noted(record.notes, "3 of 3 views", *prepared.scene.names))
        scene, found = prepared.scene, []
        assert scene.depths is None
        for view, fronts in enumerate(scene.get_pixels().fronts):
            means = prepared.frame.leave(scene.gaussians).means[fronts[dropped[view] & (fronts >= 0)]]
            depths = camera_depths(means.astype(np.float64), prepared.input_scene.cameras.viewmats[view])
            found.append(np.abs(depths / tiny.depths[view][dropped[view] & (fronts >= 0)] - 1))
        return np.concatenate(found)

    right, guessed = errors_of(1.7 * tiny.depths), errors_of(np.full_like(tiny.depths, np.nan))
    wrong = errors_of(
        np.random.default_rng(0).permuted(tiny.depths.reshape(len(tiny.depths), -1), axis=1).reshape(tiny.depths.shape)
    )
    assert np.median(right) < 0.01 < np.median(guessed)
    np.testing.assert_array_equal(wrong, guessed)
    assert named == [False, True, True]


def test_a_depth_map_counts_where_few_gaussians_tell_its_unit() -> None:
    """In a view that has lost nearly all of them."""
    scene = make_walls()
    maps = 1.7 * depths_of(filled_everywhere(scene))
    kept = scene.pixels.shown.copy()
    kept[1] = False
    kept[1].reshape(-1)[np.flatnonzero(scene.pixels.shown[1])[::100]] = True
    few = replace(scenes.shown_in(scene, kept), depths=maps)
    filled = filled_everywhere(few)
    new = new_in(filled, few)[1]
    assert new.mean() > 0.3
    assert np.median(np.abs(np.log(1.7 * depths_of(filled)[1][new] / maps[1][new]))) < 0.01


def test_a_depth_map_fills_a_hole_beside_which_nothing_is_covered(tmp_path: Path) -> None:
    """All of the tiles that the hole touches are bare, so no drawing knows a depth beside it."""
    tiny = smooth_scene(96, 72)
    scene = load_scene(save_export(tmp_path, tiny, export_rows(tiny))).scene
    kept = scene.pixels.shown.copy()
    kept[:, 2:46, 18:78] = False
    holed = PicturedScene.with_pictures(scenes.shown_in(scene, kept), scene.images, None)
    shown = np.zeros_like(kept)
    shown[1, 16:32, 32:64] = True
    filled = fill_holes(replace(holed, depths=tiny.depths), shown, everywhere=True)
    assert np.array_equal(new_in(filled, holed), shown)
    assert np.allclose(depths_of(filled)[shown], tiny.depths[shown], rtol=1e-3)


@pytest.mark.parametrize("is_right", [True, False])
def test_other_views_confirm_the_map_of_a_view_that_has_lost_its_rows(tmp_path: Path, *, is_right: bool) -> None:
    """Of its own rows one is left, which confirms nothing."""
    tiny = smooth_scene(96, 72)
    scene = load_scene(save_export(tmp_path, tiny, export_rows(tiny))).scene
    kept = scene.pixels.shown.copy()
    kept[1] = False
    kept[1, 50, 40] = True
    maps = tiny.depths.copy()
    maps[1] = maps[1] if is_right else np.random.default_rng(0).permuted(maps[1])
    few = PicturedScene.with_pictures(scenes.shown_in(scene, kept), scene.images, None)
    with record_run() as record:
        filled_everywhere(replace(few, depths=3 * maps))
    assert noted(record.notes, "depth maps", "1 of 3 views", scene.names[1]) != is_right


LOST: dict[str, tuple[Callable[[np.ndarray], None], float]] = {  # changes of rows [v,h,w], and dB that they may cost
    "some placeholders": (lambda rows: rows.reshape(-1)[::97].fill(0), 0.3),
    "a strip times a mask": (lambda rows: rows[:, :, :12].fill(0), 0.3),
    "a view of NaN": (lambda rows: [rows[name][2].fill(np.nan) for name in rows.dtype.names], 0.8),
}


@sweep("kind", LOST)
def test_rows_that_show_nothing_cost_little(tmp_path: Path, kind: str) -> None:
    """They are set aside, and what the photos show in their place is there."""
    tiny, (change, cost) = smooth_scene(96, 72), LOST[kind]
    rows = export_rows(tiny)
    sound = load_scene(save_export(tmp_path / "sound", tiny, rows)).scene
    change(rows.reshape(3, 72, 96))
    if kind != "some placeholders":
        rows["rot_0"][rows["opacity"] == 0] = 1
    loaded = load_scene(save_export(tmp_path / "lost", tiny, rows))
    assert loaded.scene.has_own_pixels
    assert noted(loaded.notes, f"{np.count_nonzero(~(np.abs(rows['opacity']) > 0)):,}")
    settings = {"superpixels": "5%", "fit_steps": 60, "poses": "fixed", "new_views": False}
    psnrs = [scenes.psnr_of(compact(one, **settings).gaussians, sound) for one in (loaded.scene, sound)]
    assert psnrs[0] > psnrs[1] - cost


WIDE, HIGH, THIRD = 96, 72, 24
AROUND = 6  # pixels beside an object into which few Gaussians reach
FIT = {"superpixels": 200, "fit_steps": 30, "checkpoint": "none", "poses": "fixed", "new_views": False}


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(4, WIDE, HIGH))


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


@pytest.mark.slow
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
    empty = scene.empty == 1
    assert not (scene.masks & empty).any()
    assert (scene.images[empty] == 0).all()
    assert empty[:, : THIRD - 2 * RIM_PIXELS].mean() > 0.95  # other views show some of it
    assert not empty[:, THIRD:].any()
    assert prepare(room).scene.empty is None


def test_large_parts_are_those_that_hold_a_large_square() -> None:
    side = round(LARGE_SIDE * WIDE)
    for width, large in ((side // 2, False), (side + 2, True)):
        empty = np.zeros((HIGH, WIDE), bool)
        empty[10 : 10 + width, 5:90] = True
        actual = large_parts(empty)
        assert actual.any() == large
        assert not (actual & ~empty).any()
    assert not large_parts(np.zeros((HIGH, WIDE), bool)).any()
    assert large_parts(np.ones((HIGH, WIDE), bool)).all()
