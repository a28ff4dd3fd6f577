"""The full fit in torch: on the CPU the same run as with the kernels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
import scenes
import torch

from gsmerge import Gaussians, PixelScene
from gsmerge.render import cuda as cuda_module
from gsmerge.render.photos import Photos
from gsmerge.stages.fit import FitOptions, fit
from gsmerge.stages.fit import device as module
from gsmerge.stages.fit.device import image_loss, start_gpu, torch_engine
from gsmerge.stages.fit.full import KERNELS, Engine, fit_full, plan_run
from gsmerge.stages.fit.grow import grow_to
from gsmerge.stages.fit.loss import image_gradient
from gsmerge.stages.fit.options import LearningRates
from gsmerge.stages.fit.stage import engine_for
from gsmerge.stages.fit.state import State, start_state

Pair = tuple[Photos, Photos]
CPU = torch.device("cpu")
gpu = pytest.mark.skipif(
    not torch.cuda.is_available() or find_spec("gsplat") is None, reason="needs a CUDA device and gsplat"
)
PULLS = FitOptions(fit_steps=8, holdout=0.2)
# Without the pulls: where they are the whole gradient, Adam turns its last bit into a full step.
QUICK = replace(PULLS, opacity_reg=0.0, scale_reg=0.0)


@pytest.fixture(scope="module")
def scene() -> PixelScene:
    return scenes.self_made(0)[0]


@pytest.fixture(scope="module")
def truth() -> Gaussians:
    return scenes.self_made(0)[1]


@pytest.fixture(scope="module")
def start(truth: Gaussians) -> Gaussians:
    return scenes.spoil(truth, seed=1)


@pytest.fixture(scope="module")
def photos(scene: PixelScene) -> Pair:
    return scenes.pair_of(scene)


def run(gaussians: Gaussians, photos: Pair, options: FitOptions, engine: Engine, grown: int = 0) -> tuple[State, list]:
    """The state after all steps, without a judge, grown at half time, and the steps' errors."""
    rng, state, plan = np.random.default_rng(3), start_state(gaussians), plan_run(photos, options, 0)
    errors = []
    for step in range(options.fit_steps):
        if grown and step == options.fit_steps // 2:
            engine.sync(state)
            state = grow_to(state, photos[1], len(state.x) + grown)
        part = step / options.fit_steps
        errors.append(engine.step(state, plan, step % len(photos[0]), step + 1, part, rng))
    engine.sync(state)
    return state, errors


def assert_same_state(ours: State, expected: State) -> None:
    """Parameters to 1e-3, most of them far closer; what they mean to the rasterizer is up to date."""
    assert ours.x.shape == expected.x.shape
    moved = np.abs(expected.x - expected.x0).max(0)
    assert (moved > 0.01).all()
    np.testing.assert_allclose(ours.x, expected.x, atol=1e-3)
    assert np.median(np.abs(ours.x - expected.x)) < 1e-5
    assert np.linalg.norm(ours.m - expected.m) <= 1e-3 * np.linalg.norm(expected.m)
    assert np.linalg.norm(ours.v - expected.v) <= 1e-3 * np.linalg.norm(expected.v)
    for name in ("means", "quats", "scales", "opacities"):
        np.testing.assert_allclose(getattr(ours.splats, name), getattr(expected.splats, name), rtol=1e-3, atol=1e-3)
    np.testing.assert_array_equal(ours.colors, ours.x[:, 11:])


def two_of_three(truth: Gaussians, check: Callable[[Gaussians], None]) -> None:
    """A weight on the other side of 1/255 parts two runs in one start of ten, in which depends on the processor."""
    failures = []
    for seed in (1, 2, 3):
        if seed < 3 or failures:
            try:
                check(scenes.spoil(truth, seed=seed))
            except AssertionError as failure:
                failures.append(failure)
    assert len(failures) < 2, failures


@pytest.mark.parametrize(
    "settings", [{}, {"dropout": 0.2}, {"ssim_lambda": 0.0}, {"half_res_share": 0.0}, {"half_res_share": 1.0}], ids=str
)
def test_steps_are_the_kernels(truth: Gaussians, photos: Pair, settings: dict[str, Any]) -> None:
    options = replace(QUICK, **settings)

    def check(start: Gaussians) -> None:
        (ours, errors), (expected, others) = (run(start, photos, options, e) for e in (torch_engine(CPU), KERNELS))
        assert_same_state(ours, expected)
        assert errors == pytest.approx(others, rel=1e-4)

    two_of_three(truth, check)


