"""Crops and floaters are left out of a result, and a budget is met after them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from messages import noted, refuses
from sweeps import sweep

from gsmerge import CompactOptions, Gaussians, Scene, compact, render
from gsmerge.errors import UsageError
from gsmerge.method.geometry.regions import inside_crop
from gsmerge.method.raster.metrics import decibels
from gsmerge.method.stages.clean import clean, faintest_dropped, floater_share, floaters
from gsmerge.method.viewpoints.support import count_views
from gsmerge.prepare.crop import crop_scene
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.stages import CleanOptions, parse_crop

QUICK = {"fit": "none", "checkpoint": "none", "superpixels": 60, "poses": "fixed"}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 48, 36), noise=0.01)


def sphere_in(scene: Scene, share: float) -> str:
    """Return a sphere about the scene's middle that holds that share of its Gaussians."""
    means = scene.gaussians.means.astype(float)
    middle = np.median(means, axis=0)
    radius = np.quantile(np.linalg.norm(means - middle, axis=1), share)
    return "sphere:" + ",".join(map(str, (*middle, radius)))


def wall(n: int = 40) -> Gaussians:
    """Return n x n Gaussians that touch, at a distance of 1, on a plane that is not along an axis."""
    y, x = np.divmod(np.arange(n * n), n)
    means = np.stack([x, y, (x + y) / 4], 1).astype(np.float32)
    count = len(means)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
    return Gaussians(
        means, quats, np.full((count, 3), 0.5, np.float32), np.full(count, 0.5, np.float32),
        np.zeros((count, 1, 3), np.float32), np.zeros((count, 0, 3), np.float32),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("sphere:0,0,0", "sphere:x,y,z,radius"), ("ball:0,0,0,1", "sphere:x,y,z,radius"),
        ("sphere:0,0,nan,1", "sphere:x,y,z,radius"), ("box:a,0,0,1,1,1", "sphere:x,y,z,radius"),
        ("sphere:0,0,0,0", "radius"), ("box:0,0,0,1,1,0", "x0 < x1"),
    ],
)  # fmt: skip
def test_a_text_that_is_no_crop_is_refused(text: str, expected: str) -> None:
    with refuses(ValueError, "crop", expected, f"'{text}'"):
        CleanOptions(crop=text)


def test_crops_keep_what_is_inside() -> None:
    means = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [-1, -1, -1]], float)
    assert inside_crop(means, "sphere: 0, 0, 0, 1").tolist() == [True, True, False, False]
    assert inside_crop(means, "box:0,0,-.5,1,2,1").tolist() == [True, True, True, False]
    assert parse_crop("sphere:1,2,3,4")[1] == (1, 2, 3, 4)


def test_floaters_are_alone_or_far_away(scene: Scene) -> None:
    given = wall()
    assert not floaters(given).any()
    means = given.means.copy()
    means[5] += (0, 0, 9)  # alone in front of the wall
    means[6:16, 0] += 1000  # together, but far beyond
    moved = replace(given, means=means)
    assert np.flatnonzero(floaters(moved)).tolist() == list(range(5, 16))
    assert floater_share(moved) == pytest.approx(11 / 1600)
    large = replace(moved, scales=np.full((1600, 3), 4, np.float32))  # which touch across the gap
    assert np.flatnonzero(floaters(large)).tolist() == list(range(6, 16))
    assert not floaters(given[:8]).any()
    left, counts = clean(moved, CleanOptions(crop="box:-1,-1,-1,50,50,50", drop="floaters"), None, None, lambda g: g)
    assert (len(left), counts) == (1589, {"cropped": 10, "floaters": 1})


def test_many_gaussians_of_one_place_are_no_floaters() -> None:
    """As exporters set pixels without depth to the origin."""
    given = wall()
    means = given.means.copy()
    means[:3] = (0, 0, 9), (0, 0, 20), (0, 0, 20)
    means[20:620] = 0
    crowded = replace(given, means=means)
    for threads in (1, 3):
        with use_threads(threads):
            assert np.flatnonzero(floaters(crowded)).tolist() == [0]
            assert np.flatnonzero(floaters(crowded, np.array([1, 0, 500]))).tolist() == [1]


