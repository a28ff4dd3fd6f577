"""The full fit on a device: on torch's CPU device the same run as with the kernels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
import torch
from gpu_runs import CPU, ON_TORCH, PULLS, QUICK, Pair, assert_close, gpu, on_device

from gsmerge import Gaussians, Scene
from gsmerge.fit import fit
from gsmerge.fit import fit_state as stage_state
from gsmerge.fit import full as stage_full
from gsmerge.fit.gpu import choose_backend, full_fit
from gsmerge.fit.gpu.adam import adam_step, gaussians_of, start_state
from gsmerge.fit.gpu.device_photos import upload_gaussians, upload_photos
from gsmerge.fit.gpu.full_fit import draw_order, error_masses, grow_to, make_levels, step_gradients


@pytest.mark.parametrize("settings", [{}, {"ssim_lambda": 0.0}, {"half_res_share": 1.0}, {"opacity_reg": 3.0}], ids=str)
def test_runs_are_the_kernels(start: Gaussians, photos: Pair, settings: dict[str, Any]) -> None:
    """The same views, backgrounds and steps: a run that does something else is far away after eight."""
    constants = settings.keys() & {"ssim_lambda", "opacity_reg"}
    options = scenes.tuned(QUICK, **settings) if constants else replace(QUICK, **settings)
    actual, report = fit(start, photos, options, seed=4, backend=ON_TORCH)
    expected, other = fit(start, photos, options, seed=4)
    assert_close(actual, expected, 1e-3)
    assert (report.method, report.accepted, report.steps) == (other.method, other.accepted, other.steps)
    assert report.holdout_before == pytest.approx(other.holdout_before, abs=1e-3)
    assert report.holdout_after == pytest.approx(other.holdout_after, abs=0.05)
    moved = fit(start, photos, options, seed=5, backend=ON_TORCH)[0]
    assert np.abs(moved.means - actual.means).max() > 1e-3


def test_runs_with_harmonics_are_the_kernels() -> None:
    scene, truth = scenes.self_made(1)
    start, photos = scenes.spoil(truth, seed=1), scenes.pair_of(scene)
    assert_close(fit(start, photos, QUICK, backend=ON_TORCH)[0], fit(start, photos, QUICK)[0], 2e-3)


def test_long_run_grows_to_the_count(scene: Scene, start: Gaussians, photos: Pair) -> None:
    steps: list[int] = []
    options, count = replace(PULLS, fit_steps=150), len(start) + 20
    result, report = fit(start, photos, options, count, progress=lambda step, *_: steps.append(step), backend=ON_TORCH)
    assert report.accepted
    assert len(result) == count
    assert steps == [20, 40, 60, 80, 100, 120, 140, 150]
    scenes.assert_invariants(result, scene)
    actual = [result, *(fit(start, photos, options, count, seed, backend=ON_TORCH)[0] for seed in (1, 2))]
    expected = [fit(start, photos, options, count, seed)[0] for seed in range(3)]
    means = [np.mean([scenes.psnr_of(one, scene) for one in results]) for results in (actual, expected)]
    assert means[0] == pytest.approx(means[1], abs=0.5)


def test_dropout_and_budget(start: Gaussians, photos: Pair, scene: Scene) -> None:
    options = replace(QUICK, dropout=0.2, time_budget=0.5)
    result, report = fit(start, photos, options, backend=ON_TORCH)
    assert report.accepted
    assert report.steps > 6
    assert report.stopped == "time budget spent"
    assert scenes.psnr_of(result, scene) > scenes.psnr_of(start, scene) + 2


def test_clock_of_a_budget_starts_after_a_step(start: Gaussians, photos: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a copy, so that no state has moved and the PROBE steps are all timed."""
    events: list[str] = []
    step, states = full_fit.step_gradients, []

    def note_step(state: Any, *arguments: Any) -> Any:
        events.append("step")
        states.append(state)
        return step(state, *arguments)

    def note_time() -> float:
        events.append("clock")
        return float(len(events))

    monkeypatch.setattr(full_fit, "step_gradients", note_step)
    monkeypatch.setattr(full_fit.time, "perf_counter", note_time)
    fit(start, photos, replace(QUICK, time_budget=1e-6), backend=ON_TORCH)
    assert events[: stage_full.PROBE + 3] == ["step", "clock", *["step"] * stage_full.PROBE, "clock"]
    assert states[0] is not states[1]
    assert states[1] is states[2]


