"""The self-check passes what is right and tells what is not: on the CPU, with the tests' stand-in for gsplat."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from fake_gsplat import install
from gpu_runs import CPU, gpu
from torch import Tensor

from gsmerge.fit.gpu import self_check
from gsmerge.fit.gpu.self_check import MAX_ERRORS, find_difference, make_scene, measure_errors
from gsmerge.raster import contributions, plan_view, prepare


def test_right_results_pass(fake_gsplat: Any) -> None:
    """With a wide margin: it is for the last digits of other hardware."""
    assert find_difference(CPU) is None
    errors = measure_errors(CPU)
    assert errors.keys() == MAX_ERRORS.keys()
    assert all(errors[name] < 0.2 * most for name, most in MAX_ERRORS.items()), errors


def test_margins_hold_weights_beside_the_cut(fake_gsplat: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Opacities off by a thousandth move many more weights over the cut than a fast exponential does (2e-6)."""
    draw = sys.modules["gsplat"].rasterization

    def draw_otherwise(**given: Any) -> Any:
        return draw(**{**given, "opacities": given["opacities"] * 1.001})

    monkeypatch.setattr(sys.modules["gsplat"], "rasterization", draw_otherwise)
    assert find_difference(CPU) is None


def test_neither_clamp_matters_to_the_gaussians_of_the_check() -> None:
    gaussians, photos = make_scene()
    assert (len(gaussians), gaussians.sh_degree) == (64, 1)
    assert gaussians.opacities.max() < 0.9
    plan = plan_view(prepare(gaussians), **photos.camera(0))
    _, peaks = contributions(plan)
    assert (peaks > 0.02).sum() > 50  # most of them are seen
    assert len(plan.ids) == 60  # some lie behind the camera


def change(module: Any, name: str, result: Callable[[Any], Any]) -> Callable[..., Any]:
    """A function of the stand-in whose result is changed."""
    function = getattr(module, name)
    return lambda *arguments, **named: result(function(*arguments, **named))


def scaled_gradient(draw: Callable[..., Any], name: str, factor: float) -> Callable[..., Any]:
    """Draws the same; the gradients of one input are multiplied."""

    def draw_otherwise(**given: Any) -> Any:
        tensor = given[name].clone()
        if tensor.requires_grad:
            tensor.register_hook(lambda gradient: factor * gradient)
        return draw(**{**given, name: tensor})

    return draw_otherwise


def without_some(details: dict[str, Any]) -> dict[str, Any]:
    """Every third Gaussian has no footprint."""
    radii = details["radii"].clone()
    radii[:, ::3] = 0
    return {**details, "radii": radii}


@pytest.mark.parametrize(
    ("part", "spoilt"),
    [
        ("image", lambda gsplat: {"rasterization": change(gsplat, "rasterization", lambda r: (1.02 * r[0], *r[1:]))}),
        ("image", lambda gsplat: {"rasterization": change(gsplat, "rasterization", lambda r: (nan_at(r[0]), *r[1:]))}),
        *(
            ("gradients", lambda gsplat, at=at: {"rasterization": scaled_gradient(gsplat.rasterization, *at)})
            for at in (("means", 2), ("quats", 2), ("scales", -1), ("opacities", 0), ("colors", torch.nan))
        ),
        (
            "gradients",
            lambda gsplat: {"rasterization": change(gsplat, "rasterization", lambda r: (*r[:2], without_some(r[2])))},
        ),
        (
            "blending weights",
            lambda gsplat: {
                "rasterize_to_indices_in_range": change(
                    gsplat, "rasterize_to_indices_in_range", lambda r: (r[0].flip(0), r[1].flip(0), r[2])
                )
            },
        ),
        ("harmonics", lambda gsplat: {"spherical_harmonics": change(gsplat, "spherical_harmonics", lambda r: -r)}),
    ],
)
def test_wrong_results_are_told(
    part: str, spoilt: Callable[[Any], dict[str, Any]], fake_gsplat: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, function in spoilt(sys.modules["gsplat"]).items():
        monkeypatch.setattr(sys.modules["gsplat"], name, function)
    problem = find_difference(CPU)
    assert problem.startswith(f"in the self-check of CUDA the {part} differed from the CPU's by ")


def nan_at(images: Tensor) -> Tensor:
    """With a pixel that is not a number."""
    pixel = torch.zeros_like(images)
    pixel[0, 3, 4, 1] = torch.nan
    return images + pixel


def test_wrong_steps_are_told(fake_gsplat: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def step_otherwise(state: Any, gradients: Any, options: Any, rates: Tensor, step: int) -> None:
        self_check.step_in_torch(
            state, gradients, replace(options, tuning=replace(options.tuning, opacity_reg=1.0)), 1.1 * rates, step
        )

    monkeypatch.setattr(self_check, "adam_step", step_otherwise)
    assert "the optimiser step differed from the CPU's by " in (find_difference(CPU) or "")


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 MiB."), "OutOfMemoryError: CUDA out of"),
        (AttributeError("'NoneType' object has no attribute 'CameraModelType'"), "AttributeError: 'NoneType' object"),
        (TypeError("spherical_harmonics() missing 1 required argument"), "TypeError: spherical_harmonics"),
        (
            RuntimeError("CUDA error: no kernel image is available\nCompile with X"),
            "CUDA error: no kernel image",
        ),
        (AssertionError(), "AssertionError"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_exceptions_are_told_in_one_line(
    error: Exception, text: str, fake_gsplat: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> Any:
        raise error

    for name in ("rasterization", "spherical_harmonics"):
        monkeypatch.setattr(sys.modules["gsplat"], name, fail)
        problem = find_difference(CPU)
        assert problem.startswith("the self-check of CUDA ended with ")
        assert text in problem
        assert "\n" not in problem


def test_gsplat_without_its_compiled_part_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, compiled=None)
    assert "gsplat has no compiled part" in (find_difference(CPU) or "")


@gpu
def test_errors_of_a_gpu_are_small() -> None:
    errors = measure_errors(torch.device("cuda"))
    assert all(np.isfinite(error) and error < 0.5 * MAX_ERRORS[name] for name, error in errors.items()), errors
