from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes

from gsmerge import Scene, compact
from gsmerge.method.facts.pictures import PHOTOS, ROW_COLORS
from gsmerge.method.kernels import elementary
from gsmerge.method.raster.photos import scene_photos, scene_pictures, score_photos
from gsmerge.method.stages.prune import ROUNDING
from gsmerge.runtime.record import STAGES
from gsmerge.settings.stages import SEGMENTATIONS

UNUSUAL = ("partition", "curve", "reduce", "refine", "join")
USUAL = [stage for stage in STAGES if stage not in UNUSUAL]
UNFITTED = {"fit": "none", "checkpoint": "none"}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24), noise=0.01)


def test_report_of_a_run_has_its_counts_scores_stages_and_choices(scene: Scene) -> None:
    result = scenes.compacted(scene)
    report = result.report
    assert report.num_input == 3 * 32 * 24
    assert 0 < report.num_output == len(result.gaussians) < report.num_input
    assert list(report.seconds) == USUAL
    assert report.psnr_before == pytest.approx(scenes.psnr_of(scene.gaussians, scene), abs=0.1)
    assert report.psnr_after == pytest.approx(scenes.psnr_of(result.gaussians, scene), abs=0.15)
    assert report.choices["fit"]["method"] == "full"
    assert report.choices["clusters"] <= report.choices["groups"]
    assert report.options["superpixels"] == "10%"


def test_the_input_is_scored_as_its_file_has_it(scene: Scene) -> None:
    """What fills holes is merged, but is not the input's."""
    missing = np.zeros_like(scene.pixels.shown)
    missing[:, 6:18, 8:24] = True
    some = replace(scene, filled=missing.reshape(-1))
    before = scenes.compacted(some, fit="none").report
    assert before.num_input == int((~missing).sum())
    assert before.psnr_before == pytest.approx(scenes.psnr_of(some.file_gaussians, scene), abs=0.1)
    assert before.psnr_before < scenes.psnr_of(scene.gaussians, scene) - 3
    assert before.psnr_after > before.psnr_before
    assert before.covered.share == pytest.approx(some.covered.mean(), abs=0.02)
    images = scenes.images_of(some.file_gaussians, some.cameras)[0].clip(0, 1)
    inside = -10 * elementary.log10(np.square(images - some.images)[some.covered].mean())
    assert before.covered.before == pytest.approx(inside, abs=0.5)  # the mean over views, not over pixels
    assert before.covered.before > before.psnr_before + 3
    assert scenes.compacted(scene, fit="none").report.covered is None


def test_a_result_that_loses_what_the_input_covers_is_worse(scene: Scene) -> None:
    """Over all pixels it gains, as it fills the gap."""
    missing = np.zeros_like(scene.pixels.shown)
    missing[:, 6:18, 8:24] = True
    report = scenes.compacted(replace(scene, filled=missing.reshape(-1)), fit="none", budget=40).report
    assert report.psnr_after > report.psnr_before
    assert report.covered.after < report.covered.before - 1
    assert report.worse is not None


@pytest.mark.slow
@pytest.mark.parametrize(("settings", "scored_all", "near"), [({}, False, 1.5), ({"budget": 9}, True, 1e-4)])
def test_a_sample_is_scored_unless_the_result_may_be_worse(settings: Any, scored_all: bool, near: float) -> None:
    """Then all photos decide, and the report is exact."""
    scene = scenes.make_scene(scenes.room(), scenes.arc(5, 240, 224), noise=0.3)
    result = compact(scene, effort="draft", poses="fixed", **settings)
    photos = scene_photos(scene)
    exact = [score_photos(one, photos, range(5)).psnr for one in (scene.gaussians, result.gaussians)]
    assert [result.report.psnr_before, result.report.psnr_after] == pytest.approx(exact, abs=near)
    assert result.report.choices["scored_all"] is scored_all is (result.report.worse is not None)
    assert result.report.choices["scored_views"] == (5 if scored_all else 3)
    assert ("about" in repr(result.report)) is not scored_all


