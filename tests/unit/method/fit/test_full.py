"""The full fit finds known Gaussians again, follows masks, drops Gaussians out, and moves cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from sweeps import sweep

from gsmerge import Gaussians, Scene
from gsmerge.method.fit import FitJob, FitOptions, report_steps, start_share, steps
from gsmerge.method.fit.fit_state import start_state
from gsmerge.method.fit.full import fit_full, limit_moves
from gsmerge.method.fit.photo_sizes import training_weights
from gsmerge.method.fit.report import SAMPLE_COST
from gsmerge.method.fit.schedule import (
    DROPOUT,
    FEW_VIEWS,
    MANY_STEPS,
    STRIDE,
    DrawMode,
    Schedule,
    Step,
    prepare_fit,
    step_sizes,
)
from gsmerge.method.fit.steps import Optimiser, make_optimiser, start_poses
from gsmerge.method.fit.survey import score_state, survey_photos
from gsmerge.method.geometry.transforms import motion_matrices, motion_vectors, project_points
from gsmerge.method.kernels import elementary
from gsmerge.method.raster import splat_adjoint, tile_view
from gsmerge.method.raster.composite import blend, view_colors
from gsmerge.method.raster.gradient import gradients_of
from gsmerge.method.raster.photos import Photos
from gsmerge.runtime.record import record_run
from gsmerge.settings.fit import GROW_STEPS, LONG_STEPS, USUAL_SHARE, Tuning

Pair = tuple[Photos, Photos]
QUICK = FitOptions(fit_steps=30, holdout=0.2, fills=True)
LONG = FitOptions(fit_steps=160, holdout=0.2, fills=True)


# what it reaches


def test_a_full_fit_restores_a_perturbed_scene(scene: Scene, truth: Gaussians, photos: Pair) -> None:
    gains = []
    for seed in range(3):
        start = scenes.spoil(truth, seed=seed)
        result, report = fit_full(start, scenes.run_for(photos, replace(LONG, dropout=0.0), len(start), seed=seed))
        assert (report.method, report.accepted, report.steps) == ("full", True, 160)
        assert scenes.psnr_of(result, scene) > scenes.psnr_of(start, scene) + 6  # dB: the error halves
        assert len(result) == len(start)
        gains.append(report.holdout_after - report.holdout_before)
    assert np.mean(gains) > 5  # dB, on patches that the fit has not seen
    scenes.assert_invariants(result, scene)


def test_a_full_fit_moves_gaussians_within_their_box(truth: Gaussians, photos: Pair) -> None:
    box = {"max_mean_shift": 0.5, "max_scale_change": 0.1, "max_opacity_change": 0.2, "min_scale": 0}
    box["max_ratio"] = np.inf
    start = scenes.spoil(truth)
    result, report = fit_full(start, scenes.run_for(photos, scenes.tuned(QUICK, **box)))
    assert report.accepted
    unit = np.sort(start.scales, 1)[:, 1:].prod(1) ** 0.5
    assert (np.linalg.norm(result.means - start.means, axis=1) <= 0.501 * unit).all()
    assert float(np.abs(np.log(result.scales / start.scales)).max()) <= 0.1001
    before, after = (elementary.log(a / (1 - a)) for a in (g.opacities.astype(np.float64) for g in (start, result)))
    assert float(np.abs(after - before).max()) <= 0.2001


def test_a_full_fit_leaves_no_needle_that_photos_show(truth: Gaussians, photos: Pair) -> None:
    """Every twentieth Gaussian starts as a needle across the picture; without the limit most stay long."""
    rows = np.arange(0, len(truth), 20)
    scales = truth.scales.copy()
    scales[rows] = scales[rows].mean() * np.array([12, 1, 0.5], np.float32)
    start, left = replace(truth, scales=scales), []
    for most in (3.0, np.inf):
        options = replace(LONG, scored=False)
        run = scenes.run_for(photos, scenes.tuned(options, max_ratio=most, long_share=0.1, max_scale_change=0.7))
        survey = survey_photos(start, run)
        result, report = fit_full(start, run)
        assert report.origins is not None
        pixels = survey.pixels[report.origins]
        _, second, longest = np.sort(result.scales, 1).T
        long = np.isfinite(pixels) & (3 * longest > 1.01 * 0.1 * photos[0].width * pixels)
        left.append(int((long & (longest > 3.2 * second)).sum()))  # means of the last steps may exceed 3
    assert left[0] == 0 < left[1]


def test_gaussians_that_one_photo_shows_have_a_smaller_box(truth: Gaussians, photos: Pair) -> None:
    state, least = start_state(truth), QUICK.tuning.single_view_share

    def shares_of(some: Pair) -> np.ndarray:
        run = scenes.run_for(some, QUICK)
        survey = survey_photos(truth, run)
        actual, _ = limit_moves(survey, QUICK.tuning)
        assert survey.score == score_state(state, run, some[1])
        return actual

    def with_views(views: list[int]) -> Pair:
        return tuple(Photos(p.images[views], p.viewmats[views], p.Ks[views], p.eps2d) for p in photos)

    box_shares, alone = shares_of(photos), with_views([0])
    assert box_shares.dtype == np.float32
    assert box_shares.min() >= np.float32(least)
    assert box_shares.max() == 1
    np.testing.assert_array_equal(shares_of(alone), np.full(len(truth), least, np.float32))
    whole = np.ones((alone[1].height, alone[1].width, 1))
    shown = splat_adjoint(tile_view(state.splats, **alone[1].camera(0)), whole)[:, 0]
    np.testing.assert_allclose(shares_of(with_views([0, 0])), np.where(shown > 0, 1, least), atol=1e-6)


def test_no_gaussian_becomes_thinner_than_half_a_pixel(truth: Gaussians, photos: Pair) -> None:
    """Of the photo that it is nearest to, whatever the box says."""
    start = scenes.spoil(truth)
    thin = replace(start, scales=start.scales * np.array([0.02, 1, 1], np.float32))
    _, min_sizes = limit_moves(survey_photos(thin, scenes.run_for(photos, QUICK)), QUICK.tuning)
    views = photos[0].viewmats
    depths = start.means @ views[:, 2, :3].T + views[:, 2, 3]
    np.testing.assert_allclose(np.exp(min_sizes), 0.5 * depths.min(1) / photos[0].Ks[0, 0, 0], rtol=1e-4)
    free = scenes.tuned(QUICK, min_scale=0.0)
    kept, report = fit_full(thin, scenes.run_for(photos, QUICK))
    needles, other = fit_full(thin, scenes.run_for(photos, free))
    assert report.accepted
    assert other.accepted
    assert (kept.scales >= np.exp(min_sizes)[:, None] * (1 - 1e-5)).all()
    assert (needles.scales.min(1) < np.exp(min_sizes) / 3).mean() > 0.5


def test_steps_draw_in_the_modes_of_viewers(photos: Pair) -> None:
    """With and without compensation, as when enlarged twice, and from afar; samples too, without compensation."""
    run = prepare_fit(FitJob(photos, LONG))
    modes = [run.draw_mode(step, 0.8) for step in range(1, 17)]
    afar = DrawMode(1, 0.3)
    assert set(modes) == {DrawMode(0, 0.3, antialiased=True), DrawMode(0, 0.3), DrawMode(0, 0.075), afar}
    assert modes.count(afar) == 2
    assert modes[0] == run.draw_mode(17, 0.8)
    first = [run.draw_mode(step, 0.49) for step in range(1, 17)]
    assert set(first) == {DrawMode(0, 0.3, stride=2), DrawMode(0, 0.075, stride=2), afar}
    assert first.count(afar) == 4
    crowd = prepare_fit(FitJob(photos, LONG, count=photos[1].width * photos[1].height * len(photos[1]) + 1))
    moving = prepare_fit(FitJob(photos, replace(LONG, move_cameras=True)))
    assert {run.draw_mode(1, 0.49) for run in (crowd, moving)} == {DrawMode(1, 0.075)}
    assert afar not in {prepare_fit(FitJob(photos, QUICK)).draw_mode(step, 0.8) for step in range(1, 17)}


@pytest.mark.parametrize("views", [1, 2, 4])
def test_the_first_steps_draw_each_pixel_in_turn(photos: Pair, views: int) -> None:
    """As the camera of a sample shows it: alone as among the others, and never those that are held out."""
    few = tuple(level[[view % len(level) for view in range(views)]] for level in photos)
    run = prepare_fit(FitJob(few, LONG))
    schedule, full = Schedule(run), few[0]
    steps = [schedule.draw(number, 0.1, 10) for number in range(1, 8 * views + 1)]
    steps = [step for step in steps if step.mode.size == 0]  # others draw a photo of half the size as a whole
    for view in range(views):
        drawn = np.zeros((full.height, full.width), int)
        for step in steps:
            if step.view == view:
                drawn[step.sample.pixels] += 1
                assert run.weight(step).shape == full.image(view)[step.sample.pixels].shape[:2]
        assert (drawn > 0).all()
    held_out = training_weights(full, LONG.holdout, 0)
    for step in steps[:4]:
        hidden = held_out[step.view][step.sample.pixels] == 0
        assert (run.weight(step)[hidden] == 0).all()
        assert (run.weight(step)[~hidden] == 1).all()


@pytest.mark.parametrize(("name", "field"), [("opacity_reg", "opacities"), ("scale_reg", "scales")])
def test_regularisation_makes_gaussians_smaller_or_fainter(
    truth: Gaussians, photos: Pair, name: str, field: str
) -> None:
    start = scenes.spoil(truth)
    free, pulled = (
        fit_full(start, scenes.run_for(photos, scenes.tuned(QUICK, **{name: prior_weight})))[0]
        for prior_weight in (0.0, 0.05)
    )
    assert np.log(getattr(pulled, field)).mean() < np.log(getattr(free, field)).mean() - 0.02


# counts


@pytest.mark.parametrize(("every", "extra"), [(1, 0), (1, 70), (4, 85)])
def test_a_full_fit_grows_to_the_count_asked_for(truth: Gaussians, photos: Pair, every: int, extra: int) -> None:
    """More than double is grown in turns."""
    start = scenes.spoil(truth)[::every]
    assert every == 1 or extra > 1.5 * len(start)
    result, report = fit_full(start, scenes.run_for(photos, LONG, count=len(start) + extra))
    assert report.accepted
    assert len(result) == len(start) + extra


def test_a_full_fit_grows_to_a_multiple_of_its_start_at_most(truth: Gaussians, photos: Pair) -> None:
    """Where many views show the same surfaces, few of the Gaussians at the start are visible."""
    start = scenes.spoil(truth)[::8]
    run = scenes.run_for(photos, replace(LONG, fills=False), count=8 * len(start), most_growth=3)
    result, report = fit_full(start, run)
    assert report.accepted
    assert len(result) == 3 * len(start)


def test_a_fit_is_judged_before_it_grows(truth: Gaussians, photos: Pair) -> None:
    """Halves that were never fitted show less than their parents, and would have the fit refused."""
    start = truth[::8]
    options = replace(LONG, half_res_share=0.5, dropout=0.0)
    (_, grown), (_, same) = (
        fit_full(start, scenes.run_for(photos, options, count=count)) for count in (8 * len(start), 0)
    )
    assert grown.accepted
    assert grown.holdout_after == same.holdout_after


@pytest.mark.parametrize(("views", "dropout"), [(20, 0.05), (21, 0.0)])
def test_dropout_needs_many_looks_at_each_view(photos: Pair, views: int, dropout: float) -> None:
    many = tuple(one[[view % len(one) for view in range(views)]] for one in photos)
    assert prepare_fit(FitJob(many, FitOptions(fit_steps=600))).dropout == dropout


def test_every_view_is_drawn_once_before_any_again(
    truth: Gaussians, photos: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every view once before any again; the steps after the growth drop out of all Gaussians."""
    start, taken = scenes.spoil(truth), list[Step]()
    run = scenes.run_for(photos, FitOptions(fit_steps=320, scored=False), len(start) + 20, seed=3)
    monkeypatch.setattr(Optimiser, "step", lambda self, state, step: taken.append(step) or 0.0)
    assert len(fit_full(start, run)[0]) == len(start) + 20
    assert run.dropout == DROPOUT > 0
    assert [step.number for step in taken] == list(range(1, 321))
    assert (len(taken[0].mask), len(taken[-1].mask)) == (len(start), len(start) + 20)
    assert 0.8 < np.concatenate([step.mask for step in taken]).mean() < 1
    views = [step.view for step in taken]
    assert all(sorted(views[i : i + 3]) == [0, 1, 2] for i in range(0, 318, 3))