def test_baseline_start_may_be_beaten_instead(start: Gaussians, photos: Pair) -> None:
    black = replace(start, sh0=np.full_like(start.sh0, -1.7))
    for other in (black, start):
        _, actual = fit(start, photos, QUICK, baseline_start=other, backend=ON_TORCH)
        _, expected = fit(start, photos, QUICK, baseline_start=other)
        assert actual.holdout_before == pytest.approx(expected.holdout_before, abs=1e-3)


def test_growth_is_the_stages(start: Gaussians, photos: Pair) -> None:
    actual, expected = start_state(upload_gaussians(start, CPU)), stage_state.start_state(start)
    half = on_device(photos)[1]
    np.testing.assert_allclose(
        error_masses(actual, half), stage_state.error_masses(expected, photos[1]), rtol=1e-4, atol=1e-5
    )
    actual.m += 0.5
    expected.m += 0.5
    actual.min_sizes[:], expected.min_sizes[:] = -3, -3
    grown, other = grow_to(actual, half, len(start) + 30), stage_state.grow_to(expected, photos[1], len(start) + 30)
    for name in ("x", "x0", "m", "units", "box_shares", "min_sizes"):
        np.testing.assert_allclose(getattr(grown, name), getattr(other, name), rtol=1e-4, atol=1e-5, err_msg=name)
    for name in ("means", "quats", "scales", "opacities"):
        np.testing.assert_allclose(getattr(grown, name), getattr(other.splats, name), rtol=1e-4, atol=1e-5)
    again = gaussians_of(grown.x, grown.shN).numpy()
    assert_close(again, stage_state.gaussians_of(other.x, other.splats.shN), 1e-5)


def test_order_is_the_stages(photos: Pair, monkeypatch: pytest.MonkeyPatch, start: Gaussians) -> None:
    """Every view once before any comes again, in the order of the CPU's run."""
    taken: list[int] = []
    step = stage_full.fit_step
    monkeypatch.setattr(stage_full, "fit_step", lambda *args: taken.append(args[2]) or step(*args))
    stage_full.fit_full(start, photos, replace(QUICK, half_res_share=1.0), seed=3)
    views, backgrounds = draw_order(3, 3, 8)
    assert views == taken
    assert sorted(views[:3]) == [0, 1, 2]
    assert backgrounds.shape == (8, 3)


def test_all_of_a_step_is_on_the_device(start: Gaussians, photos: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """With tensors that have a device and no memory: mixing devices would fail. gsplat and autograd stand aside."""

    def drawn(shape: Any, colors: torch.Tensor, photos: Any, view: int, background: torch.Tensor, **_: Any) -> Any:
        assert background.is_meta
        reached = torch.ones(len(colors), dtype=torch.bool, device=colors.device)
        return colors.sum() * torch.ones(photos.height, photos.width, 3, device=colors.device), reached

    monkeypatch.setattr(full_fit, "draw", drawn)
    monkeypatch.setattr(torch.autograd, "grad", lambda image, leaves, wanted: [torch.empty_like(x) for x in leaves])
    meta = torch.device("meta")
    state = start_state(start.to(meta))
    plan = stage_full.plan_run(photos, QUICK, 0)
    look, weights = plan.look_at(1, 1.0), stage_full.loss_weights(QUICK.tuning, 1.0)
    for level in make_levels((upload_photos(photos[0], meta), upload_photos(photos[1], meta)), plan):
        gradients, error = step_gradients(state, level, 1, torch.zeros(3, device=meta), None, look, weights)
        adam_step(state, gradients, QUICK, torch.empty(14, device=meta), 1)
        assert error.is_meta
    assert state.x.is_meta


@gpu
def test_gpu_reaches_the_same(scene: Scene, start: Gaussians, photos: Pair) -> None:
    options, count = replace(QUICK, fit_steps=160), len(start) + 20
    backend, problem = choose_backend("cuda", 0)
    assert problem is None
    ends = [fit(start, photos, options, count, **more)[0] for more in ({"backend": backend}, {})]
    assert len(ends[0]) == len(ends[1]) == count
    assert scenes.psnr_of(ends[0], scene) == pytest.approx(scenes.psnr_of(ends[1], scene), abs=1.0)
    assert isinstance(ends[0].means, np.ndarray)