def test_what_no_photo_shows_is_not_written(scene: Scene) -> None:
    pruned, whole = (scenes.compacted(scene, fit_steps=160, min_contribution=least) for least in (1 / 255, 0))
    count = pruned.report.choices["pruned"]
    assert 0 < count == len(whole.gaussians) - len(pruned.gaussians)
    assert "pruned" not in whole.report.choices
    assert "fill" in pruned.report.seconds
    assert "fill" in whole.report.seconds
    images = [scenes.images_of(result.gaussians, scene.cameras)[0].clip(0, 1) for result in (pruned, whole)]
    assert 0 < np.sqrt(np.square(images[0] - images[1]).mean()) < 2 * ROUNDING


@pytest.mark.parametrize("steps", [20, 160])
def test_numbers_are_met_and_limits_kept(scene: Scene, steps: int) -> None:
    count = 230  # a tenth
    exact, share, filled = (
        scenes.compacted(scene, fit_steps=steps, **budget).gaussians
        for budget in ({"budget": count}, {"budget": "10%"}, {"budget": "10%", "fill": True})
    )
    assert len(exact) == len(filled) == count
    assert 0.6 * count < len(share) <= count


def test_progress_tells_every_step_of_the_full_fit(scene: Scene) -> None:
    calls: list[tuple[str, int, int]] = []
    compact(scene, fit_steps=12, superpixels=40, checkpoint="none", progress=lambda *call: calls.append(call))
    steps = [call for call in calls if call[0].startswith("fit:")]
    assert [call[1:] for call in steps] == [(step, 12) for step in range(1, 13)]
    assert all("photos" in name for name, _, _ in steps)
    stages = [stage for stage in USUAL if stage != "fill"]  # which follows longer fits
    assert [name for name, _, _ in calls if not name.startswith("fit:")] == [*stages, "done"]


def test_without_photos_colours_of_pixels_are_what_a_result_is_fitted_to_and_measured_against(scene: Scene) -> None:
    with_photos, without = (compact(one, fit_steps=40, superpixels=34) for one in (scene, replace(scene, images=None)))
    report = without.report
    assert (with_photos.report.psnr_reference, report.psnr_reference) == (PHOTOS, ROW_COLORS)
    assert report.choices["fit"]["accepted"]
    pictures = replace(scene, images=scene_pictures(replace(scene, images=None)))
    assert report.psnr_before == pytest.approx(scenes.psnr_of(scene.gaussians, pictures), abs=0.1)
    assert report.psnr_after == pytest.approx(scenes.psnr_of(without.gaussians, pictures), abs=0.1)
    assert scenes.psnr_of(without.gaussians, scene) > scenes.psnr_of(with_photos.gaussians, scene) - 1
    assert report.worse.startswith(f"the result shows {ROW_COLORS} worse than the input does: ")


@pytest.mark.parametrize("match", ["overlap", "aabb", "none"])
@pytest.mark.parametrize("k", [1, 4])
def test_count_is_what_was_asked_for(scene: Scene, match: str, k: int) -> None:
    actual = scenes.compacted(scene, superpixels=40, match=match, k=k, **UNFITTED)
    assert len(actual.gaussians) <= 3 * 40 * k
    if match == "none":
        assert len(actual.gaussians) + actual.report.choices["pruned"] >= 0.95 * 3 * 40 * k


@pytest.mark.parametrize("superpixels", [1, 2, 768])
def test_extreme_numbers_of_superpixels_bound_the_count(scene: Scene, superpixels: int) -> None:
    assert len(scenes.compacted(scene, superpixels=superpixels, fit_steps=12).gaussians) <= 3 * superpixels


@pytest.mark.parametrize(("views", "size"), [(1, (1, 1)), (3, (1, 1)), (3, (7, 5)), (1, (40, 1)), (3, (1, 40))])
def test_tiny_images_are_compacted(size: tuple[int, int], views: int) -> None:
    scenes.compacted(scenes.make_scene(scenes.wall(), scenes.arc(views, *size)), fit_steps=60)