@pytest.mark.parametrize("pulls", [{"opacity_reg": 3.0}, {"scale_reg": 3.0}, {}], ids=str)
def test_pulls_are_the_kernels(start: Gaussians, photos: Pair, pulls: dict[str, float]) -> None:
    """By the moments of one step, which are its gradient."""
    one = replace(PULLS if not pulls else QUICK, fit_steps=1, **pulls)
    (ours, _), (expected, _), (without, _) = (
        run(start, photos, options, engine)
        for options, engine in ((one, torch_engine(CPU)), (one, KERNELS), (replace(QUICK, fit_steps=1), KERNELS))
    )
    assert np.linalg.norm(ours.m - expected.m) <= 1e-4 * np.linalg.norm(expected.m)
    assert np.linalg.norm(without.m - expected.m) > 1e-3 * np.linalg.norm(expected.m)


@pytest.mark.parametrize("degree", [1, 3])
def test_steps_are_the_kernels_with_harmonics(degree: int) -> None:
    scene, truth = scenes.self_made(degree)
    photos = scenes.pair_of(scene)

    def check(start: Gaussians) -> None:
        ours, expected = (run(start, photos, QUICK, e)[0] for e in (torch_engine(CPU), KERNELS))
        assert_same_state(ours, expected)
        np.testing.assert_array_equal(ours.splats.shN, expected.splats.shN)

    two_of_three(truth, check)


def test_growth_goes_on_from_the_tensors(truth: Gaussians, photos: Pair) -> None:
    def check(start: Gaussians) -> None:
        ours, expected = (run(start, photos, QUICK, e, grown=30)[0] for e in (torch_engine(CPU), KERNELS))
        assert len(ours.x) == len(start) + 30
        assert_same_state(ours, expected)

    two_of_three(truth, check)


def test_box_is_the_kernels(start: Gaussians, photos: Pair) -> None:
    """Everything at its border, colours beyond the range, a quaternion of length zero."""
    rates = LearningRates(
        means_lr=3.0,
        scales_lr=3.0,
        opacities_lr=5.0,
        colors_lr=1.0,
        max_mean_shift=0.2,
        max_scale_change=0.1,
        max_opacity_change=0.3,
    )
    options = replace(QUICK, fit_steps=3, rates=rates)
    odd = replace(start, sh0=start.sh0.copy(), quats=start.quats.copy())
    odd.sh0[:60], odd.quats[60:63] = 4.0, 0.0
    ours, expected = (run(odd, photos, options, e)[0] for e in (torch_engine(CPU), KERNELS))
    np.testing.assert_allclose(ours.x, expected.x, atol=1e-3)
    reached = np.abs(ours.x - ours.x0)[:, 3:6].max(1)
    assert np.isclose(reached, 0.1, atol=1e-5).mean() > 0.5
    assert ours.x[:, 11:].max() > 1.05
    assert np.isfinite(ours.x).all()


def test_run_reaches_the_same(scene: PixelScene, start: Gaussians, photos: Pair) -> None:
    """The median of three, since a weight on the other side of 1/255 may tell two runs apart."""
    options, gaps = replace(QUICK, fit_steps=40), []
    for seed in range(3):
        (ours, report), (expected, other) = (
            fit_full(start, photos, options, seed=seed, engine=engine) for engine in (torch_engine(CPU), KERNELS)
        )
        assert (report.method, report.accepted, report.steps) == (other.method, other.accepted, other.steps)
        assert report.holdout_before == other.holdout_before
        assert report.holdout_after > report.holdout_before + 3
        scenes.assert_invariants(ours, scene)
        gaps.append(abs(scenes.psnr_of(ours, scene) - scenes.psnr_of(expected, scene)))
    assert np.median(gaps) < 0.1
    assert max(gaps) < 1.0


def test_long_run_grows_to_the_count(scene: PixelScene, start: Gaussians, photos: Pair) -> None:
    options = replace(QUICK, fit_steps=160)
    result, report = fit_full(start, photos, options, count=len(start) + 20, engine=torch_engine(CPU))
    assert report.accepted
    assert len(result) == len(start) + 20
    assert scenes.psnr_of(result, scene) > scenes.psnr_of(start, scene) + 6


