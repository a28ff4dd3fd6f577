"""The fit on a device: on torch's CPU device the same run as with the kernels."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
import torch
from step_states import gradients_of, odd_state

from gsmerge import Gaussians, PixelScene
from gsmerge.gpu import full as gpu_full
from gsmerge.gpu.adam import adam_step
from gsmerge.gpu.fit import ON_DEVICE, fit_gaussians, visible_mask
from gsmerge.gpu.grow import error_masses, grow_to
from gsmerge.gpu.holdout import exposure_gains, holdout_psnr
from gsmerge.gpu.loss import loss_gradient, photo_means
from gsmerge.gpu.scene import upload_gaussians, upload_photos
from gsmerge.gpu.score import photo_error, photo_psnr
from gsmerge.kernels.gaussians import optimise
from gsmerge.render import photos as render_photos
from gsmerge.render.photos import Photos
from gsmerge.stages.fit import FitOptions, fit, stage
from gsmerge.stages.fit import full as stage_full
from gsmerge.stages.fit import grow as stage_grow
from gsmerge.stages.fit import holdout as stage_holdout
from gsmerge.stages.fit.full import step_sizes
from gsmerge.stages.fit.loss import image_gradient
from gsmerge.stages.fit.options import LearningRates
from gsmerge.stages.fit.state import start_state

Pair = tuple[Photos, Photos]
CPU = torch.device("cpu")
ROOT = Path(__file__).resolve().parents[3]
gpu = pytest.mark.skipif(
    not torch.cuda.is_available() or find_spec("gsplat") is None, reason="needs a CUDA device and gsplat"
)
# A long memory: with a short one a difference in the last bit is a full step sooner.
PULLS = FitOptions(fit_steps=8, holdout=0.2, rates=LearningRates(beta1=0.7, beta2=0.99))
# Without the pulls: where they are the whole gradient, Adam turns its last bit into a full step.
QUICK = replace(PULLS, opacity_reg=0.0, scale_reg=0.0)


@pytest.fixture(scope="module")
def scene() -> PixelScene:
    return scenes.self_made(0)[0]


@pytest.fixture(scope="module")
def start() -> Gaussians:
    return scenes.spoil(scenes.self_made(0)[1], seed=1)


@pytest.fixture(scope="module")
def photos(scene: PixelScene) -> Pair:
    return scenes.pair_of(scene)


def on_device(photos: Pair) -> Any:
    return upload_photos(photos[0], CPU), upload_photos(photos[1], CPU)


def close(ours: Gaussians, expected: Gaussians, atol: float) -> None:
    """All but one number in a hundred: Adam makes a step of a gradient's sign, of whatever size that gradient is."""
    assert len(ours) == len(expected)
    for name in scenes.FIELDS:
        a, b = (getattr(gaussians, name) for gaussians in (ours, expected))
        assert (np.abs(a - b) > atol + 1e-3 * np.abs(b)).sum() <= 0.01 * a.size, name
        np.testing.assert_allclose(a, b, atol=10 * atol, rtol=1e-2, err_msg=name)


@pytest.mark.parametrize("settings", [{}, {"ssim_lambda": 0.0}, {"half_res_share": 1.0}, {"opacity_reg": 3.0}], ids=str)
def test_runs_are_the_kernels(start: Gaussians, photos: Pair, settings: dict[str, Any]) -> None:
    """The same views, backgrounds and steps: a run that does something else is far away after eight."""
    options = replace(QUICK, **settings)
    ours, report = fit_gaussians(start, photos, options, seed=4, device=CPU)
    expected, other = fit(start, photos, options, seed=4)
    close(ours, expected, 1e-3)
    assert report is not None
    assert other is not None
    assert (report.method, report.accepted, report.steps) == (other.method, other.accepted, other.steps)
    assert report.holdout_before == pytest.approx(other.holdout_before, abs=1e-3)
    assert report.holdout_after == pytest.approx(other.holdout_after, abs=0.05)
    moved = fit_gaussians(start, photos, options, seed=5, device=CPU)[0]
    assert np.abs(moved.means - ours.means).max() > 1e-3


def test_runs_with_harmonics_are_the_kernels() -> None:
    scene, truth = scenes.self_made(1)
    start, photos = scenes.spoil(truth, seed=1), scenes.pair_of(scene)
    close(fit_gaussians(start, photos, QUICK, device=CPU)[0], fit(start, photos, QUICK)[0], 2e-3)