def test_short_fits_do_not_grow(truth: Gaussians, photos: Pair) -> None:
    start = scenes.spoil(truth)
    assert len(fit_full(start, scenes.run_for(photos, QUICK, count=2 * len(start)))[0]) == len(start)
    assert start_share(QUICK) == 1
    assert start_share(replace(LONG, fit="none")) == 1
    assert 0 < start_share(LONG) < 1


# safety


def test_a_fit_does_not_learn_from_held_out_patches(truth: Gaussians, photos: Pair) -> None:
    """All steps at half size: what the photos show there does not matter. (SSIM's windows do reach into them.)"""
    options = scenes.tuned(replace(QUICK, half_res_share=1.0), ssim_lambda=0.0)
    start = scenes.spoil(truth)
    weights = prepare_fit(FitJob(photos, options)).score_weights
    painted = photos[1].images.copy()
    for image, weight in zip(painted, weights, strict=True):
        image[weight == 0] = 1 - image[weight == 0]
    one = run_steps(start, photos, options)
    other = run_steps(start, (photos[0], replace(photos[1], images=painted)), options)
    np.testing.assert_array_equal(one, other)


def run_steps(gaussians: Gaussians, photos: Pair, options: FitOptions) -> np.ndarray:
    """Return the state after some steps, without a judge."""
    run, state = scenes.run_for(photos, options), start_state(gaussians)
    schedule, optimiser = Schedule(run), make_optimiser(run)
    for step in range(options.fit_steps):
        optimiser.step(state, schedule.draw(step + 1, step / options.fit_steps, len(gaussians)))
    return state.x