def test_curtains_are_floaters() -> None:
    """The wall's half diagonal is 29: a tenth of it across two axes is a sheet, a third along one a streak."""
    given = wall()
    scales = given.scales.copy()
    scales[7], scales[8] = (0.01, 5, 5), (0.01, 0.5, 12)
    scales[9], scales[10] = (2, 2, 9), (0.5, 0.5, 3)  # long or wide, but within measure
    assert np.flatnonzero(floaters(replace(given, scales=scales))).tolist() == [7, 8]
    assert not floaters(replace(given, scales=np.full_like(scales, 12))).any()  # all alike


def test_faintest_gaussians_are_dropped_first() -> None:
    given = wall(3)
    opacities = np.array([5, 1, 8, 2, 7, 3, 9, 4, 6], np.float32) / 10
    assert faintest_dropped(replace(given, opacities=opacities), 4).opacities.tolist() == pytest.approx(
        [0.8, 0.7, 0.9, 0.6]
    )


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_a_budget_is_met_after_the_crop(scene: Scene, share: float) -> None:
    crop = sphere_in(scene, share)
    result = compact(scene, **QUICK, crop=crop, drop="floaters", budget=150)
    assert len(result.gaussians) == 150
    assert inside_crop(result.gaussians.means, crop).all()
    assert result.report.num_output == 150
    assert sum("clean-up: " in note for note in result.report.notes) == 1


@pytest.mark.slow
def test_cropped_fit_shows_the_inside_better_than_cropping_afterwards(scene: Scene) -> None:
    """The same number of Gaussians shows the inside better than where all was fitted and then cut, over two seeds."""
    crop, fitted = sphere_in(scene, 0.5), QUICK | {"fit": "full", "fit_steps": 80}
    part = compact(scene, **fitted, crop=crop)
    inside = crop_scene(scene, crop)
    assert part.report.num_input == inside.num_gaussians < scene.num_gaussians
    assert noted(part.report.notes, "crop", f"{inside.num_gaussians:,} of {scene.num_gaussians:,}")
    assert inside.masks is not None
    errors = np.zeros(2)
    for seed in range(2):
        part = compact(scene, **fitted, crop=crop, seed=seed)
        whole = compact(scene, **fitted, budget=2 * len(part.gaussians), seed=seed)
        kept = whole.gaussians[inside_crop(whole.gaussians.means, crop)]
        errors += [
            np.square(render(gaussians, scene.cameras).images - inside.images)[inside.masks].mean()
            for gaussians in (part.gaussians, kept)
        ]
    assert errors[0] < errors[1]
    assert part.report.psnr_after > 20


@sweep("shape", ["box", "sphere", "turned"])
def test_what_the_cropped_scene_shows_opaque_stays_opaque(shape: str) -> None:
    """Centres stay inside while they are fitted, so none is cut off afterwards."""
    scene = scenes.make_scene(scenes.room(), scenes.arc(5, 96, 72), noise=0.05)
    means = scene.gaussians.means.astype(float)
    low, high = np.quantile(means, (0.2, 0.8), axis=0)
    box = "box:" + ",".join(map(str, (*low, *high)))
    crop = {"sphere": sphere_in(scene, 0.5), "box": box, "turned": f"{box},10,20,30"}[shape]
    inside = crop_scene(scene, crop)
    shown = render(inside.gaussians, scene.cameras, background=0.0)
    opaque = shown.alphas[..., 0] > 0.98
    clear = shown.alphas[..., 0] < 0.02  # not what the photos show behind
    leaks = []
    for seed in range(2):  # of one seed to another the mean differs by a third
        result = compact(scene, crop=crop, seed=seed)
        assert inside_crop(result.gaussians.means, crop).all()
        assert result.report.choices["clean"]["cropped"] == 0
        fitted = render(result.gaussians, scene.cameras, background=0.0)
        assert (fitted.alphas[..., 0][opaque] < 0.5).mean() < 0.005
        assert (fitted.alphas[..., 0][clear] > 0.6).sum() < 0.02 * opaque.sum()
        leaks.append(fitted.alphas[..., 0][clear].mean())
        assert decibels(np.square(fitted.images - inside.images)[opaque & inside.masks].mean()) > 30
    assert np.mean(leaks) < 0.02