def test_long_run_grows_to_the_count(scene: PixelScene, start: Gaussians, photos: Pair) -> None:
    steps: list[int] = []
    options = replace(PULLS, fit_steps=150)
    result, report = fit_gaussians(
        start, photos, options, len(start) + 20, progress=lambda step, *_: steps.append(step), device=CPU
    )
    assert report is not None
    assert report.accepted
    assert len(result) == len(start) + 20
    assert steps == [20, 40, 60, 80, 100, 120, 140, 150]
    scenes.assert_invariants(result, scene)
    ours = [result, *(fit_gaussians(start, photos, options, len(start) + 20, s, device=CPU)[0] for s in (1, 2))]
    others = [fit(start, photos, options, len(start) + 20, s)[0] for s in range(3)]
    means = [np.mean([scenes.psnr_of(one, scene) for one in results]) for results in (ours, others)]
    assert means[0] == pytest.approx(means[1], abs=0.5)


def test_dropout_and_budget(start: Gaussians, photos: Pair, scene: PixelScene) -> None:
    options = replace(QUICK, dropout=0.2, time_budget=0.5)
    result, report = fit_gaussians(start, photos, options, device=CPU)
    assert report is not None
    assert report.accepted
    assert report.steps > 6
    assert report.stopped == "time budget spent"
    assert scenes.psnr_of(result, scene) > scenes.psnr_of(start, scene) + 2


def test_colors_are_the_kernels(start: Gaussians, photos: Pair) -> None:
    ours, report = ON_DEVICE.fit_colors(start.to("cpu"), upload_photos(photos[1], CPU), FitOptions(), 0)
    expected, other = stage.ON_CPU.fit_colors(start, photos[1], FitOptions(), 0)
    assert report.accepted
    close(ours.numpy(), expected, 1e-4)
    assert report.holdout_after == pytest.approx(other.holdout_after, abs=1e-4)


def test_a_fit_that_fails_falls_back(start: Gaussians, photos: Pair) -> None:
    """Photos of noise: nothing that is learnt of one block holds in another. The numbers are those of the CPU."""
    noise = scenes.noise_for(photos)
    grey = replace(start, sh0=np.zeros_like(start.sh0))
    for steps in (8, 150):
        options = replace(QUICK, fit_steps=steps)
        (ours, report), (expected, other) = (
            fit_gaussians(grey, noise, options, len(grey) + 9, device=CPU),
            fit(grey, noise, options, len(grey) + 9),
        )
        assert report is not None
        assert other is not None
        assert (report.method, report.stopped) == (other.method, other.stopped)
        assert len(ours) == len(expected)


def test_nothing_is_fitted_where_nothing_is_asked_for(start: Gaussians, photos: Pair) -> None:
    tensors = upload_gaussians(start, CPU)
    same, report = stage.fit_with(ON_DEVICE, tensors, on_device(photos), replace(QUICK, fit="none", effort="draft"))
    assert same is tensors
    assert report is None
    few, _ = fit_gaussians(start[:0], photos, QUICK, device=CPU)
    assert len(few) == 0


def test_a_baseline_start_may_be_beaten_instead(start: Gaussians, photos: Pair) -> None:
    black = replace(start, sh0=np.full_like(start.sh0, -1.7))
    for other in (black, start):
        reports = [
            fit_gaussians(start, photos, QUICK, baseline_start=other, device=CPU)[1],
            fit(start, photos, QUICK, baseline_start=other)[1],
        ]
        assert reports[0] is not None
        assert reports[1] is not None
        assert reports[0].holdout_before == pytest.approx(reports[1].holdout_before, abs=1e-3)


def test_what_no_photo_shows_is_left_out(start: Gaussians, photos: Pair) -> None:
    opacities = start.opacities.copy()
    opacities[::5] = 0.0045
    faint = replace(start, opacities=opacities)
    ours = visible_mask(upload_gaussians(faint, CPU), on_device(photos)[1], 1 / 255)
    np.testing.assert_array_equal(ours, stage.visible_mask(faint, photos[1], 1 / 255))
    assert 0 < int(ours.sum()) < len(faint)


@pytest.mark.parametrize("size", [(20, 17), (7, 7), (3, 5), (1, 9)])
@pytest.mark.parametrize("ssim_lambda", [0.0, 0.2, 1.0])
def test_loss_is_the_kernels(size: tuple[int, int], ssim_lambda: float) -> None:
    rng = np.random.default_rng(0)
    photo = rng.uniform(0, 1, (*size, 3)).astype(np.float32)
    image = photo + 0.2 * rng.normal(size=photo.shape).astype(np.float32)
    weight = (rng.random(size) > 0.2).astype(np.float32)
    tensors = [torch.from_numpy(array) for array in (image, photo, weight)]
    means = photo_means(tensors[1][None])
    ours, error = loss_gradient(*tensors[:2], (means.first[0], means.square[0]), tensors[2], ssim_lambda)
    expected, squares = image_gradient(image, photo, weight, ssim_lambda)
    assert np.linalg.norm(ours.numpy() - expected) <= 1e-3 * np.linalg.norm(expected)
    assert float(error) == pytest.approx(squares, rel=1e-5)


