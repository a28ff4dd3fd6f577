"""Scores of an evaluation agree with scikit-image, and say what they compare."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
from messages import refuse_all
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

import gsmerge
from gsmerge.cli.console import say_notes
from gsmerge.method.facts.pictures import ROW_COLORS
from gsmerge.method.raster.photos import scene_pictures
from gsmerge.runtime.documents import to_json
from gsmerge.scoring.evaluate import INPUT, EvaluateOptions, Evaluation, evaluate, near_plane
from gsmerge.scoring.evaluation_report import CSV_COLUMNS, evaluation_csv, evaluation_document, evaluation_lines
from gsmerge.scoring.fog import measure_fog
from gsmerge.types import Gaussians, Scene, Views

PLAIN = EvaluateOptions(lpips=())


def held_out(span: float = 2.0) -> Views:
    made = scenes.make_scene(scenes.room(), scenes.arc(2, span=span, start=-0.3))
    return Views(made.cameras, made.images, ("a", "b"))


def make_scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3), noise=0.01)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


@pytest.fixture(scope="module")
def half() -> Gaussians:
    return make_scene().gaussians[::2]


@pytest.fixture(scope="module")
def actual() -> Evaluation:
    scene = make_scene()
    return evaluate(scene, {"half": scene.gaussians[::2]}, held_out(), PLAIN)


def test_psnr_and_ssim_are_those_of_scikit_image(actual: Evaluation, half: Gaussians) -> None:
    views = held_out()
    images = gsmerge.render(half, views.cameras).images.clip(0, 1)
    scores = [s for s in actual.results[1].scores if s.split == "target"]
    for score, image, photo in zip(scores, images, views.images, strict=True):
        assert score.full.psnr == pytest.approx(peak_signal_noise_ratio(photo, image, data_range=1), abs=1e-5)
        options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
        expected = structural_similarity(photo, image, channel_axis=2, data_range=1, **options)
        assert score.full.ssim == pytest.approx(expected, abs=1e-5)


def test_masked_scores_count_visible_pixels_alone(actual: Evaluation) -> None:
    targets = [s for s in actual.results[0].scores if s.split == "target"]
    assert 0.3 < targets[1].visible < 0.95
    assert targets[1].masked.psnr > targets[1].full.psnr + 3  # what nobody has seen is black
    assert all(s.masked == s.full for s in actual.results[0].scores if s.split == "context")


def test_pixels_that_the_input_covers_are_scored_apart(scene: Scene, half: Gaussians) -> None:
    """Of the input's own views by the rows of the file, of the others by its renders."""
    missing = np.zeros_like(scene.pixels.shown)
    missing[:, :12] = True
    lacking = evaluate(scenes.shown_in(scene, ~missing), {"half": half}, held_out(), PLAIN)
    for result in lacking.results:
        share, covered = result.mean_covered("context")
        assert share == pytest.approx(1 - missing.mean())
        assert covered.psnr != result.mean("context")[0].psnr
    before = lacking.results[0]
    assert before.mean_covered("context")[1].psnr > before.mean("context")[0].psnr + 3
    assert 0.1 < before.mean_covered("target")[0] < 0.95
    document = document_of(lacking)
    assert "have Gaussians" in "".join(evaluation_lines(document))
    row = next(csv.DictReader(io.StringIO(evaluation_csv(document))))
    assert float(row["share_covered"]) == pytest.approx(1 - missing.mean())
    assert float(row["psnr_covered"]) > float(row["psnr"])
    whole = evaluate(scene, {"half": half}, options=replace(PLAIN, own=False))
    assert whole.results[0].mean_covered("context")[0] is None


def test_counts_of_an_evaluation_are_those_of_what_it_compares(
    actual: Evaluation, scene: Scene, half: Gaussians
) -> None:
    assert [r.name for r in actual.results] == [INPUT, "half"]
    assert actual.results[1].num_gaussians == len(half)
    assert actual.results[1].ratio == pytest.approx(len(half) / len(scene.gaussians))
    assert actual.num_views == {"context": 3, "target": 2}
    assert actual.reference == "photos"
    assert actual.notes == ()