@pytest.mark.parametrize("segmentation", SEGMENTATIONS)
def test_every_segmentation_keeps_to_the_count_asked_for(scene: Scene, segmentation: str) -> None:
    assert len(scenes.compacted(scene, segmentation=segmentation, superpixels=40, **UNFITTED).gaussians) <= 120


def test_result_can_be_used_like_any_array_or_tensor(scene: Scene, torch: Any) -> None:
    """Changed in place, and as tensors differentiated through."""
    actual = compact(scene, fit_steps=12).gaussians
    for name in scenes.FIELDS:
        array = getattr(actual, name)
        array += 0
        tensor = torch.from_numpy(array)
        tensor.add_(0)
        tensor.clone().requires_grad_().sum().backward()
        (tensor * torch.ones(1, requires_grad=True)).sum().backward()


@pytest.mark.parametrize("photos", [True, False])
def test_tensors_give_tensors_of_the_same_values(scene: Scene, photos: bool, torch: Any) -> None:
    """Of Gaussians that autograd follows, too; the input stays as it is."""
    given = scene if photos else replace(scene, images=None)
    tensors = replace(given, gaussians=given.gaussians.to("cpu"), cameras=given.cameras.to("cpu"))
    if given.images is not None:
        tensors = replace(tensors, images=torch.from_numpy(given.images))
    tensors.gaussians.means.requires_grad_()
    settings = {"fit_steps": 12, "levels": 2}
    expected, actual = compact(given, **settings), compact(tensors, **settings)
    pairs = [(actual.gaussians, expected.gaussians)]
    pairs += [(one.gaussians, other.gaussians) for one, other in zip(actual.coarser, expected.coarser, strict=True)]
    assert len(pairs) == 2
    for one, other in pairs:
        assert one.device == torch.device("cpu")
        assert other.device is None
        assert all(not getattr(one, name).requires_grad for name in scenes.FIELDS)
        assert scenes.identical(one.numpy(), other)
    assert tensors.gaussians.means.requires_grad
    assert actual.report.psnr_after == expected.report.psnr_after


def test_double_precision_input_gives_nearly_the_same_result(scene: Scene) -> None:
    columns = {name: getattr(scene.gaussians, name).astype(np.float64) for name in scenes.FIELDS}
    doubled = replace(scene, gaussians=replace(scene.gaussians, **columns), images=scene.images.astype(np.float64))
    actual = [scenes.compacted(s, fit="none").gaussians for s in (doubled, scene)]
    scenes.assert_same_set(*actual, atol=1e-4)
    fitted = [scenes.compacted(one, fit_steps=12).gaussians for one in (doubled, scene)]
    assert scenes.psnr_of(fitted[0], scene) == pytest.approx(scenes.psnr_of(fitted[1], scene), abs=0.5)


def test_input_is_left_alone(scene: Scene) -> None:
    before = [getattr(scene.gaussians, name).copy() for name in scenes.FIELDS]
    images = scene.images.copy()
    compact(scene, fit_steps=12)
    assert all(np.array_equal(getattr(scene.gaussians, n), b) for n, b in zip(scenes.FIELDS, before, strict=True))
    assert np.array_equal(scene.images, images)


@pytest.mark.parametrize(("settings", "learned"), [({"fit": "none"}, True), ({"fit_steps": 12}, False)])
def test_networks_correct_what_no_fit_corrects(settings: dict[str, Any], learned: bool, scene: Scene) -> None:
    actual = scenes.compacted(scene, **settings)
    assert ("networks" in actual.report.choices) == learned
    alone = scenes.compacted(scene, **settings, checkpoint="shipped" if learned else "none")
    assert scenes.identical(actual.gaussians, alone.gaussians)


@pytest.mark.parametrize("k", [1, 8])
def test_a_budget_is_met_whatever_k_is_and_however_the_fit_grows(scene: Scene, k: int) -> None:
    actual = scenes.compacted(scene, k=k, budget=300, fit_steps=160)
    assert actual.report.choices["fit"]["accepted"]
    assert len(actual.gaussians) == 300