@pytest.mark.parametrize("size", [(20, 17), (7, 7), (3, 5), (1, 9)])
@pytest.mark.parametrize("ssim_lambda", [0.0, 0.2, 1.0])
def test_loss_is_the_kernels(size: tuple[int, int], ssim_lambda: float) -> None:
    rng = np.random.default_rng(0)
    photo = rng.uniform(0, 1, (*size, 3)).astype(np.float32)
    image = photo + 0.2 * rng.normal(size=photo.shape).astype(np.float32)
    weight = (rng.random(size) > 0.2).astype(np.float32)
    variable = torch.from_numpy(image).requires_grad_()
    image_loss(variable, torch.from_numpy(photo), torch.from_numpy(weight), ssim_lambda).backward()
    expected, _ = image_gradient(image, photo, weight, ssim_lambda)
    assert variable.grad is not None
    assert np.linalg.norm(variable.grad.numpy() - expected) <= 1e-3 * np.linalg.norm(expected)


def test_nothing_to_fit(start: Gaussians, photos: Pair) -> None:
    result, _ = fit_full(start[:0], photos, QUICK, engine=torch_engine(CPU))
    assert len(result) == 0


def test_input_is_left_alone(start: Gaussians, photos: Pair) -> None:
    before = [getattr(start, name).copy() for name in scenes.FIELDS]
    fit_full(start, photos, QUICK, engine=torch_engine(CPU))
    assert all(np.array_equal(getattr(start, n), b) for n, b in zip(scenes.FIELDS, before, strict=True))


def test_stage_steps_where_it_is_told(start: Gaussians, photos: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """On ``"cuda"`` in torch: here with everything that the GPU would do done by the CPU."""
    asked: list[str] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda_module, "find_spec", lambda name: name)
    monkeypatch.setattr(module, "start_gpu", lambda device: asked.append(f"start {device}"))
    monkeypatch.setattr(module, "torch_engine", lambda device: asked.append(str(device)) or torch_engine(CPU))
    ours, report = fit(start, photos, replace(QUICK, device="cuda"), seed=4)
    assert asked == ["start cuda", "cuda"]
    assert report is not None
    assert report.accepted
    expected, _ = fit(start, photos, QUICK, seed=4)
    assert len(asked) == 2
    np.testing.assert_allclose(ours.means, expected.means, rtol=1e-3, atol=1e-3)
    assert engine_for("cpu") is KERNELS


def test_starting_draws_and_differentiates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where gradients are off, as they are within a run."""
    drawn: list[torch.Tensor] = []
    draw = module.draw_colored
    monkeypatch.setattr(module, "draw_colored", lambda *args: drawn.append(draw(*args)[0]) or draw(*args))
    with torch.no_grad():
        start_gpu(CPU)
    assert drawn[0].requires_grad
    assert float(drawn[0].detach().max()) > 0.1


def test_all_of_a_step_is_on_the_device(start: Gaussians, photos: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """With tensors that have a device and no memory: mixing devices would fail. gsplat and autograd stand aside."""
    monkeypatch.setattr(module, "draw_colored", lambda shape, colors, camera, background: drawn(colors, camera))
    monkeypatch.setattr(module, "mean_error", lambda image, photo, weight: str((image - photo).device))
    monkeypatch.setattr(torch.autograd, "grad", lambda loss, leaves: [torch.empty_like(leaf) for leaf in leaves])

    def drawn(colors: torch.Tensor, camera: dict[str, Any]) -> tuple[torch.Tensor, torch.Tensor]:
        image = colors.sum() * torch.ones(camera["height"], camera["width"], 3, device=colors.device)
        return image, torch.ones(len(colors), dtype=torch.bool, device=colors.device)

    plan = plan_run(photos, replace(QUICK, dropout=0.2), 0)
    tensors = module.upload(start_state(start), torch.device("meta"))
    for progress in (0.0, 0.9):
        assert module.torch_step(tensors, plan, 1, 1, progress, np.random.default_rng(0)) == "meta"
    assert tensors.x.is_meta


@gpu
def test_gpu_reaches_the_same(scene: PixelScene, start: Gaussians, photos: Pair) -> None:
    options = replace(QUICK, fit_steps=160)
    ends = [fit(start, photos, replace(options, device=name), len(start) + 20)[0] for name in ("cuda", "cpu")]
    assert len(ends[0]) == len(ends[1]) == len(start) + 20
    assert scenes.psnr_of(ends[0], scene) == pytest.approx(scenes.psnr_of(ends[1], scene), abs=1.0)
    assert all(end.device is None for end in ends)
