"""The array interface: against autograd through the slow renderer, finite differences, threads, hostile input."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from reference_gradients import BACKGROUND, HEIGHT, WIDTH, random_gaussians, turned_cameras
from renderer import render_reference, view_colors

from gsmerge import Gaussians
from gsmerge.render import ViewPlan, composite, plan_view, prepare
from gsmerge.render.gradient import (
    Gradients,
    color_gradients,
    plan_gradients,
)
from gsmerge.runtime.threads import use_threads

FIELDS = ("means", "quats", "scales", "opacities", "colors")


def plan_of(gaussians: Gaussians, **options: Any) -> ViewPlan:
    cameras = turned_cameras(1).numpy()
    return plan_view(prepare(gaussians), cameras.viewmats[0], cameras.Ks[0], cameras.width, cameras.height, **options)


def normal(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def gradients_of_plan(plan: ViewPlan, colors: np.ndarray, grad_left: np.ndarray | None) -> Gradients:
    image, transmittance = composite(plan, colors, BACKGROUND)
    return plan_gradients(
        plan, normal(HEIGHT, WIDTH, 3), grad_left,
        image=image, transmittance=transmittance, colors=colors, with_viewmat=True,
    )  # fmt: skip


def full(gradients: Any, name: str, n: int) -> np.ndarray:
    rows = getattr(gradients, name)
    array = np.zeros((n, *rows.shape[1:]))
    array[gradients.ids] = rows
    return array


def assert_near(actual: np.ndarray, expected: np.ndarray, most: float = 1e-3) -> None:
    assert np.isfinite(actual).all()
    assert np.linalg.norm(actual - expected) <= most * np.linalg.norm(expected) + 1e-9


@pytest.mark.parametrize("eps2d", [0.075, 0.3, 1.0])
@pytest.mark.parametrize("with_left", [False, True])
def test_any_colours_dilations_and_transmittances(eps2d: float, with_left: bool) -> None:
    gaussians, cameras, colors = random_gaussians(40, 0, 1), turned_cameras(1), normal(40, 3, seed=2)
    grad_left = normal(HEIGHT, WIDTH, seed=3) if with_left else None
    actual = gradients_of_plan(plan_of(gaussians, eps2d=eps2d), colors, grad_left)
    names = ("means", "quats", "scales", "opacities")
    inputs = [getattr(gaussians, name).double() for name in names] + [torch.from_numpy(colors).double()]
    inputs = [tensor.requires_grad_() for tensor in [*inputs, cameras.viewmats[0].clone()]]
    drawn = render_reference(*inputs, cameras.Ks[0], WIDTH, HEIGHT, background=BACKGROUND, eps2d=eps2d)
    loss = (drawn.image * torch.from_numpy(normal(HEIGHT, WIDTH, 3))).sum()
    if grad_left is not None:
        loss = loss + (drawn.transmittance * torch.from_numpy(grad_left)).sum()
    loss.backward()
    for name, tensor in zip(FIELDS, inputs, strict=False):
        assert_near(full(actual, name, 40), tensor.grad.numpy())
    assert actual.viewmat is not None
    assert_near(actual.viewmat, inputs[-1].grad.numpy())


@pytest.mark.parametrize("degree", range(5))
def test_colours_of_every_degree(degree: int) -> None:
    gaussians, viewmat = random_gaussians(150, degree, degree), turned_cameras(1).viewmats[0]
    plan = plan_of(gaussians)
    grad_colors = normal(len(plan.ids), 3)
    actual = color_gradients(plan, grad_colors)
    means, sh0, shN = (getattr(gaussians, name).double().requires_grad_() for name in ("means", "sh0", "shN"))
    colors = view_colors(means, torch.cat([sh0, shN], 1), viewmat)
    (colors[torch.from_numpy(plan.ids).long()] * torch.from_numpy(grad_colors)).sum().backward()
    for name, tensor in (("means", means), ("sh0", sh0), ("shN", shN)):
        expected = np.zeros(tensor.shape) if tensor.grad is None else tensor.grad.numpy()
        assert_near(full(actual, name, 150), expected, 1e-5)


@pytest.mark.parametrize("degree", [0, 2, 3, 4])
@pytest.mark.parametrize(("number", "enough"), [(100, False), (200, True)])
def test_used_memory_is_written_again(number: int, enough: bool, degree: int) -> None:
    """Where it is large enough; the answer is the same."""
    plan, other = plan_of(random_gaussians(150, degree, degree)), plan_of(random_gaussians(number, degree, 5))
    assert (len(other.ids) > len(plan.ids)) == enough
    used = color_gradients(other, normal(len(other.ids), 3))
    expected = color_gradients(plan, normal(len(plan.ids), 3))
    actual = color_gradients(plan, normal(len(plan.ids), 3), used=used)
    for one, again in zip(vars(expected).values(), vars(actual).values(), strict=True):
        np.testing.assert_array_equal(one, again)
    assert np.shares_memory(actual.sh0, used.sh0) == enough


def test_opacities_in_place_of_the_gaussians_own() -> None:
    """Dropped Gaussians have no rows' worth of gradient, the others that of their given opacity."""
    gaussians, colors = random_gaussians(40, 0, 4).numpy(), normal(40, 3)
    keep = np.arange(40) % 4 > 0
    given = gaussians.opacities * 0.7
    actual = gradients_of_plan(plan_of(gaussians, opacities=given, keep=keep), colors, None)
    assert keep[actual.ids].all()
    kept = replace(gaussians, opacities=np.where(keep, given, 0))
    expected = gradients_of_plan(plan_of(kept), colors, None)
    for name in FIELDS:
        np.testing.assert_array_equal(full(actual, name, 40), full(expected, name, 40))


