"""The engine of a device: on torch's CPU device the same fit as with the kernels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
import torch
from gpu_runs import CPU, ON_TORCH, PULLS, QUICK, Pair, assert_close, gpu

from gsmerge import Gaussians, Scene
from gsmerge.fit import ON_CPU, FitJob, FitOptions, fit, full
from gsmerge.fit.fit_state import grow_to, start_state
from gsmerge.fit.full import fit_full
from gsmerge.fit.gpu import choose_backend
from gsmerge.fit.gpu import engine as device_engine
from gsmerge.fit.gpu.adam import download_state, upload_state
from gsmerge.fit.gpu.engine import make_backend
from gsmerge.fit.schedule import DROPOUT, PROBE, DrawMode, Step


@pytest.mark.parametrize("settings", [{}, {"ssim_lambda": 0.0}, {"half_res_share": 1.0}, {"opacity_reg": 3.0}], ids=str)
def test_runs_are_the_kernels(start: Gaussians, photos: Pair, settings: dict[str, Any]) -> None:
    """The same views, backgrounds and steps: a run that does something else is far away after eight."""
    constants = settings.keys() & {"ssim_lambda", "opacity_reg"}
    options = scenes.tuned(QUICK, **settings) if constants else replace(QUICK, **settings)
    actual, report = fit(start, FitJob(photos, options, seed=4), ON_TORCH)
    expected, other = fit(start, FitJob(photos, options, seed=4))
    assert_close(actual, expected, 1e-3)
    assert (report.method, report.accepted, report.steps) == (other.method, other.accepted, other.steps)
    assert report.holdout_before == pytest.approx(other.holdout_before, abs=1e-3)
    assert report.holdout_after == pytest.approx(other.holdout_after, abs=0.05)
    moved = fit(start, FitJob(photos, options, seed=5), ON_TORCH)[0]
    assert np.abs(moved.means - actual.means).max() > 1e-3


def test_runs_with_harmonics_are_the_kernels() -> None:
    scene, truth = scenes.self_made(1)
    start, photos = scenes.spoil(truth, seed=1), scenes.pair_of(scene)
    assert_close(fit(start, FitJob(photos, QUICK), ON_TORCH)[0], fit(start, FitJob(photos, QUICK))[0], 2e-3)


def test_long_run_grows_to_the_count(scene: Scene, start: Gaussians, photos: Pair) -> None:
    steps: list[int] = []
    options, count = replace(PULLS, fit_steps=150), len(start) + 20
    result, report = fit(start, FitJob(photos, options, count, progress=lambda step, *_: steps.append(step)), ON_TORCH)
    assert report.accepted
    assert len(result) == count
    assert steps == [20, 40, 60, 80, 100, 120, 140, 150]
    scenes.assert_invariants(result, scene)
    actual = [result, *(fit(start, FitJob(photos, options, count, seed=seed), ON_TORCH)[0] for seed in (1, 2))]
    expected = [fit(start, FitJob(photos, options, count, seed=seed))[0] for seed in range(3)]
    means = [np.mean([scenes.psnr_of(one, scene) for one in results]) for results in (actual, expected)]
    assert means[0] == pytest.approx(means[1], abs=0.5)


def test_dropout_and_budget(start: Gaussians, photos: Pair, scene: Scene) -> None:
    options = replace(QUICK, dropout=0.2, time_budget=0.5)
    result, report = fit(start, FitJob(photos, options), ON_TORCH)
    assert report.accepted
    assert report.steps > 6
    assert report.stopped == "time budget spent"
    assert scenes.psnr_of(result, scene) > scenes.psnr_of(start, scene) + 2


def test_clock_of_a_budget_starts_after_a_step(start: Gaussians, photos: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a copy, so that no state has moved and the PROBE steps are all timed."""
    events: list[str] = []
    step, states = device_engine._GpuEngine.step, []

    def note_step(self: Any, state: Any, drawn: Step) -> Any:
        events.append("step")
        states.append(state)
        return step(self, state, drawn)

    def note_time() -> float:
        events.append("clock")
        return float(len(events))

    monkeypatch.setattr(device_engine._GpuEngine, "step", note_step)
    monkeypatch.setattr(full.time, "perf_counter", note_time)
    fit(start, FitJob(photos, replace(QUICK, time_budget=1e-6)), ON_TORCH)
    assert events[: PROBE + 3] == ["step", "clock", *["step"] * PROBE, "clock"]
    assert states[0] is not states[1]
    assert states[1] is states[2]


