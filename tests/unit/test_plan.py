"""What a plan makes of facts and options."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
import unaligned_scenes
from messages import noted
from scenes import psnr_of

from gsmerge import CompactOptions, Scene, compact
from gsmerge.counts.search import MAX_BUILDS, add_target
from gsmerge.errors import UsageError
from gsmerge.jobs.estimate import estimate
from gsmerge.method.facts.agreement import Agreement
from gsmerge.method.facts.scene_size import SceneSize, measure_size
from gsmerge.method.fit import Fitted
from gsmerge.method.geometry.frame import canonicalise
from gsmerge.method.geometry.views import REPORT_VIEWS
from gsmerge.method.networks.checkpoint import IN_PACKAGE
from gsmerge.method.pipelines.plan import Plan
from gsmerge.plan.counts import FIDELITY_LOSS, FIDELITY_PSNR, resolve_budget
from gsmerge.plan.efforts import EFFORTS
from gsmerge.plan.fit import steps_for
from gsmerge.plan.forecast import LEVEL_SHARE, run_parts
from gsmerge.plan.make_plan import is_without_views, make_plan, plan_scene
from gsmerge.plan.networks import choose_networks
from gsmerge.prepare.confirm_depths import confirm_depths
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.results.candidate import make_candidate
from gsmerge.runtime.record import record_run
from gsmerge.settings.compact import EFFORT_NAMES as NAMES
from gsmerge.settings.fit import GROW_STEPS
from gsmerge.types import NO_CAMERAS, make_scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24), noise=0.01)


def options_of(**settings: Any) -> CompactOptions:
    return CompactOptions().with_settings(settings)


def plan_of(scene: Scene, **settings: Any) -> Plan:
    options = options_of(**settings)
    return make_plan(prepare(scene, options.prepare), options)


def test_every_effort_has_a_meaning() -> None:
    assert tuple(EFFORTS) == NAMES
    steps = [EFFORTS[name].steps for name in NAMES]
    assert steps == sorted(steps)


@pytest.mark.parametrize("effort", NAMES)
def test_effort_decides_what_is_left_open(effort: str, scene: Scene) -> None:
    plan, own = plan_of(scene, effort=effort), EFFORTS[effort]
    assert plan.fit.steps == own.steps
    assert plan.merge.match.match == ("overlap" if own.merges else "none")
    assert plan.merge.superpixels.options.rectangles == own.rectangles
    assert plan.merge.superpixels.options.early_sweeps == own.early_sweeps


def test_what_is_given_goes_before_effort(scene: Scene) -> None:
    plan = plan_of(scene, effort="draft", fit_steps=7, match="aabb", rectangles=1.5, early_sweeps=2)
    assert plan.fit.steps == 7
    assert plan.merge.match.match == "aabb"
    assert (plan.merge.superpixels.options.rectangles, plan.merge.superpixels.options.early_sweeps) == (1.5, 2)


def test_steps_grow_with_the_root_of_the_share(scene: Scene) -> None:
    usual, views = EFFORTS["default"].steps, len(scene)
    steps = [steps_for(options_of(), views, share) for share in (0.01, 0.044, 0.088, 0.176, 1.0)]
    assert steps == [usual, usual, pytest.approx(usual * 2**0.5, abs=2), pytest.approx(2 * usual, abs=2), 2 * usual]
    assert steps_for(options_of(fit_steps=9), views, 1.0) == 9
    assert steps_for(options_of(budget="auto"), views) == 2 * usual


def test_steps_grow_with_the_views() -> None:
    """By their root, so that a view of many never gets more steps than one of twelve."""
    steps = [steps_for(options_of(), views) for views in (3, 12, 24, 48)]
    usual = EFFORTS["default"].steps
    assert steps == [usual, usual, round(2**0.5 * usual), 2 * usual]
    assert steps_for(options_of(effort="fast"), 48) == 2 * EFFORTS["fast"].steps
    assert steps_for(options_of(fit_steps=9), 48) == 9


def test_a_draft_without_a_fit_leaves_out_nothing() -> None:
    size = SceneSize(460_800, 12, 240, 160, True, rendered=False)
    assert plan_scene(size, options_of(effort="draft", fit="none")).fit.min_contribution == 0
    assert plan_scene(size, options_of(effort="draft")).fit.min_contribution > 0
    assert plan_scene(size, options_of(fit="none")).fit.min_contribution > 0


@pytest.mark.parametrize(
    ("settings", "own_pixels", "rendered", "name"),  # the colours of own pixels stand for photos
    [
        ({}, True, False, "none"), ({}, False, True, "none"), ({"fit": "none"}, True, False, "shipped"),
        ({"fit_steps": 12}, True, False, "none"), ({"effort": "draft", "fit": "none"}, True, False, "shipped"),
        ({"effort": "fast", "fit": "none"}, True, False, "shipped"), ({"fit": "none"}, False, False, "shipped"),
        ({"fit": "none"}, False, True, "none"),
        ({"fit_steps": 60}, False, False, "none"),
        ({"effort": "fast"}, True, False, "none"), ({"effort": "draft"}, False, True, "none"),
        ({"checkpoint": "own.safetensors"}, True, False, "own.safetensors"),
        ({"checkpoint": "none"}, False, False, "none"),
    ],
)  # fmt: skip
def test_networks_are_loaded_where_they_help(
    settings: dict[str, Any], own_pixels: bool, rendered: bool, name: str
) -> None:
    size = SceneSize(768, 1, 24, 32, own_pixels, rendered)
    assert choose_networks(options_of(**settings), size) == name


@pytest.mark.parametrize(
    ("settings", "refines"),
    [
        ({}, True),
        ({"effort": "fast"}, False),
        ({"effort": "draft"}, False),
        ({"effort": "draft", "checkpoint": "shipped"}, True),
    ],
)
def test_quick_efforts_run_the_heads_alone(settings: dict[str, Any], refines: bool, scene: Scene) -> None:
    """Unless the networks are named: the refiner takes ten times as long."""
    networks = plan_of(scene, fit="none", **settings).merge.networks
    assert networks.options.refiner is refines
    assert any(name.startswith("heads.4") for name in networks.arrays)
    assert any(name.startswith("refiner") for name in networks.arrays) is refines


def test_missing_networks_of_the_package_are_noted(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(IN_PACKAGE, "shipped", Path("missing.safetensors"))
    with record_run() as record:
        plan = plan_of(scene, checkpoint="shipped")
    assert plan.merge.networks is None
    assert "networks" in record.notes[0]


@pytest.mark.parametrize("settings", [{}, {"fit": "none"}, {"effort": "draft"}, {"quality": "20dB"}])
def test_without_photos_a_plan_is_the_same_where_pixels_are_known(settings: dict[str, Any], scene: Scene) -> None:
    """Their colours stand in; the estimate, which looks at no colour, knows that."""
    blind, options = replace(scene, images=None), options_of(**settings)
    actual, expected = plan_of(blind, **settings), plan_of(scene, **settings)
    assert actual.settings == expected.settings
    assert actual.count.target_psnr == expected.count.target_psnr
    assert actual.score.views == expected.score.views
    assert estimate(blind, options) == estimate(scene, options)


def test_a_long_fit_begins_with_a_share(scene: Scene) -> None:
    plan = plan_of(scene)
    assert plan.merge.superpixels.start_share < 1
    assert plan.merge.weakens
    assert not plan.with_fit(replace(plan.fit, fit="none")).merge.weakens
    assert not plan_of(scene, fit_steps=10).merge.weakens


@pytest.mark.parametrize(
    ("settings", "has_tree"), [({}, False), ({"budget": 90}, True), ({"levels": 2}, True), ({"quality": "20dB"}, True)]
)
def test_counts_are_cut_from_a_tree(settings: dict[str, Any], has_tree: bool, scene: Scene) -> None:
    assert (plan_of(scene, **settings).merge.superpixels.shared is not None) == has_tree


def test_a_budget_counts_repeated_views(scene: Scene) -> None:
    twice = scenes.take_views(scene, [0, 1, 2, 0, 1, 2])
    assert plan_of(twice, budget="2%").count.limits.exact == round(0.02 * len(twice.gaussians))


@pytest.mark.parametrize(("settings", "reason"), [({"quality": "-1dB"}, "35dB"), ({"drop": "sky"}, "drop sky")])
def test_settings_that_need_photos_are_refused(settings: dict[str, Any], reason: str, scene: Scene) -> None:
    """Where no pixel is known, whose colour could stand in."""
    with pytest.raises(UsageError, match=reason):
        plan_of(unaligned_scenes.without_order(replace(scene, images=None)), **settings)


@pytest.mark.parametrize("settings", [{}, {"budget": "auto"}, {"effort": "draft"}, {"crop": "sphere:0,0,0,1e4"}])
def test_renders_of_the_input_decide_the_count_where_nothing_else_does(settings: dict[str, Any], scene: Scene) -> None:
    rows = unaligned_scenes.without_order(replace(scene, images=None))
    kept = plan_of(rows, **settings)
    assert (kept.count.target_psnr, kept.count.keeps_fidelity) == (FIDELITY_PSNR, True)
    assert len(kept.score.views) == len(rows)
    assert estimate(rows, options_of(**settings))["psnr_kept"] == FIDELITY_PSNR
    assert estimate(rows, options_of(**settings))["fit"] == "full"  # to the renders, as the run does


@pytest.mark.parametrize("settings", [{"budget": 100}, {"k": 2}, {"superpixels": "5%"}, {"quality": "20dB"}])
def test_what_asks_for_a_count_decides_it(settings: dict[str, Any], scene: Scene) -> None:
    rows = unaligned_scenes.without_order(replace(scene, images=None))
    assert plan_of(rows, **settings).count.target_psnr == (20 if "quality" in settings else None)
    for known in (rows, unaligned_scenes.without_order(scene)):
        assert not plan_of(known, **settings).count.keeps_fidelity
    for known in (scene, replace(scene, images=None)):
        assert not plan_of(known).count.keeps_fidelity


@pytest.mark.slow
def test_photos_of_another_scene_decide_no_count(scene: Scene) -> None:
    noise = np.random.default_rng(0).random(scene.images.shape, np.float32)
    rows = unaligned_scenes.without_order(replace(scene, images=noise))
    plan, prepared = plan_of(rows), prepare(rows, options_of().prepare)
    assert (plan.count.keeps_fidelity, plan.count.target_psnr) == (True, FIDELITY_PSNR)  # of renders
    assert add_target(plan, prepared) is plan
    report = compact(rows, threads=1).report
    assert (report.choices["fidelity"]["views"], report.worse) == (len(rows), None)
    assert len(report.choices["search"]["tried"]) <= MAX_BUILDS


def test_photos_decide_the_count_where_rows_are_fewer_than_pixels(scene: Scene) -> None:
    rows = unaligned_scenes.without_order(scene, np.arange(0, len(scene.gaussians), 3))  # fewer than half of the pixels
    rows = replace(rows, gaussians=replace(rows.gaussians, scales=2 * rows.gaussians.scales))
    prepared, plan = prepare(rows, options_of().prepare), plan_of(rows)
    assert (plan.count.keeps_fidelity, plan.count.target_psnr, len(plan.score.views)) == (True, None, len(rows))
    known = add_target(plan, prepared)
    assert known.count.target_psnr == pytest.approx(
        psnr_of(rows.gaussians, prepared.input_scene) - FIDELITY_LOSS, abs=0.05
    )
    assert add_target(known, prepared) is known
    estimated = estimate(rows, options_of())
    assert (estimated["psnr_kept"], estimated["loss_kept"]) == (None, FIDELITY_LOSS)
    assert not plan_of(rows, budget="auto").count.keeps_fidelity  # the photos' own curve decides
    assert not plan_of(
        unaligned_scenes.without_order(scene)
    ).count.keeps_fidelity  # a share is enough of as many as pixels


@pytest.mark.parametrize(("step", "is_few"), [(3, True), (1, False)])
def test_few_rows_are_noted_with_the_option_that_gives_more(step: int, is_few: bool, scene: Scene) -> None:
    """As a state has, whose result keeps what it shows, and could show the photos better."""
    rows = unaligned_scenes.without_order(scene, np.arange(0, len(scene.gaussians), step))
    with record_run(None) as record:
        plan_of(rows)
    assert noted(record.notes, f"{len(rows.gaussians):,} Gaussians", "--budget") == is_few


def test_an_input_with_holes_is_compared_where_it_has_gaussians(scene: Scene) -> None:
    """Elsewhere a worse result would be called better."""
    rows = unaligned_scenes.without_order(scene, np.arange(0, len(scene.gaussians), 2))
    x = rows.gaussians.means[:, 0]
    rows = replace(rows, gaussians=rows.gaussians[np.flatnonzero(x < np.quantile(x, 0.9))])
    prepared = prepare(rows, options_of().prepare)
    plan = add_target(plan_of(rows), prepared)
    assert plan.count.target_psnr == plan.score.before.covered_psnr - FIDELITY_LOSS > plan.score.before.psnr
    given = prepared.frame.enter(rows.gaussians)  # without those that fill the holes
    again = make_candidate(Fitted(given, prepared.scene.cameras, None), prepared, plan)
    assert again.psnr == pytest.approx(plan.score.before.psnr, abs=0.01)
    assert again.deciding_psnr == pytest.approx(plan.score.before.covered_psnr, abs=0.01)


def test_sky_stays_where_no_photo_is_used(scene: Scene) -> None:
    rng = np.random.default_rng(0)
    noise = replace(scene, images=rng.random(scene.images.shape, np.float32))
    with record_run() as record:
        plan = plan_of(unaligned_scenes.without_order(noise), drop="sky")
    assert plan.clean.drop is None
    assert any("drop sky" in note for note in record.notes)


def test_cameras_move_where_it_is_asked_for(scene: Scene) -> None:
    assert not plan_of(scene).fit.move_cameras
    free = plan_of(scene, poses="free")
    assert free.fit.move_cameras
    assert not free.with_fixed_cameras().fit.move_cameras
    assert not plan_of(scene, poses="fixed").fit.move_cameras
    unfitted = plan_of(scene, poses="free", fit="none").fit
    assert not unfitted.move_cameras


@pytest.mark.slow
def test_more_views_are_scored_for_a_quality(scene: Scene) -> None:
    wide = scenes.make_scene(scenes.room(), scenes.arc(10, 240, 224))
    some, every = plan_of(wide), plan_of(wide, quality="20dB")
    assert (len(some.score.views), some.score.samples) == (REPORT_VIEWS, True)
    assert (len(every.score.views), every.score.samples) == (10, False)
    small, few = (plan_of(scenes.make_scene(scenes.room(), scenes.arc(count, 24, 16))) for count in (10, REPORT_VIEWS))
    assert (len(small.score.views), small.score.samples) == (REPORT_VIEWS, True)
    assert (len(few.score.views), few.score.samples) == (REPORT_VIEWS, False)  # of small views all tiles are scored


def test_reports_say_what_was_settled(scene: Scene) -> None:
    plan = plan_of(scene, k=2, effort="fast")
    assert plan.settings["k"] == 2
    assert plan.settings["fit_steps"] == plan.fit.steps
    assert "tuning" not in plan.settings
    assert "move_cameras" not in plan.settings
    settings = options_of(effort="draft")
    settled = plan_scene(measure_size(scene), settings).settings
    assert (settled["match"], settled["checkpoint"]) == ("none", "none")


SETTLED = [{"budget": 200, "effort": "fast"}, {"budget": "30kB", "fill": True, "effort": "draft"}]
OPEN = [  # merging across views, and what photos show, decide how many there are, of at most as many
    {}, {"budget": "30kB", "effort": "draft"},
    {"effort": "draft"}, {"effort": "fast", "k": 2}, {"superpixels": 40, "fit": "none"}, {"recipe": "paper"},
    {"blocks": 2, "effort": "draft"},
]  # fmt: skip


@pytest.mark.parametrize("settings", SETTLED + OPEN)
def test_the_estimate_is_what_the_run_does(
    settings: dict[str, Any], scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    plans: list[Plan] = []

    def record_plan(*arguments: Any, **run: Any) -> Plan:
        plans.append(make_plan(*arguments, **run))
        return plans[-1]

    monkeypatch.setattr("gsmerge.run.make_plan", record_plan)
    options = options_of(**settings)
    size, agreement = measure_size(scene), confirm_depths(canonicalise(scene)[0])
    run, result, choices = (
        estimate(scene, options),
        compact(scene, options),
        plan_scene(size, resolve_budget(size, options, agreement)),
    )
    assert run["fit_steps"] == choices.fit.steps == result.report.options["fit_steps"]
    assert run["blocks"] == len(result.report.choices.get("blocks", "1"))
    count = len(result.gaussians)
    assert run["num_gaussians"] == count if settings in SETTLED else 0.5 * run["num_gaussians"] < count
    assert count <= run["num_gaussians"]
    assert run["exact"] == (settings in SETTLED)
    for plan in plans:  # none of a scene in blocks
        assert (plan.count.limits, plan.merge.decode) == (choices.count.limits, choices.merge.decode)
        assert plan.merge.match.match == choices.merge.match.match
        assert (plan.fit.fit, plan.fit.steps, plan.fit.share) == (choices.fit.fit, choices.fit.steps, choices.fit.share)
        assert run["k"] == plan.merge.decode.k
        assert (plan.merge.checkpoint is None) == (run["checkpoint"] == "none")


@pytest.mark.parametrize(
    ("effort", "num_views", "grows"),
    [("draft", 12, False), ("draft", 512, False), ("fast", 512, False), ("default", 12, True), ("default", 512, True)],
)
def test_runs_grow_if_they_see_each_photo_twice(effort: str, num_views: int, grows: bool) -> None:
    size = SceneSize(38_400 * num_views, num_views, 240, 160, True, rendered=False)
    fit = plan_scene(size, options_of(effort=effort)).fit
    assert fit.grows == grows
    assert num_views == 12 or fit.steps >= GROW_STEPS


@pytest.mark.parametrize("budget", ["40%", "5MB", "quest3"])
def test_limits_beyond_what_wrong_depth_bears_are_as_no_budget(budget: str) -> None:
    size, wrong = SceneSize(1_000_000, 10, 250, 400, True, rendered=False), Agreement(0.3, 0.6, 0.1)
    with record_run() as record:
        limits = plan_scene(size, resolve_budget(size, options_of(budget=budget), wrong)).count.limits
        usual = plan_scene(size, options_of()).count.limits
    assert (limits.exact, limits.count, limits.default) == (usual.exact, usual.count, usual.default)
    assert limits.most == 44_000
    assert noted(record.notes, "44,000", budget)
    asked = resolve_budget(size, options_of(budget="2%"), wrong)
    assert plan_scene(size, asked).count.limits.count == 20_000


def test_coarser_levels_are_expected_to_take_less_time(scene: Scene) -> None:
    """A share of the time of the next finer level each, before the input is scored."""
    prepared = prepare(scene, options_of().prepare)
    *builds, last = run_parts(prepared, plan_of(scene, levels=3, new_views=False))
    assert [part.name for part in builds] == ["build"] * 3
    assert last.name == "input"
    works = [part.work / builds[0].work for part in builds]
    assert works == pytest.approx([1, LEVEL_SHARE, LEVEL_SHARE**2])


def test_a_run_without_views_is_one_without_networks_or_other_methods(scene: Scene) -> None:
    bare = make_scene(scene.gaussians, NO_CAMERAS)
    options = CompactOptions()
    assert is_without_views(bare, options)
    assert not is_without_views(bare, options.with_settings({"checkpoint": "shipped"}))
    assert not is_without_views(bare, options.with_settings({"method": "random"}))
    assert not is_without_views(unaligned_scenes.without_order(scene), options)