@pytest.mark.parametrize("degree", [0, 3])
def test_unseen_gaussians_stay_as_they_are_in_a_full_fit(degree: int) -> None:
    """Outside all photos; also with colours that no photo has."""
    scene, truth = scenes.self_made(degree)
    behind = replace(truth[:4], means=truth.means[:4] - 100, sh0=np.full((4, 1, 3), 4.0, np.float32))
    start = Gaussians.concat([scenes.spoil(truth), behind])
    result, report = fit_full(start, scenes.run_for(scenes.pair_of(scene), QUICK))
    assert report.accepted
    for name in scenes.FIELDS:
        np.testing.assert_allclose(getattr(result, name)[-4:], getattr(behind, name), rtol=1e-5, atol=1e-6)


# rates, report, progress


def test_step_sizes_decay_to_their_end() -> None:
    rates = Tuning()
    start, half, end = (step_sizes(rates, p, 100) for p in (0.0, 0.5, 1.0))
    expected = (
        [rates.means_lr] * 3
        + [rates.scales_lr] * 3
        + [rates.quats_lr] * 4
        + [rates.opacities_lr]
        + [rates.colors_lr] * 3
    )
    np.testing.assert_allclose(start, expected, rtol=1e-6)
    np.testing.assert_allclose(end, rates.decay * start, rtol=1e-6)
    assert rates.decay < 1
    np.testing.assert_allclose(half**2, start * end, rtol=1e-6)