def test_baseline_start_may_be_beaten_instead(start: Gaussians, photos: Pair) -> None:
    black = replace(start, sh0=np.full_like(start.sh0, -1.7))
    for other in (black, start):
        _, actual = fit(start, FitJob(photos, QUICK, baseline_start=other), ON_TORCH)
        _, expected = fit(start, FitJob(photos, QUICK, baseline_start=other))
        assert actual.holdout_before == pytest.approx(expected.holdout_before, abs=1e-3)


def test_growth_is_the_kernels(start: Gaussians, photos: Pair) -> None:
    state, count = start_state(start), len(start) + 30
    engines = [scenes.engine_for(photos, QUICK, backend=backend) for backend in (ON_TORCH, ON_CPU)]
    masses = [engine.error_masses(state) for engine in engines]
    np.testing.assert_allclose(masses[0], masses[1], rtol=1e-4, atol=1e-5)
    grown, other = (grow_to(state, engine.error_masses, count) for engine in engines)
    assert len(grown.x) == count
    np.testing.assert_allclose(grown.x, other.x, rtol=1e-4, atol=1e-5)


def test_states_come_back_as_they_were(start: Gaussians) -> None:
    state = start_state(start)
    there = upload_state(state, CPU)
    there.x += 0.5
    there.m += 0.25
    again = download_state(there)
    np.testing.assert_array_equal(again.x, state.x + np.float32(0.5))
    np.testing.assert_array_equal(again.m, state.m + np.float32(0.25))
    np.testing.assert_array_equal(again.splats.means, again.x[:, :3])
    for name in ("x0", "v", "units", "box_shares", "min_sizes", "origins", "fixed"):
        np.testing.assert_array_equal(getattr(again, name), getattr(state, name))


def test_engines_take_the_same_steps(start: Gaussians, photos: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """Views, backgrounds and what dropout leaves out, before and after growth; every view once before any again."""
    options, runs = FitOptions(fit_steps=320, judged=False), []
    for backend in (ON_CPU, ON_TORCH):
        engine = scenes.engine_for(photos, options, len(start) + 20, seed=3, backend=backend)
        taken: list[Step] = []
        monkeypatch.setattr(type(engine), "step", lambda self, state, step, taken=taken: taken.append(step) or 0.0)
        assert len(fit_full(start, engine)[0]) == len(start) + 20
        assert engine.plan.dropout == DROPOUT > 0
        runs.append(taken)
    assert len(runs[0]) == len(runs[1]) == 320
    for one, other in zip(*runs, strict=True):
        assert (one.number, one.progress, one.mode, one.view) == (other.number, other.progress, other.mode, other.view)
        np.testing.assert_array_equal(one.background, other.background)
        np.testing.assert_array_equal(one.kept, other.kept)
    assert (len(runs[0][0].kept), len(runs[0][-1].kept)) == (len(start), len(start) + 20)
    assert 0.8 < np.concatenate([step.kept for step in runs[0]]).mean() < 1
    views = [step.view for step in runs[0]]
    assert all(sorted(views[i : i + 3]) == [0, 1, 2] for i in range(0, 318, 3))


def test_all_of_a_step_is_on_the_device(start: Gaussians, photos: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """With tensors that have a device and no memory: mixing devices would fail. gsplat and autograd stand aside."""

    def drawn(shape: Any, colors: torch.Tensor, photos: Any, view: int, background: torch.Tensor, **_: Any) -> Any:
        assert background.is_meta
        reached = torch.ones(len(colors), dtype=torch.bool, device=colors.device)
        return colors.sum() * torch.ones(photos.height, photos.width, 3, device=colors.device), reached

    monkeypatch.setattr(device_engine, "draw_view", drawn)
    monkeypatch.setattr(torch.autograd, "grad", lambda image, leaves, wanted: [torch.empty_like(x) for x in leaves])
    engine = scenes.engine_for(photos, QUICK, backend=make_backend(torch.device("meta")))
    state, background = engine.start(start_state(start)), np.zeros(3, np.float32)
    for size in (0, 1):
        kept = np.ones(len(start), bool) if size else None
        assert engine.step(state, Step(1, 1.0, DrawMode(size, 0.3), 1, background, kept)).is_meta
    assert state.x.is_meta


@gpu
def test_gpu_reaches_the_same(scene: Scene, start: Gaussians, photos: Pair) -> None:
    options, count = replace(QUICK, fit_steps=160), len(start) + 20
    backend, problem = choose_backend("cuda", 0)
    assert problem is None
    ends = [fit(start, FitJob(photos, options, count), one)[0] for one in (backend, ON_CPU)]
    assert len(ends[0]) == len(ends[1]) == count
    assert scenes.psnr_of(ends[0], scene) == pytest.approx(scenes.psnr_of(ends[1], scene), abs=1.0)
    assert isinstance(ends[0].means, np.ndarray)