def test_what_a_small_part_covers_decides_how_many_show_it() -> None:
    """Without photos: of pictures that are mostly empty nearly every result is like its input."""
    whole = scenes.make_scene(scenes.room(), scenes.arc(4, 96, 72), noise=0.01)
    bare = replace(whole, images=None, pixels=None, masks=None)
    crop = sphere_in(bare, 0.1)
    inside = bare.gaussians[inside_crop(bare.gaussians.means, crop)]
    result = compact(bare, crop=crop, effort="draft")
    shown, merged = (render(some, whole.cameras, background=0.0) for some in (inside, result.gaussians))
    covered = shown.alphas[..., 0] > 0.5
    assert covered.mean() < 0.3
    assert decibels(np.square(shown.images - merged.images)[covered].mean()) > 31  # of 32.5 on the scored views


def test_a_crop_leaves_what_shows_it(scene: Scene) -> None:
    """Pixels count whose own Gaussian is inside, but for borders; without pixels the same photos count."""
    crop = sphere_in(scene, 0.5)
    inside = crop_scene(scene, crop)
    own = inside_crop(scene.gaussians.means, crop).reshape(scene.pixels.shown.shape)
    assert (inside.masks == own).mean() > 0.9
    assert (inside.pixels.shown == own).all()
    free = crop_scene(replace(scene, pixels=None), crop)
    assert len(free.gaussians) == own.sum()
    np.testing.assert_array_equal(free.masks, inside.masks)
    assert crop_scene(replace(scene, images=None, masks=None), crop).masks is None
    whole = crop_scene(scene, "sphere:0,0,0,1e6")
    assert whole.masks is scene.masks
    assert whole.gaussians is scene.gaussians


def test_coarser_levels_are_cropped(scene: Scene) -> None:
    crop = sphere_in(scene, 0.5)
    result = compact(scene, **QUICK, crop=crop, budget=160, levels=2)
    assert [len(one.gaussians) for one in (result, *result.coarser)] == [160, 40]
    assert inside_crop(result.coarser[0].gaussians.means, crop).all()


def test_baselines_are_cropped(scene: Scene) -> None:
    crop = sphere_in(scene, 0.5)
    opaque = compact(scene, method="opacity", crop=crop, budget=100)
    assert len(opaque.gaussians) == 100
    assert inside_crop(opaque.gaussians.means, crop).all()
    assert not any("use" in note for note in opaque.report.notes)


def test_crop_of_nothing_and_dropped_sky_with_a_target_are_refused(scene: Scene) -> None:
    with refuses(UsageError, "crop", "sphere:0,0,1e9,1", "none"):
        compact(scene, **QUICK, crop="sphere:0,0,1e9,1")
    with refuses(ValueError, "drop sky", "budget", "quality 30dB"):
        CompactOptions().with_settings({"drop": "sky", "quality": "30dB"})


def test_budget_beyond_a_crop_is_noted(scene: Scene) -> None:
    few = sphere_in(scene, 0.002)
    result = compact(scene, **QUICK, crop=few, budget=5000)
    assert 0 < len(result.gaussians) < 5000
    assert noted(result.report.notes, "crop", f"{result.report.num_input} of 5,184")


def test_crop_and_dropped_floaters_need_the_whole_scene() -> None:
    assert CompactOptions().with_settings({"crop": "sphere:0,0,0,1", "drop": "floaters"}).whole_only == [
        "crop", "drop floaters",
    ]  # fmt: skip


def test_gaussians_that_no_view_shows_are_left_out(scene: Scene) -> None:
    """What stands behind the cameras, and nothing that takes part in a picture."""
    given = scene.gaussians
    behind = given.means - 1000 * scene.cameras.viewmats[0, 2, :3].astype(np.float32)
    both = Gaussians.concat([given, replace(given, means=behind)])
    options = CleanOptions(drop="unseen")
    left, counts = clean(both, options, scene.cameras, None, lambda g: g)
    assert counts["unseen"] >= len(given)
    pictures = [render(some, scene.cameras).images for some in (both, both[left])]
    assert np.abs(pictures[0] - pictures[1]).mean() < 1 / 255
    assert len(clean(given[:0], options, None, None, lambda g: g)[0]) == 0


def test_result_without_unseen_gaussians_is_what_views_show(scene: Scene) -> None:
    result = compact(scene, budget=150, drop="unseen", **QUICK)
    assert (count_views(result.gaussians, scene.cameras) > 0).mean() > 0.9
    assert any("that no view shows" in note for note in result.report.notes)