def test_progress_shows_the_mean_error_of_whole_photos_alone(
    truth: Gaussians, photos: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before them a mean over fewer pixels may be another one."""
    monkeypatch.setattr(Optimiser, "step", lambda self, state, step: 0.01 if step.mode.stride > 1 else 0.1)
    calls: list[tuple[int, int, float, bool]] = []
    options = FitOptions(fit_steps=30, half_res_share=0.5, scored=False)
    fit_full(scenes.spoil(truth), scenes.run_for(photos, options, progress=lambda *call: calls.append(call)))
    assert {call[3] for call in calls} == {0.5}
    assert {round(call[2]) for call in calls[:15]} == {20}
    assert {round(call[2]) for call in calls[15:]} == {10}


def test_progress_counts_the_first_steps_as_quicker() -> None:
    """So that the time left is about right."""
    said: list[tuple[str, int, int]] = []
    with record_run(lambda *stage: said.append(stage)):
        report_steps(10, 20, 20.0, 0.5)
        report_steps(15, 20, 10.0, 0.5)
        report_steps(20, 20, 10.0, 0.5)
    assert said[0] == ("fit: photos 20.0 dB", round(20 * SAMPLE_COST / (1 + SAMPLE_COST)), 20)
    assert said[1][0] == "fit: photos 10.0 dB"
    assert said[0][1] < said[1][1] < 20
    assert said[2][1:] == (20, 20)


# the same again


def test_the_size_of_pieces_of_a_step_changes_no_bit(
    truth: Gaussians, photos: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = fit_full(scenes.spoil(truth), scenes.run_for(photos, QUICK))
    monkeypatch.setattr(steps, "ADAM_ROWS", 17)
    assert scenes.identical(fit_full(scenes.spoil(truth), scenes.run_for(photos, QUICK))[0], one[0])


def test_a_full_fit_is_repeated_by_its_seed_alone(truth: Gaussians, photos: Pair) -> None:
    start = scenes.spoil(truth)
    one, two, other = (fit_full(start, scenes.run_for(photos, QUICK, seed=seed)) for seed in (5, 5, 6))
    assert scenes.identical(one[0], two[0])
    assert one[1] == two[1]
    assert not scenes.identical(one[0], other[0])


@pytest.mark.parametrize("size", [(8, 6), (5, 1), (1, 1)])
def test_a_full_fit_works_on_tiny_photos(size: tuple[int, int]) -> None:
    scene = scenes.make_scene(scenes.wall(), scenes.arc(2, *size))
    start = replace(scene.gaussians, means=scene.gaussians.means.astype(np.float32))
    result, report = fit_full(start, scenes.run_for(scenes.pair_of(scene), QUICK))
    assert len(result) == len(start)
    assert np.isfinite([report.holdout_before, report.holdout_after]).all()
    for name in scenes.FIELDS:
        assert np.isfinite(getattr(result, name)).all()


def test_longer_fits_end_with_smaller_steps() -> None:
    rates = Tuning()
    usual, long = step_sizes(rates, 1.0, 300), step_sizes(rates, 1.0, 900)
    np.testing.assert_allclose(long, usual / 3, rtol=1e-6)
    np.testing.assert_array_equal(step_sizes(rates, 0.0, 300), step_sizes(rates, 0.0, 900))
    np.testing.assert_array_equal(step_sizes(rates, 1.0, 12), usual)


def test_rows_that_change_late_are_not_averaged_with_others(
    truth: Gaussians, photos: Pair, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Others take the places of faint Gaussians just after the last fifth of the steps has begun."""
    monkeypatch.setattr("gsmerge.method.fit.full.CLEARS", (0.8,))
    monkeypatch.setattr("gsmerge.method.fit.full.FAINT", 0.3)
    start, scores = scenes.spoil(truth), []
    for count in (160, 163):  # the mean begins with the step after, and with that before
        result, _ = fit_full(start, scenes.run_for(photos, replace(LONG, fit_steps=count), len(start)))
        assert len(result) == len(start)
        scores.append(scenes.psnr_of(result, scene))
    assert scores[1] > scores[0] - 1  # dB; averaged with others they would lose more


@sweep("coarse", [0.5, 1.0])
def test_a_fit_ignores_what_masks_leave_out(coarse: float, scene: Scene, truth: Gaussians) -> None:
    """Rubbish on the left third of every photo; at both sizes, and at half size alone."""
    start = scenes.spoil(truth)
    options = FitOptions(fit_steps=40, holdout=0.2, half_res_share=coarse, dropout=0.0)

    def spoilt(photos: Photos) -> Photos:
        images = photos.images.copy()
        images[:, :, : photos.width // 3] = (1, 0, 1)
        return replace(photos, images=images)

    rubbish = tuple(map(spoilt, scenes.pair_of(scene)))
    masks = tuple(np.ones(photos.images.shape[:3], np.float32) for photos in rubbish)
    for mask in masks:
        mask[:, :, : mask.shape[2] // 3] = 0
    whole, _ = fit_full(start, scenes.run_for(rubbish, options))
    weighed, even = (
        tuple(replace(photos, weights=np.maximum(mask, least)) for photos, mask in zip(rubbish, masks, strict=True))
        for least in np.array([0, 1], np.float32)
    )
    masked, report = fit_full(start, scenes.run_for(weighed, options))
    again, _ = fit_full(start, scenes.run_for(even, options))
    assert report.accepted
    assert scenes.psnr_of(masked, scene) > scenes.psnr_of(whole, scene) + 2  # dB: the rubbish is not learnt
    assert np.array_equal(again.means, whole.means)


SHORT = FitOptions(fit_steps=30, holdout=0.2)
LONGER = FitOptions(fit_steps=160, holdout=0.2)


def test_dropout_is_used_where_there_are_few_views(photos: tuple[Photos, Photos]) -> None:
    many = Photos(*(np.concatenate([a, a]) for a in (photos[0].images, photos[0].viewmats, photos[0].Ks)), eps2d=0.3)
    pair = many, replace(photos[1], images=np.concatenate([photos[1].images] * 2))
    assert len(photos[0]) <= FEW_VIEWS < len(many)
    assert prepare_fit(FitJob(photos, LONGER)).dropout == DROPOUT > 0
    assert prepare_fit(FitJob(photos, replace(LONGER, fit_steps=MANY_STEPS - 1))).dropout == 0
    assert prepare_fit(FitJob(pair, LONGER)).dropout == 0
    assert prepare_fit(FitJob(pair, replace(LONGER, dropout=0.15))).dropout == 0.15
    assert prepare_fit(FitJob(photos, replace(LONGER, dropout=0.0))).dropout == 0
    very_long = replace(LONGER, fit_steps=LONG_STEPS)
    assert 0 < prepare_fit(FitJob(pair, very_long)).dropout < prepare_fit(FitJob(photos, very_long)).dropout


def test_shorter_runs_have_more_steps_on_half_size_photos() -> None:
    parts = [FitOptions(fit_steps=steps).half_res_part for steps in (10, 60, GROW_STEPS, 1000)]
    assert 1 == parts[0] > parts[1] == parts[2] > parts[3]
    assert replace(LONGER, half_res_share=0.9).half_res_part == 0.9


def test_short_runs_draw_samples_alone_unless_cameras_move_or_photos_are_larger() -> None:
    planned = FitOptions(fit_steps=60, photo_scale=1.0)
    assert planned.half_res_part == 1
    assert replace(planned, fit_steps=GROW_STEPS).half_res_part < 1
    assert replace(planned, move_cameras=True).half_res_part < 1
    assert replace(planned, photo_scale=2.0).half_res_part < LONGER.half_res_part
    assert replace(planned, half_res_share=0.5).half_res_part == 0.5


def test_all_pixels_of_samples_count_once_the_held_out_patches_are_scored(photos: tuple[Photos, Photos]) -> None:
    run = prepare_fit(FitJob(photos, FitOptions(fit_steps=60, photo_scale=1.0, holdout=0.2)))
    schedule = Schedule(run)
    steps = [schedule.draw(number + 1, number / 60, 1) for number in range(60)]
    assert {step.mode.stride for step in steps} == {STRIDE}
    is_whole = [bool((run.weight(step) == 1).all()) for step in steps]
    assert is_whole == [step.progress >= run.scored_part for step in steps]
    assert 0 < sum(is_whole) < 30
    asked = prepare_fit(FitJob(photos, FitOptions(fit_steps=60, half_res_share=1.0, holdout=0.2)))
    assert asked.scored_part == 1  # as where short fits compare counts on patches that no step draws


def test_more_gaussians_have_fewer_steps_on_half_size_photos() -> None:
    parts = [replace(LONGER, share=share).half_res_part for share in (0.01, USUAL_SHARE, 2 * USUAL_SHARE, 0.2)]
    assert parts[0] == parts[1] == LONGER.half_res_part
    assert parts[1] > parts[2] > parts[3] > 0.3
    short = replace(SHORT, share=0.2)
    assert short.half_res_part == SHORT.half_res_part
    assert replace(LONGER, share=0.2, half_res_share=0.9).half_res_part == 0.9


def test_dropout_leaves_its_share_of_gaussians_out_of_a_step(truth: Gaussians, photos: tuple[Photos, Photos]) -> None:
    """What is left out learns nothing from the step."""
    moved = []
    for share in (0.0, 0.5):
        state, run = start_state(truth), scenes.run_for(photos, replace(SHORT, dropout=share))
        make_optimiser(run).step(state, Schedule(run).draw(1, 0.0, len(truth)))
        moved.append(state.m.any(1).mean())
    assert moved[0] > 0.6
    assert moved[1] == pytest.approx(0.5 * moved[0], abs=0.1)


FREE = FitOptions(fit_steps=120, holdout=0.2, move_cameras=True, dropout=0.0)


def spoil_poses(photos: Pair, size: float = 0.01) -> Pair:
    """Return photos whose poses are off; the mean of the motions is none."""
    motions = np.random.default_rng(0).normal(size=(len(photos[0]), 6)) * size
    viewmats = photos[0].viewmats @ motion_matrices(motions - motions.mean(0))
    return replace(photos[0], viewmats=viewmats), replace(photos[1], viewmats=viewmats)


def squared_error(truth: Gaussians, photos: Photos, view: int) -> tuple[float, np.ndarray]:
    """Return the squared error of a view, and its gradient by the viewmat."""
    drawn = tile_view(start_state(truth).splats, **photos.camera(view))
    colors = view_colors(drawn)
    image, left = blend(drawn, colors, np.zeros(3, np.float32))
    residual = image - photos.images[view]
    wanted = gradients_of(drawn, colors, image, left, 2 * residual, None, with_viewmat=True).viewmat
    return float((residual**2).sum()), wanted


@pytest.mark.parametrize("view", [0, 1])
def test_steps_of_a_pose_lower_the_loss(view: int, truth: Gaussians, photos: Pair) -> None:
    poses, (full, _) = start_poses(spoil_poses(photos))
    before = squared_error(truth, full, view)[0]
    rates = Tuning(poses_lr=0.1)
    for _ in range(10):
        poses.step(view, squared_error(truth, full, view)[1], rates, 0.0)
    assert squared_error(truth, full, view)[0] < 0.9 * before
    np.testing.assert_allclose(poses.x.mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(motion_vectors(poses.start, poses.viewmats), poses.x, atol=1e-9)


def test_a_fit_that_moves_cameras_finds_their_poses(truth: Gaussians, photos: Pair) -> None:
    wrong, start = spoil_poses(photos), scenes.spoil(truth)
    free, report = fit_full(start, scenes.run_for(wrong, FREE))
    fixed, other = fit_full(start, scenes.run_for(wrong, replace(FREE, move_cameras=False)))
    assert other.viewmats is None
    pixels = [project_points(truth.means, one, photos[0].Ks)[0] for one in (
        photos[0].viewmats, wrong[0].viewmats, report.viewmats,
    )]  # fmt: skip
    before, after = (float(np.median(np.linalg.norm(one - pixels[0], axis=-1))) for one in pixels[1:])
    assert after < 0.5 * before
    assert report.holdout_after > other.holdout_after + 0.5  # dB
    np.testing.assert_allclose(motion_vectors(wrong[0].viewmats, report.viewmats).mean(0), 0, atol=1e-9)
    assert len(free) == len(fixed)