@pytest.mark.parametrize("step", [1, 7])
def test_step_is_the_kernels(step: int) -> None:
    """Everything at its border, colours beyond the range, a quaternion of length zero, Gaussians without a gradient."""
    state, options = odd_state(300)
    gradients = gradients_of(state)
    arrays = [
        getattr(state, name).clone().numpy() for name in ("x", "x0", "m", "v", "units", "box_shares", "min_sizes")
    ]
    ids = np.flatnonzero(gradients.reached.numpy()).astype(np.int32)
    g = [getattr(gradients, name).numpy()[ids] for name in ("means", "quats", "scales", "opacities", "colors")]
    g[3] += np.float32(options.opacity_reg / 300)
    g[2] += np.float32(options.scale_reg / 300) / arrays[4][ids, None]
    rates = step_sizes(options.rates, 0.3, 8)
    limits = options.rates.max_mean_shift, options.rates.max_scale_change, options.rates.max_opacity_change
    names = ("means", "quats", "scales", "opacities", "colors")
    shown = [getattr(state, name).clone().numpy() for name in names]
    optimise.adam(
        *arrays, ids, *g, rates, np.array(limits, np.float32),
        np.array([options.rates.beta1, options.rates.beta2], np.float32), step, 0, len(ids), *shown,
    )  # fmt: skip
    adam_step(state, gradients, options, torch.from_numpy(rates), step)
    assert (np.abs(arrays[0] - arrays[1]) > 0.01).any(1)[ids].mean() > 0.9
    for name, expected in zip(("x", "m", "v", *names), [arrays[0], *arrays[2:4], *shown], strict=True):
        np.testing.assert_allclose(getattr(state, name), expected, rtol=2e-4, atol=2e-6, err_msg=name)


@pytest.mark.skipif(find_spec("triton") is None, reason="needs Triton, which CUDA builds of torch bring")
def test_triton_step_is_the_one_in_torch() -> None:
    """In Triton's interpreter, which has to be asked for before Triton is imported."""
    paths = [str(ROOT), str(ROOT / "tests" / "unit" / "gpu"), *sys.path]
    environment = {**os.environ, "TRITON_INTERPRET": "1", "PYTHONPATH": os.pathsep.join(paths)}
    code = "import step_states; step_states.compare_triton()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert "same" in done.stdout


def test_growth_is_the_stages(start: Gaussians, photos: Pair) -> None:
    ours, expected = gpu_full.start_state(upload_gaussians(start, CPU)), start_state(start)
    half = on_device(photos)[1]
    np.testing.assert_allclose(
        error_masses(ours, half), stage_grow.error_masses(expected, photos[1]), rtol=1e-4, atol=1e-5
    )
    ours.m += 0.5
    expected.m += 0.5
    ours.min_sizes[:], expected.min_sizes[:] = -3, -3
    grown, theirs = grow_to(ours, half, len(start) + 30), stage_grow.grow_to(expected, photos[1], len(start) + 30)
    for name in ("x", "x0", "m", "units", "box_shares", "min_sizes"):
        np.testing.assert_allclose(getattr(grown, name), getattr(theirs, name), rtol=1e-4, atol=1e-5, err_msg=name)
    for name in ("means", "quats", "scales", "opacities"):
        np.testing.assert_allclose(getattr(grown, name), getattr(theirs.splats, name), rtol=1e-4, atol=1e-5)


def test_exposures_and_held_out_blocks_are_the_stages(photos: Pair) -> None:
    rng = np.random.default_rng(0)
    images = (photos[1].images * np.array([1.5, 1.0, 0.9])[:, None, None, None]).astype(np.float32)
    images += rng.normal(size=images.shape).astype(np.float32) * 0.05
    weights = stage_holdout.training_weights(photos[1], 0.3, 0)
    tensors = [torch.from_numpy(array) for array in (images, photos[1].images, np.stack(weights))]
    for min_gain in (1.15, 3.0):
        expected = stage_holdout.exposure_gains(list(images), photos[1].images, weights, min_gain)
        np.testing.assert_allclose(exposure_gains(*tensors, min_gain), expected, rtol=1e-5)
        score = stage_holdout.holdout_psnr(list(images), photos[1], weights, min_gain)
        assert holdout_psnr(*tensors, min_gain) == pytest.approx(score, abs=1e-4)


