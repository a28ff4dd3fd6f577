"""Every baseline has its count and its order, and does what defines it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
import unaligned_scenes
from messages import noted, refuses

from gsmerge import CompactOptions, Gaussians, Scene, compact
from gsmerge.errors import UsageError
from gsmerge.method.facts.pictures import ROW_COLORS
from gsmerge.method.stages.superpixels import grid_labels
from gsmerge.results.result import CompactResult
from gsmerge.runtime.plugins import METHODS, find_plugins, load_plugin

COUNT = 200
KEEPERS = ("unmerged", "unmerged-fit")
EXACT = ("opacity", "random", "moment-matching", "greedy")
BASELINES = {name: load_plugin(METHODS, name) for name in find_plugins(METHODS)}
OWN = sorted(set(BASELINES) - {"splat-transform"})  # which need no program
KINDS = ["greedy", "moment-matching", "unmerged-fit"]  # each makes Gaussians in a way of its own
EACH = [*KINDS, *(pytest.param(name, marks=pytest.mark.slow) for name in OWN if name not in KINDS)]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24), noise=0.01)


def made(scene: Scene, method: str, **settings: Any) -> CompactResult:
    """Compact by a baseline, with a few steps of the fit for the one that has one."""
    quick = {"fit_steps": 12} if method == "unmerged-fit" else {}
    return compact(scene, method=method, **{"budget": COUNT, **quick, **settings})


def rows_of(part: Gaussians, whole: Gaussians) -> list[int]:
    """Return the rows of ``whole`` whose opacity and colour the rows of ``part`` have."""

    def columns(gaussians: Gaussians) -> list[list[float]]:
        return np.concatenate([gaussians.opacities[:, None], gaussians.sh0[:, 0]], 1).tolist()

    keys = {tuple(row): i for i, row in enumerate(columns(whole))}
    return [keys[tuple(row)] for row in columns(part)]


def test_entry_points_name_their_methods() -> None:
    assert all(name == baseline.name for name, baseline in BASELINES.items())


def test_settings_that_baselines_use_exist() -> None:
    known = set(CompactOptions().to_dict())
    assert {setting for baseline in BASELINES.values() for setting in baseline.uses} - known == set()


@pytest.mark.parametrize("method", EXACT)
@pytest.mark.parametrize("count", [3, 2000])
def test_baselines_meet_their_budget(scene: Scene, method: str, count: int) -> None:
    result = made(scene, method, budget=count)
    assert len(result.gaussians) == count
    scenes.assert_invariants(result.gaussians, scene)
    scenes.assert_consistent(result.report, scene, result.gaussians)


@pytest.mark.slow
@pytest.mark.parametrize("method", EXACT)
def test_baselines_without_a_budget_make_the_usual_count(scene: Scene, method: str) -> None:
    assert len(made(scene, method, budget=None, superpixels="10%").gaussians) == 3 * 76
    assert len(made(scene, method, budget=None, superpixels="10%", k=2).gaussians) == 2 * 3 * 76


@pytest.mark.slow
@pytest.mark.parametrize("method", EACH)
def test_baselines_give_the_same_bits_on_any_number_of_threads(scene: Scene, method: str) -> None:
    one, other = (made(scene, method, threads=threads).gaussians for threads in (1, 3))
    assert scenes.identical(one, other)


@pytest.mark.parametrize("method", EACH)
def test_baselines_take_scenes_in_no_order(scene: Scene, method: str) -> None:
    result = compact(unaligned_scenes.shuffled(scene), method=method, budget=COUNT, fit_steps=4)
    assert method in KEEPERS or len(result.gaussians) <= COUNT
    assert len(result.gaussians) > COUNT / 2


@pytest.mark.parametrize("method", ["opacity", "greedy"])
def test_baselines_do_not_depend_on_the_order_of_rows(scene: Scene, method: str) -> None:
    actual = [compact(unaligned_scenes.shuffled(scene, seed), method=method, budget=COUNT).gaussians for seed in (1, 2)]
    scenes.assert_same_set(*actual, atol=1e-4)


@pytest.mark.parametrize("method", EACH)
def test_pixels_without_a_row_make_no_gaussian(scene: Scene, method: str) -> None:
    valid = scene.pixels.shown.copy()
    valid[:, :4] = False
    result = made(scenes.shown_in(scene, valid), method)
    assert len(result.gaussians) <= int(valid.sum())


def test_unmerged_fit_without_photos_is_refused(scene: Scene) -> None:
    with refuses(UsageError, "method unmerged-fit", "photos", "none"):
        made(replace(scene, images=None, pixels=None), "unmerged-fit")


@pytest.mark.parametrize("method", ["opacity", "greedy"])
def test_baselines_without_a_fit_need_no_photos(scene: Scene, method: str) -> None:
    result = made(replace(scene, images=None), method)
    assert result.report.psnr_reference == ROW_COLORS
    assert len(result.gaussians) > COUNT / 2


def test_settings_without_effect_are_noted(scene: Scene) -> None:
    def notes_of(method: str, **settings: Any) -> list[str]:
        report = made(scene, method, **settings).report
        return [note for note in report.notes if note != report.worse]

    assert notes_of("greedy", seed=3, threads=1) == []
    assert notes_of("greedy", effort="best", match="none") == ["method greedy does not use match, effort"]
    assert notes_of("unmerged-fit", budget=None, effort="fast") == []
    assert noted(notes_of("unmerged"), "method unmerged", "budget")


def test_report_times_the_stages_of_the_baseline_alone(scene: Scene) -> None:
    around = {"prepare", "score", "input"}
    assert set(made(scene, "unmerged").report.seconds) == around
    assert set(made(scene, "opacity").report.seconds) == around | {"reduce"}
    assert set(made(scene, "moment-matching").report.seconds) == around | {"segment", "members", "encode", "decode"}
    assert set(made(scene, "unmerged-fit").report.seconds) == around | {"fit"}


@pytest.mark.slow
def test_unmerged_is_the_input(scene: Scene) -> None:
    actual = made(scene, "unmerged")
    scenes.assert_same_set(actual.gaussians, scene.gaussians, atol=1e-5)
    assert actual.report.psnr_after == pytest.approx(actual.report.psnr_before, abs=1e-3)


def test_unmerged_fit_fits_the_input_whatever_fit_says(scene: Scene) -> None:
    """By steps, or by time; whatever ``fit`` says."""
    actual = made(scene, "unmerged-fit", fit_steps=20, fit="none")
    assert (actual.report.choices["fit"]["method"], actual.report.choices["fit"]["steps"]) == ("full", 20)
    assert noted(actual.report.notes, "method unmerged-fit", "fit, budget")


def test_opacity_keeps_the_most_opaque_gaussians(scene: Scene) -> None:
    kept = rows_of(made(scene, "opacity").gaussians, scene.gaussians)
    assert kept == sorted(kept)
    left = np.setdiff1d(np.arange(len(scene.gaussians)), kept)
    opacities = scene.gaussians.opacities
    assert opacities[kept].min() >= opacities[left].max()


def test_opacity_keeps_the_first_of_equally_opaque_gaussians(scene: Scene) -> None:
    equal = replace(scene, gaussians=replace(scene.gaussians, opacities=np.full_like(scene.gaussians.opacities, 0.5)))
    np.testing.assert_array_equal(made(equal, "opacity").gaussians.sh0, scene.gaussians.sh0[:COUNT])


def test_seed_chooses_the_gaussians_that_random_keeps(scene: Scene) -> None:
    one, two = (rows_of(made(scene, "random", seed=seed).gaussians, scene.gaussians) for seed in (1, 2))
    assert len(set(one)) == COUNT
    assert one == sorted(one)
    assert set(one) != set(two)


@pytest.mark.parametrize(
    ("height", "width", "count"), [(24, 32, 66), (24, 32, 1), (24, 32, 768), (24, 32, 767), (40, 1, 7)]
)
def test_scene_is_cut_into_as_many_blocks_as_asked_for(height: int, width: int, count: int) -> None:
    labels = grid_labels(height, width, count)
    assert np.array_equal(np.unique(labels), np.arange(count))
    for label in range(count):
        ys, xs = np.nonzero(labels == label)
        assert len(ys) == (np.ptp(ys) + 1) * (np.ptp(xs) + 1)  # a rectangle


def test_blocks_hold_about_as_many_gaussians_each() -> None:
    sizes = np.bincount(grid_labels(240, 320, 300).reshape(-1))
    assert sizes.max() < 1.5 * sizes.min()


def test_one_gaussian_for_each_superpixel_has_their_mean_opacity() -> None:
    """The paper's rule: the spread of the means, the mean opacity."""
    flat = scenes.make_scene(scenes.wall(), scenes.arc(2, 32, 24), opacity=(0.7, 0.7))
    actual = made(flat, "moment-matching").gaussians
    np.testing.assert_allclose(actual.opacities, np.full(COUNT, 0.7), atol=1e-4)


@pytest.mark.parametrize("method", EACH)
def test_baselines_keep_harmonics(method: str) -> None:
    scene = scenes.make_scene(scenes.wall(), scenes.arc(2, 24, 16), degree=2)
    actual = made(scene, method, budget=50).gaussians
    assert actual.sh_degree == 2
    assert np.abs(actual.shN).max() > 0.01