def test_finite_differences() -> None:
    """Along the gradient, with Gaussians so wide that no weight crosses a threshold."""
    n, grad_image, grad_left = 12, normal(HEIGHT, WIDTH, 3).astype(float), normal(HEIGHT, WIDTH, seed=1).astype(float)
    start, middle = random_gaussians(n, 0, 9).numpy(), np.array([0, 0, 3], np.float32)
    means = middle + 0.3 * (start.means - middle)
    start = replace(start, means=means, scales=1.5 + 2 * start.scales, opacities=0.1 + 0.3 * start.opacities)
    colors = normal(n, 3, seed=4)

    def loss(name: str, step: np.ndarray) -> float:
        moved, tints = start, colors
        if name == "colors":
            tints = colors + step.astype(np.float32)
        else:
            moved = replace(start, **{name: getattr(start, name) + step.astype(np.float32)})
        image, left = composite(plan_of(moved), tints, BACKGROUND)
        return float((image * grad_image).sum() + (left * grad_left).sum())

    plan = plan_of(start)
    image, left = composite(plan, colors, BACKGROUND)
    actual = plan_gradients(
        plan, grad_image.astype(np.float32), grad_left.astype(np.float32),
        image=image, transmittance=left, colors=colors,
    )  # fmt: skip
    for name in FIELDS:
        gradient = full(actual, name, n)
        step = gradient / np.abs(gradient).max()
        size = 5e-3
        change = (loss(name, size * step) - loss(name, -size * step)) / (2 * size)
        assert change == pytest.approx((gradient * step).sum(), rel=5e-3), name


@pytest.mark.parametrize("threads", [2, 8])
def test_threads_change_nothing(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules["gsmerge.render.view_plan"], "PIECE", 200)
    monkeypatch.setattr(sys.modules["gsmerge.render.gradient"], "WORTH", 200)
    gaussians, cameras = random_gaussians(2000, 3, 10).numpy(), turned_cameras(1).numpy()
    gaussians = replace(gaussians, scales=gaussians.scales * 0.3)
    K, size = cameras.Ks[0] * [[4.0], [4.0], [1.0]], (4 * HEIGHT, 4 * WIDTH)
    grads = normal(*size, 4)

    def run(count: int) -> list[np.ndarray]:
        with use_threads(count):
            plan = plan_view(prepare(gaussians), cameras.viewmats[0], K, size[1], size[0])
            assert len(plan.members) > 2000
            image, left = composite(plan)
            shape = plan_gradients(
                plan, grads[..., :3], grads[..., 3], image=image, transmittance=left, with_viewmat=True
            )
            return [*vars(shape).values(), *vars(color_gradients(plan, shape.colors)).values()]

    for one, other in zip(run(1), run(threads), strict=True):
        np.testing.assert_array_equal(one, other)