def test_held_out_views_of_another_scene_are_a_warning(scene: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    views = held_out()
    away = replace(views.cameras, viewmats=np.diag([-1.0, 1, -1, 1]) @ views.cameras.viewmats)  # turned about
    evaluation = evaluate(scene, {}, replace(views, cameras=away), PLAIN)
    say_notes(evaluation.notes)
    assert capsys.readouterr().err.startswith("gsmerge: warning: the input views have seen only 0 %")


def no_pixels(scene: Scene) -> Scene:
    """Return the same Gaussians without photos, and without the pixels that they belong to."""
    return replace(scene, images=None, pixels=None)


def test_colours_of_pixels_are_the_reference_without_photos(scene: Scene, half: Gaussians) -> None:
    bare = replace(scene, images=None)
    actual = evaluate(bare, {"half": half}, None, PLAIN)
    expected = evaluate(replace(bare, images=scene_pictures(bare)), {"half": half}, None, PLAIN)
    assert actual.reference == ROW_COLORS
    for before, after in zip(actual.results, expected.results, strict=True):
        assert before.mean("context")[0].psnr == pytest.approx(after.mean("context")[0].psnr, abs=1e-3)


def test_renders_of_the_input_are_the_reference_without_photos_or_pixels(scene: Scene, half: Gaussians) -> None:
    actual = evaluate(no_pixels(scene), {"half": half}, None, PLAIN)
    assert actual.reference == "renders of the input"
    assert all(math.isinf(s.full.psnr or 0) for s in actual.results[0].scores)
    assert all((s.full.psnr or 99) < 60 for s in actual.results[1].scores)
    assert "no held-out views" in actual.notes[0]
    document = json.loads(to_json(evaluation_document(actual, {})))
    assert document["results"][0]["mean"]["context"]["psnr"] is None  # strict JSON knows no infinity


def test_a_scene_in_no_order_is_scored_as_one_with_pixels(scene: Scene, half: Gaussians) -> None:
    unaligned = Scene(scene.gaussians, scene.cameras, scene.images, None, scene.names)
    actual = evaluate(unaligned, {"half": half}, held_out(), PLAIN)
    usual = evaluate(scene, {"half": half}, held_out(), PLAIN)
    for one, other in zip(actual.results[1].scores, usual.results[1].scores, strict=True):
        assert one.full == other.full
        assert one.visible == pytest.approx(other.visible, abs=0.05)


@pytest.mark.parametrize(
    "options", [*({"threads": threads} for threads in (1, 3)), *({"photo_side": side} for side in (0, 48, 476))]
)
def test_threads_and_a_photo_side_that_enlarges_do_not_change_scores(
    options: dict[str, int], scene: Scene, half: Gaussians, actual: Evaluation
) -> None:
    again = evaluate(scene, {"half": half}, held_out(), replace(PLAIN, **options))
    assert [r.scores for r in again.results] == [r.scores for r in actual.results]


def test_impossible_arguments_of_an_evaluation_are_refused(scene: Scene, half: Gaussians, actual: Evaluation) -> None:
    empty = Scene(half, scene.cameras[[]], None, None, ())
    refuse_all(ValueError, [
        (lambda: EvaluateOptions(lpips=("squeeze",)), "lpips", "'squeeze'"),
        (lambda: EvaluateOptions(lpips_views=0), "lpips_views", 1, 0),
        (lambda: EvaluateOptions(photo_side=-1), "photo_side", -1),
        (lambda: EvaluateOptions(photo_side=476.5), "photo_side", 476.5),  # type: ignore[arg-type]
        (lambda: evaluate(scene, {INPUT: half}, None, PLAIN), "results", "'input'"),
        (lambda: evaluate(empty, {}, None, PLAIN), "", "views", "none"),
        (lambda: EvaluateOptions(lpips="vgg"), "lpips", "'vgg'"),  # type: ignore[arg-type]
        (lambda: actual.results[1].mean("input"), "split", "context", "target", "'input'"),
        (lambda: actual.results[1].mean_covered("x"), "split", "'x'"),
    ])  # fmt: skip


def halved(views: Views) -> Views:
    """Make half as many pixels per side by hand."""
    cameras, (v, h, w, _) = views.cameras, views.images.shape
    Ks = cameras.Ks * np.array([[0.5], [0.5], [1]])
    images = views.images.reshape(v, h // 2, 2, w // 2, 2, 3).mean((2, 4))
    return Views(replace(cameras, Ks=Ks, width=w // 2, height=h // 2), images, views.names)


def figures(evaluation: Evaluation) -> np.ndarray:
    """Return PSNR and SSIM of every result in every view, over all pixels and the visible ones."""
    scores = [score for result in evaluation.results for score in result.scores]
    return np.array([(quality.psnr, quality.ssim) for s in scores for quality in (s.full, s.masked)], float)


def expect_equal(actual: Evaluation, expected: Evaluation) -> None:
    """Check that figures are the same, over the same pixels."""
    np.testing.assert_allclose(figures(actual), figures(expected), atol=2e-4)
    seen = [[score.visible for result in one.results for score in result.scores] for one in (actual, expected)]
    assert seen[0] == seen[1]


def test_a_photo_side_gives_the_scores_of_views_resized_by_hand(scene: Scene, half: Gaussians) -> None:
    unaligned = Scene(scene.gaussians, scene.cameras, scene.images, None, scene.names)
    masks = np.ones(scene.images.shape[:3], bool)
    masks[:, :, :9] = False
    small = halved(Views(scene.cameras, scene.images, scene.names))
    by_hand = Scene(scene.gaussians, small.cameras, small.images, None, scene.names)
    own = {"half": scene.cameras[[1, 2, 0]]}  # of a result that moved them
    actual = evaluate(
        replace(unaligned, masks=masks), {"half": half}, held_out(), replace(PLAIN, photo_side=24), cameras=own
    )
    expected = evaluate(
        replace(by_hand, masks=~(np.arange(24) < 5) & np.ones((3, 18, 1), bool)), {"half": half}, halved(held_out()),
        PLAIN, cameras={"half": small.cameras[[1, 2, 0]]},
    )  # fmt: skip
    expect_equal(actual, expected)
    assert actual.results[0].scores[0].visible < 0.9  # without what the masks leave out, in part too
    usual = evaluate(unaligned, {"half": half}, held_out(), PLAIN)
    assert actual.results[0].mean("target") != usual.results[0].mean("target")


def test_a_photo_side_keeps_the_samples_of_a_scene_with_pixels(scene: Scene, half: Gaussians) -> None:
    """Every Gaussian stays a sample of what the input views see."""
    options = replace(PLAIN, context=False)
    actual = evaluate(scene, {"half": half}, held_out(), replace(options, photo_side=24))
    expect_equal(actual, evaluate(scene, {"half": half}, halved(held_out()), options))


def test_a_photo_side_without_photos_is_reported(scene: Scene, half: Gaussians) -> None:
    actual = evaluate(no_pixels(scene), {"half": half}, None, replace(PLAIN, photo_side=24))
    assert all(math.isinf(s.full.psnr or 0) for s in actual.results[0].scores)
    document = evaluation_document(actual, {})
    assert document["photo_side"] == 24
    assert "24 pixels" in "".join(evaluation_lines(document))
    assert "photo_side" not in evaluation_document(replace(actual, options=PLAIN), {})


def test_antialiased_scores_are_those_of_antialiased_renders(scene: Scene, half: Gaussians, actual: Evaluation) -> None:
    views = held_out()
    result = evaluate(scene, {"half": half}, views, replace(PLAIN, antialiased=True, context=False)).results[1]
    image = gsmerge.render(half, views.cameras[[0]], antialiased=True).images[0].clip(0, 1)
    expected = peak_signal_noise_ratio(views.images[0], image, data_range=1)
    assert result.scores[0].full.psnr == pytest.approx(expected, abs=1e-4)
    assert result.mean("target") != actual.results[1].mean("target")


def test_csv_has_a_row_for_each_result_and_view(actual: Evaluation) -> None:
    document = evaluation_document(actual, {"half": {"bytes": 12, "path": "half.ply"}})
    rows = list(csv.DictReader(io.StringIO(evaluation_csv(document))))
    assert tuple(rows[0]) == CSV_COLUMNS
    assert len(rows) == 2 * 5
    assert rows[-1]["result"] == "half"
    assert float(rows[-1]["psnr"]) == actual.results[1].scores[-1].full.psnr
    assert rows[-1]["lpips_vgg"] == ""


@pytest.mark.parametrize("name", ["=cmd|' /C calc'!A1", "+1", "-1", "@sum", "\t=1"])
def test_names_in_csv_are_no_formulas(name: str, actual: Evaluation) -> None:
    odd = replace(actual, results=[replace(actual.results[0], name=name)])
    rows = list(csv.DictReader(io.StringIO(evaluation_csv(evaluation_document(odd, {})))))
    assert {row["result"] for row in rows} == {f"'{name}"}
    assert float(rows[0]["psnr"]) > 0


def document_of(actual: Evaluation) -> dict[str, Any]:
    """Return a document with facts of files and costs, under a name that is markup."""
    odd = replace(actual, results=(actual.results[0], replace(actual.results[1], name="a|b<i>")))
    facts: dict[str, dict[str, Any]] = {
        "input": {"path": "in.ply", "bytes": 4000},
        "a|b<i>": {"bytes": 1000, "bytes_by_attribute": {"means": 34 * len(actual.results[1].scores)}},
    }  # fmt: skip
    return evaluation_document(odd, facts, ["first <note>"])


def test_every_result_has_its_own_fog_and_holes(scene: Scene, half: Gaussians, actual: Evaluation) -> None:
    given, result = actual.results
    assert given.fog == {}
    expected = measure_fog(scene.gaussians, {"half": half}, scene.cameras, near_plane(scene))["half"]
    assert result.fog == expected
    unaligned = Scene(scene.gaussians, scene.cameras, None, None, scene.names)
    assert evaluate(unaligned, {"half": half}, None, replace(PLAIN, photo_side=24)).results[1].fog == expected
    assert evaluate(scene, {"half": half}, None, replace(PLAIN, fog=False)).results[1].fog == {}


def test_filled_rows_are_not_counted_as_fog(scene: Scene) -> None:
    """As for the fit: where an exporter dropped pixels, a result that shows their surfaces is right."""
    filled = scene.gaussians.means[:, 0] > 0
    unfilled = evaluate(scene, {"all": scene.gaussians}, None, PLAIN)
    actual = evaluate(replace(scene, filled=filled), {"all": scene.gaussians}, None, PLAIN)
    assert actual.results[0].num_gaussians < unfilled.results[0].num_gaussians
    assert actual.results[1].fog == unfilled.results[1].fog


def test_documents_have_fog_and_holes(actual: Evaluation) -> None:
    document = json.loads(to_json(evaluation_document(actual, {})))
    given, result = document["results"]
    names = ["fog_near", "fog_far", "holes", "veil", "veil_worst", "spikes", "strokes"]
    assert [given[name] for name in names] == [None] * 7
    assert given["fog_by_kind"] == {}
    assert [result[name] for name in names] == list(vars(actual.results[1].fog["all"]).values())
    assert result["fog_by_kind"]["turned"] == vars(actual.results[1].fog["turned"])
    assert list(result["fog_by_kind"]) == ["back", "turned"]
    rows = list(csv.DictReader(io.StringIO(evaluation_csv(document))))
    assert (rows[0]["holes"], float(rows[-1]["holes"])) == ("", result["holes"])
    heading, head, row = evaluation_lines(document)[-3:]
    assert heading.startswith("Faults seen from outside")
    assert head.split() == ["near", "fog", "far", "fog", "holes", "veil", "worst", "veil", "spikes", "strokes"]
    assert row.split() == ["half", *(f"{result[name]:.3f}" for name in names)]


def test_a_result_with_haze_is_noted(scene: Scene, half: Gaussians) -> None:
    curtain = half[[0]]
    curtain = replace(curtain, scales=np.full_like(curtain.scales, 1e4), opacities=np.full_like(curtain.opacities, 0.3))
    actual = evaluate(scene, {"half": half, "foggy": Gaussians.concat([half, curtain])}, held_out(), PLAIN)
    assert actual.results[2].fog["all"].fog_far == pytest.approx(0.3, abs=0.02)
    notes = [note for note in actual.notes if "seen from outside" in note]
    assert [note.split(":")[0] for note in notes] == ["foggy"]


def test_progress_is_reported_for_every_view(scene: Scene, half: Gaussians) -> None:
    """A stage before each that takes long, and every view."""
    said: list[tuple[str, int, int]] = []
    evaluate(scene, {"half": half}, held_out(), PLAIN, progress=lambda *step: said.append(step))
    names = list(dict.fromkeys(name for name, _, _ in said))
    assert names[-2:] == ["evaluate: input", "evaluate: half"]
    count = 2 * (len(scene) + len(held_out()))
    assert [step[1:] for step in said if step[0] in names[-2:]] == [(done, count) for done in range(1, count + 1)]
    outside = [step for step in said if step[0] == "views from outside"]
    assert [done for _, done, _ in outside] == list(range(outside[0][2]))


def test_tensors_give_the_scores_of_arrays(scene: Scene, half: Gaussians, torch: Any) -> None:
    views = held_out()
    tensors = Views(views.cameras.to("cpu"), torch.from_numpy(views.images), views.names)
    actual, expected = (
        evaluate(scene, {"half": gaussians}, targets, PLAIN).results[1].scores
        for gaussians, targets in ((half.to("cpu"), tensors), (half, views))
    )
    assert actual == expected


def test_pictures_too_small_for_ssim_have_none() -> None:
    scene = scenes.make_scene(scenes.wall(), scenes.arc(1, 6, 5))
    score = evaluate(scene, {}, None, PLAIN).results[0].scores[0]
    assert score.full.ssim is None
    assert score.full.psnr is not None


def test_pictures_too_small_for_lpips_have_none(monkeypatch: pytest.MonkeyPatch) -> None:
    looked = []
    monkeypatch.setattr("gsmerge.scoring.lpips.lpips", lambda image, photo, net, mask: float(looked.append(net) or 0.5))
    scene = scenes.make_scene(scenes.wall(), scenes.arc(1, 32, 24))
    score = evaluate(scene, {}, None, EvaluateOptions(("vgg", "alex"))).results[0].scores[0]
    assert (score.full.lpips_vgg, score.full.lpips_alex) == (0.5, None)
    assert looked == ["vgg"]


def test_the_reference_is_named_for_every_kind_of_scene(scene: Scene) -> None:
    bare, unaligned = replace(scene, images=None), no_pixels(scene)
    assert evaluate(unaligned, {}, held_out(), PLAIN).reference == "photos, and renders of the input in its own views"
    assert evaluate(bare, {}, held_out(), PLAIN).reference == f"photos, and {ROW_COLORS} in its own views"
    assert evaluate(bare, {}, held_out(), replace(PLAIN, context=False)).reference == "photos"