def test_schedule_is_the_runs(photos: Pair, monkeypatch: pytest.MonkeyPatch, start: Gaussians) -> None:
    """Every view once before any comes again, in the order of the CPU's run."""
    taken: list[int] = []
    step = stage_full.fit_step
    monkeypatch.setattr(stage_full, "fit_step", lambda *args: taken.append(args[2]) or step(*args))
    stage_full.fit_full(start, photos, replace(QUICK, half_res_share=1.0), seed=3)
    schedule = gpu_full.draw_schedule(3, 3, 8, CPU)
    assert schedule.views == taken
    assert sorted(schedule.views[:3]) == [0, 1, 2]


def test_scores_are_the_renderers(start: Gaussians, scene: PixelScene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render_photos, "BLOCK", 1)  # so that these small views are divided, too
    wide = scenes.make_scene(scenes.room(), scenes.arc(2, 72, 66))
    full = render_photos.scene_photos(wide)
    tensors, resident = upload_gaussians(start, CPU), upload_photos(full, CPU)
    assert render_photos.scored_tiles(0, 72, 66) is not None
    assert photo_psnr(tensors, resident, [0, 1], quarter=True) == pytest.approx(
        render_photos.photo_psnr(start, full, [0, 1], quarter=True), abs=1e-4
    )
    assert photo_psnr(tensors, resident, [1], quarter=False) == pytest.approx(
        render_photos.photo_psnr(start, full, [1]), abs=1e-4
    )
    assert photo_error(tensors, resident) == pytest.approx(stage.photo_error(start, full), rel=1e-4)


def test_all_of_a_step_is_on_the_device(start: Gaussians, photos: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """With tensors that have a device and no memory: mixing devices would fail. gsplat and autograd stand aside."""

    def drawn(shape: Any, colors: torch.Tensor, photos: Any, view: int, background: torch.Tensor, **_: Any) -> Any:
        assert background.is_meta
        reached = torch.ones(len(colors), dtype=torch.bool, device=colors.device)
        return colors.sum() * torch.ones(photos.height, photos.width, 3, device=colors.device), reached

    monkeypatch.setattr(gpu_full, "draw", drawn)
    monkeypatch.setattr(torch.autograd, "grad", lambda image, leaves, wanted: [torch.empty_like(x) for x in leaves])
    meta = torch.device("meta")
    state = gpu_full.start_state(start.to(meta))
    plan = stage_full.plan_run(photos, QUICK, 0)
    levels = gpu_full.make_levels((upload_photos(photos[0], meta), upload_photos(photos[1], meta)), plan, meta)
    schedule = gpu_full.draw_schedule(0, 3, 8, meta)
    for level in levels:
        gradients, error = gpu_full.take_step(state, level, 1, schedule.backgrounds[0], None, QUICK, {})
        adam_step(state, gradients, QUICK, torch.empty(14, device=meta), 1)
        assert error.is_meta
    assert state.x.is_meta


@gpu
def test_gpu_reaches_the_same(scene: PixelScene, start: Gaussians, photos: Pair) -> None:
    options = replace(QUICK, fit_steps=160)
    ends = [fit(start, photos, replace(options, device=name), len(start) + 20)[0] for name in ("cuda", "cpu")]
    assert len(ends[0]) == len(ends[1]) == len(start) + 20
    assert scenes.psnr_of(ends[0], scene) == pytest.approx(scenes.psnr_of(ends[1], scene), abs=1.0)
    assert isinstance(ends[0].means, np.ndarray)


@gpu
def test_gpu_step_and_colors_are_the_cpus(start: Gaussians, photos: Pair) -> None:
    cuda = torch.device("cuda")
    colored, _ = ON_DEVICE.fit_colors(upload_gaussians(start, cuda), upload_photos(photos[1], cuda), FitOptions(), 0)
    close(colored.numpy(), stage.ON_CPU.fit_colors(start, photos[1], FitOptions(), 0)[0], 0.05)
    masks = [
        visible_mask(upload_gaussians(start, device), upload_photos(photos[1], device), 1 / 255).cpu()
        for device in (cuda, CPU)
    ]
    assert (masks[0] == masks[1]).float().mean() > 0.99
    state, options = odd_state(300)
    other = odd_state(300, cuda)[0]
    for one in (state, other):
        rates = torch.from_numpy(step_sizes(options.rates, 0.3, 8)).to(one.x.device)
        adam_step(one, gradients_of(one), options, rates, 1)
    torch.testing.assert_close(other.x.cpu(), state.x, rtol=1e-4, atol=1e-5)