def huge(g: Gaussians) -> Gaussians:
    return replace(g, scales=g.scales * 1e12)


def no_extent(g: Gaussians) -> Gaussians:
    return replace(g, scales=np.zeros_like(g.scales))


def no_rotation(g: Gaussians) -> Gaussians:
    return replace(g, quats=np.zeros_like(g.quats))


def long_quats(g: Gaussians) -> Gaussians:
    return replace(g, quats=g.quats * 1e9)


def too_opaque(g: Gaussians) -> Gaussians:
    return replace(g, opacities=np.full_like(g.opacities, 3.0))


def at_the_camera(g: Gaussians) -> Gaussians:
    eye = turned_cameras(1).numpy().centres[0].astype(np.float32)
    return replace(g, means=eye + 1e-2 * g.means)


def one_place(g: Gaussians) -> Gaussians:
    return replace(g, means=np.array([[0.1, 0.2, 3.0]], np.float32).repeat(len(g), 0))


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("eps2d", [0.0, 0.3])
@pytest.mark.parametrize(
    "change",
    [huge, no_extent, no_rotation, long_quats, too_opaque, at_the_camera, one_place],
    ids=lambda f: f.__name__,
)
def test_finite_input_gives_finite_gradients(
    change: Callable[[Gaussians], Gaussians], eps2d: float, antialiased: bool
) -> None:
    gaussians = change(random_gaussians(60, 2, 11).numpy())
    plan = plan_of(gaussians, eps2d=eps2d, antialiased=antialiased)
    actual = gradients_of_plan(plan, normal(60, 3), normal(HEIGHT, WIDTH))
    for name in (*FIELDS, "viewmat"):
        assert np.isfinite(getattr(actual, name)).all(), name
    for array in vars(color_gradients(plan, actual.colors)).values():
        assert np.isfinite(array).all()


def test_a_view_of_nothing() -> None:
    gaussians = random_gaussians(5).numpy()
    plan = plan_of(replace(gaussians, means=gaussians.means - 100))
    actual = gradients_of_plan(plan, normal(5, 3), None)
    assert len(actual.ids) == len(actual.means) == len(actual.colors) == 0
    assert actual.viewmat is not None
    assert (actual.viewmat == 0).all()


def test_what_is_planned_and_drawn_is_what_it_was() -> None:
    gaussians = random_gaussians(50, 1, 12)
    plan = plan_of(gaussians, near=2.0, far=4.0)
    assert ((plan.depths > 2) & (plan.depths < 4)).all()
    assert plan.opacities is plan.splats.opacities


@pytest.mark.parametrize("name", ["grad_image", "grad_transmittance", "image", "transmittance", "colors"])
def test_other_shapes_are_refused(name: str) -> None:
    plan = plan_of(random_gaussians(5))
    arrays = {
        "grad_image": normal(HEIGHT, WIDTH, 3),
        "grad_transmittance": normal(HEIGHT, WIDTH),
        "image": normal(HEIGHT, WIDTH, 3),
        "transmittance": normal(HEIGHT, WIDTH),
        "colors": normal(5, 3),
    }
    arrays[name] = arrays[name][:-1]
    with pytest.raises(ValueError, match=rf"{name}: expected shape \[.*\], got \[.*\]"):
        plan_gradients(plan, **arrays)


def test_other_numbers_of_colours_are_refused() -> None:
    plan = plan_of(random_gaussians(5))
    with pytest.raises(ValueError, match="grad_colors: expected shape"):
        color_gradients(plan, normal(len(plan.ids) + 1, 3))
