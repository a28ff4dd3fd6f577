"""Scenes in blocks become as good and as large as in one piece."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
from messages import names, refuses
from sweeps import sweep

from gsmerge import CompactOptions, EvaluateOptions, compact, evaluate
from gsmerge.blocks.fit_seams import join_views
from gsmerge.errors import UsageError
from gsmerge.method.facts.pictures import ROW_COLORS
from gsmerge.method.facts.scene_size import measure_size
from gsmerge.method.fit import FitJob, FitOptions, fit_gaussians
from gsmerge.method.fit.photo_sizes import fit_photos
from gsmerge.method.geometry.frame import canonicalise
from gsmerge.method.geometry.views import subset
from gsmerge.plan.blocks import choose_blocks
from gsmerge.runtime import memory
from gsmerge.settings.budget import DEVICES
from gsmerge.settings.fit import GROW_STEPS
from gsmerge.types import Cameras, Gaussians, PicturedScene, Scene

SETTINGS: dict[str, Any] = {"checkpoint": "none", "superpixels": "10%", "fit_steps": 10, "threads": 1}


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Make eight views along a wall."""
    return scenes.make_scene(scenes.wall(), scenes.arc(8, 24, 18, span=2.4, start=-1.2), noise=0.01)


def wall_seen_from(places: np.ndarray, width: int = 40, height: int = 30) -> Scene:
    """Make views along a wall of eight views' width, at places from 0 to 1."""
    viewmats = np.tile(np.eye(4), (len(places), 1, 1))
    viewmats[:, 0, 3] = -20 * places
    cameras = Cameras(viewmats, scenes.intrinsics(len(places), width, height), width, height)
    return scenes.make_scene(scenes.wall(), cameras, noise=0.01)


@pytest.mark.slow
def test_blocks_are_as_good_as_one_piece() -> None:
    places = np.linspace(0, 1, 36)
    scene, between = wall_seen_from(places), wall_seen_from((places[1:] + places[:-1]) / 2)
    results = [
        [compact(scene, blocks=blocks, seed=seed, **{**SETTINGS, "fit_steps": 600}) for blocks in ("none", 3)]
        for seed in range(3)  # single ones differ by a decibel
    ]
    scores = [[scenes.psnr_of(result.gaussians, between) for result in pair] for pair in results]
    one, other = np.mean(scores, 0)
    assert other > one - 0.3  # dB that nobody sees
    whole, parts = results[0]
    assert len(parts.gaussians) == pytest.approx(len(whole.gaussians), rel=0.1)
    scenes.assert_invariants(parts.gaussians, scene)
    blocks = parts.report.choices["blocks"]
    assert [block["views"] for block in blocks] == pytest.approx([12] * 3, abs=2)
    assert all(block["shared_views"] for block in blocks)
    scores = [block["psnr_input_views"] for block in blocks]
    assert parts.report.psnr_after == pytest.approx(np.average(scores, weights=[block["views"] for block in blocks]))
    each = [scenes.psnr_of(parts.gaussians, subset(scene, [view])) for view in range(len(scene))]
    assert min(each) < parts.report.psnr_after < max(each)  # of some views
    assert parts.report.num_output == len(parts.gaussians)


@pytest.mark.slow
@sweep(("reach", "looks"), [(0.15, 4), (1.0, 2)])
def test_seams_of_a_room_that_all_views_see_take_more_steps(reach: float, looks: int) -> None:
    """Where most Gaussians are seen from several blocks, each was fitted by a part of the photos alone."""
    seams = compact(wall_seen_from(np.linspace(0, reach, 28), 24, 18), blocks=2, **SETTINGS).report.choices["seams"]
    assert seams["steps"] == max(100, looks * seams["views"])
    assert seams["steps"] > 100 or looks == 2


@pytest.mark.slow
def test_a_device_limits_the_gaussians_of_all_blocks_together(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many as it draws in all, not in each block; fewer where superpixels ask for fewer."""
    monkeypatch.setitem(DEVICES, "quest3", 200)
    assert 180 < len(compact(scene, blocks=2, budget="quest3", **SETTINGS).gaussians) <= 200
    assert len(compact(scene, blocks=2, budget="quest3", fill=True, **SETTINGS).gaussians) == 200
    monkeypatch.setitem(DEVICES, "quest3", 5000)
    free, limited = (compact(scene, blocks=2, fit="none", budget=budget, **SETTINGS) for budget in (None, "quest3"))
    assert scenes.identical(limited.gaussians, free.gaussians)


@pytest.mark.slow
def test_the_number_of_threads_does_not_change_the_result_of_blocks(scene: Scene) -> None:
    one, two = (compact(scene, blocks=2, **{**SETTINGS, "threads": threads}) for threads in (1, 2))
    assert scenes.identical(one.gaussians, two.gaussians)


def test_blocks_without_photos_take_the_colours_of_their_rows(scene: Scene) -> None:
    """Each block takes the colours of its own pixels; they are named once."""
    bare = replace(scene, images=None)
    whole, report = (compact(bare, blocks=blocks, **SETTINGS).report for blocks in ("none", 2))
    assert whole.psnr_reference == report.psnr_reference == ROW_COLORS
    assert report.psnr_before == pytest.approx(whole.psnr_before, abs=0.5)
    assert report.psnr_after > whole.psnr_after - 1  # dB
    assert sum(ROW_COLORS in note for note in report.notes) == 1


@pytest.mark.parametrize("checkpoint", ["none", "shipped"])
def test_blocks_without_a_fit_show_the_photos_as_one_piece_does(scene: Scene, checkpoint: str) -> None:
    """Each Gaussian is in one block, and they show the photos as those of one piece do."""
    settings = SETTINGS | {"checkpoint": checkpoint, "fit": "none"}
    whole, result = (compact(scene, blocks=blocks, **settings) for blocks in ("none", 2))
    scenes.assert_invariants(result.gaussians, scene)
    assert scenes.psnr_of(result.gaussians, scene) > scenes.psnr_of(whole.gaussians, scene) - 1  # dB
    assert any(names(note, "2 blocks of views", "exposures", "not estimated") for note in result.report.notes)
    assert len(np.unique(result.gaussians.means, axis=0)) == len(result.gaussians)


def test_a_block_that_its_photos_do_not_show_is_merged(scene: Scene) -> None:
    """It is merged, and its neighbour is fitted."""
    images = scene.images.copy()
    images[:4] = np.random.default_rng(0).random(images[:4].shape, np.float32)
    result = compact(replace(scene, images=images), blocks=2, **SETTINGS)
    scenes.assert_invariants(result.gaussians, scene)
    assert any("photo" in note for note in result.report.notes)


def test_repeated_views_count_once_in_blocks(scene: Scene) -> None:
    """They count once, wherever they are."""
    again = subset(scene, [0, 0, 1, 2, 3, 3, 4, 5, 6, 7, 7])
    result = compact(again, blocks=2, **SETTINGS)
    scenes.assert_invariants(result.gaussians, scene)
    assert result.report.choices["seams"]["views"] <= len(scene)


def test_all_photos_decide_whether_blocks_are_worse() -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(4, 112, 98), noise=0.3)
    result = compact(scene, blocks=2, **{**SETTINGS, "superpixels": 4})
    exact = evaluate(scene, {"small": result}, options=EvaluateOptions(lpips=(), fog=False)).results[1].mean("context")
    assert result.report.worse is not None
    assert (result.report.choices["scored_all"], result.report.psnr_after) == (True, exact[0].psnr)


def count_blocks(scene: Scene, **settings: Any) -> int:
    return choose_blocks(measure_size(scene), CompactOptions().with_settings(settings))


def test_small_scenes_stay_in_one_piece(scene: Scene) -> None:
    assert count_blocks(scene) == 1
    assert count_blocks(scene, blocks=4) == 4
    assert count_blocks(scene, blocks="none") == 1


def test_large_scenes_are_cut_into_blocks(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsmerge.plan.blocks.WHOLE_GAUSSIANS", 1800)
    monkeypatch.setattr("gsmerge.plan.blocks.BLOCK_GAUSSIANS", 1440)
    assert count_blocks(scene) == 3
    assert count_blocks(scene, levels=2) == 1


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"quality": "30dB"}, "quality 30dB"), ({"budget": "auto"}, "budget auto"), ({"levels": 2}, "levels"),
        ({"method": "greedy"}, "method greedy"), ({"poses": "free"}, "poses free"), ({"drop": "sky"}, "drop sky"),
        ({"crop": "sphere:0,0,3,2"}, "crop"),
    ],
)  # fmt: skip
def test_settings_that_need_one_piece_are_refused_with_blocks(
    scene: Scene, settings: dict[str, Any], problem: str
) -> None:
    with refuses(UsageError, "blocks 2", "--set blocks=none", problem):
        compact(scene, blocks=2, **settings)


def test_more_blocks_than_views_are_refused(scene: Scene) -> None:
    with refuses(UsageError, "blocks 9", 8):
        compact(scene, blocks=9)


def test_unaligned_scenes_have_no_blocks(scene: Scene) -> None:
    unaligned = replace(scene, pixels=None)
    assert count_blocks(unaligned) == 1
    with refuses(UsageError, "blocks 2", "Gaussians"):
        compact(unaligned, blocks=2)


def fit_every_second(scene: Scene, steps: int, faint: int) -> tuple[Gaussians, Gaussians, np.ndarray]:
    """Fit Gaussians of which every second is fixed and some others are ``faint``; return both and which are fixed."""
    canonical, _ = canonicalise(scene)
    start = compact(scene, fit="none", **{**SETTINGS, "superpixels": "5%"}).gaussians
    fixed, opacities = np.arange(len(start)) % 2 == 0, start.opacities.copy()
    opacities[1 : 2 * faint : 2] = 0.001
    settings = FitOptions(fit_steps=steps, scored=False, min_contribution=0.0)
    photos = fit_photos(PicturedScene.with_pictures(canonical, scene.images, None), settings)
    start = replace(start, means=start.means.astype(np.float32), opacities=opacities)
    fitted, report = fit_gaussians(start, FitJob(photos, settings, len(start), fixed=fixed))
    assert report.accepted
    assert settings.grows == (steps >= GROW_STEPS)
    return start, fitted, fixed


def test_fixed_gaussians_stay_where_they_are_in_a_fit(scene: Scene) -> None:
    """To the bit, beside Gaussians that a fit moves."""
    frame_start, fitted, fixed = fit_every_second(scene, 20, 0)
    for name in ("means", "sh0"):
        moved = (getattr(fitted, name) != getattr(frame_start, name)).reshape(len(fixed), -1).any(1)
        assert moved[~fixed].any()
    assert np.abs(fitted.means - frame_start.means)[fixed].max() == 0


def test_a_growing_fit_keeps_its_rows_beside_fixed_gaussians(scene: Scene) -> None:
    """Also in runs that would drop faint Gaussians and split others; the mean of the last steps is rounded."""
    start, fitted, fixed = fit_every_second(scene, GROW_STEPS, 10)
    assert len(fitted) == len(start)
    assert np.abs(fitted.means - start.means)[fixed].max() < 1e-5


def test_views_of_blocks_are_joined_in_their_order(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """As they are one after the other, with photos in a file or not."""
    masks = np.random.default_rng(0).random((len(scene), 18, 24)) < 0.9
    chosen = [([6, 1], None), ([3], masks)]
    bare = [
        PicturedScene.with_pictures(replace(scene, gaussians=scene.gaussians[:0], pixels=None), scene.images, mask)
        for _, mask in chosen
    ]
    for size in (1, 1 << 40):
        monkeypatch.setattr(memory, "MAPPED_BYTES", size)
        joined = join_views([(part, ids) for part, (ids, _) in zip(bare, chosen, strict=True)])
        assert np.array_equal(joined.images, scene.images[[6, 1, 3]])
        assert np.array_equal(joined.cameras.viewmats, scene.cameras.viewmats[[6, 1, 3]])
        assert joined.names == tuple(scene.names[view] for view in (6, 1, 3))
        assert joined.masks[:2].all()
        assert np.array_equal(joined.masks[2], masks[3])
