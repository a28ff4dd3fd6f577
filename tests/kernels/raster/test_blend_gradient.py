"""The array interface and ``render`` match autograd through the slow renderer, on any threads and hostile input."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from slow_renderer import (
    BACKGROUND,
    HEIGHT,
    NAMES,
    WIDTH,
    assert_close,
    leaves,
    pixel_gradients,
    random_gaussians,
    reference_gradients,
    render_reference,
    turned_cameras,
)
from sweeps import sweep
from view_gradients_of import assert_near, full, normal, turned_view

from gsmerge import Cameras, Gaussians, render
from gsmerge.method.raster import TiledView, composite, make_splats, tile_view
from gsmerge.method.raster.composite import view_colors
from gsmerge.method.raster.gradient import Gradients, color_gradients, gradients_of
from gsmerge.runtime.threads import use_threads

torch = pytest.importorskip("torch", reason="torch is not installed")
FIELDS = ("means", "quats", "scales", "opacities", "colors")


def gradients_of_view(tiled: TiledView, colors: np.ndarray, grad_left: np.ndarray | None) -> Gradients:
    image, transmittance = composite(tiled, colors, BACKGROUND)
    return gradients_of(
        tiled, colors[tiled.ids], image, transmittance, normal(HEIGHT, WIDTH, 3), grad_left, with_viewmat=True
    )


@sweep("eps2d", [0.075, 0.3, 1.0])
@sweep("with_left", [False, True])
def test_gradients_match_autograd_for_any_colour_dilation_and_transmittance(eps2d: float, with_left: bool) -> None:
    gaussians, cameras, colors = random_gaussians(40, 0, 1), turned_cameras(1), normal(40, 3, seed=2)
    grad_left = normal(HEIGHT, WIDTH, seed=3) if with_left else None
    actual = gradients_of_view(turned_view(gaussians, eps2d=eps2d), colors, grad_left)
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
    assert_near(actual.viewmat, inputs[-1].grad.numpy())


def test_gradients_take_opacities_in_place_of_the_gaussians_own() -> None:
    """Dropped Gaussians have no rows' worth of gradient, the others that of their given opacity."""
    gaussians, colors = random_gaussians(40, 0, 4).numpy(), normal(40, 3)
    keep = np.arange(40) % 4 > 0
    given = gaussians.opacities * 0.7
    actual = gradients_of_view(turned_view(gaussians, opacities=given, keep=keep), colors, None)
    assert keep[actual.ids].all()
    kept = replace(gaussians, opacities=np.where(keep, given, 0))
    expected = gradients_of_view(turned_view(kept), colors, None)
    for name in FIELDS:
        np.testing.assert_array_equal(full(actual, name, 40), full(expected, name, 40))


@pytest.mark.parametrize("threads", [2, 8])
def test_gradients_have_the_same_bits_on_any_number_of_threads(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules["gsmerge.method.raster.tiled_view"], "THREAD_PIECE", 200)
    monkeypatch.setattr(sys.modules["gsmerge.method.raster.gradient"], "MIN_PER_THREAD", 200)
    gaussians, cameras = random_gaussians(2000, 3, 10).numpy(), turned_cameras(1).numpy()
    gaussians = replace(gaussians, scales=gaussians.scales * 0.3)
    K, size = cameras.Ks[0] * [[4.0], [4.0], [1.0]], (4 * HEIGHT, 4 * WIDTH)
    grads = normal(*size, 4)

    def run(count: int) -> list[np.ndarray]:
        with use_threads(count):
            tiled = tile_view(make_splats(gaussians), cameras.viewmats[0], K, size[1], size[0])
            assert len(tiled.flatten_ids) > 2000
            image, left = composite(tiled)
            colors = view_colors(tiled)
            wanted = grads[..., :3].copy(), grads[..., 3].copy()
            shape = gradients_of(tiled, colors, image, left, *wanted, with_viewmat=True)
            return [*vars(shape).values(), *vars(color_gradients(tiled, shape.colors, colors)).values()]

    for one, other in zip(run(1), run(threads), strict=True):
        np.testing.assert_array_equal(one, other)


CHANGES: dict[str, Callable[[Gaussians], dict[str, np.ndarray]]] = {
    "huge": lambda g: {"scales": g.scales * 1e12},
    "no extent": lambda g: {"scales": np.zeros_like(g.scales)},
    "no rotation": lambda g: {"quats": np.zeros_like(g.quats)},
    "long quats": lambda g: {"quats": g.quats * 1e9},
    "too opaque": lambda g: {"opacities": np.full_like(g.opacities, 3.0)},
    "at the camera": lambda g: {"means": turned_cameras(1).numpy().centres[0].astype(np.float32) + 1e-2 * g.means},
    "in one place": lambda g: {"means": np.array([[0.1, 0.2, 3.0]], np.float32).repeat(len(g), 0)},
}


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("eps2d", [0.0, 0.3])
@pytest.mark.parametrize("change", CHANGES)
def test_finite_input_gives_finite_gradients(change: str, eps2d: float, antialiased: bool) -> None:
    gaussians = random_gaussians(60, 2, 11).numpy()
    gaussians = replace(gaussians, **CHANGES[change](gaussians))
    tiled = turned_view(gaussians, eps2d=eps2d, antialiased=antialiased)
    actual = gradients_of_view(tiled, normal(60, 3), normal(HEIGHT, WIDTH))
    for name in (*FIELDS, "viewmat"):
        assert np.isfinite(getattr(actual, name)).all(), name
    for array in vars(color_gradients(tiled, actual.colors, view_colors(tiled))).values():
        assert np.isfinite(array).all()


def test_view_of_nothing_has_empty_gradients() -> None:
    gaussians = random_gaussians(5).numpy()
    tiled = turned_view(replace(gaussians, means=gaussians.means - 100))
    actual = gradients_of_view(tiled, normal(5, 3), None)
    assert len(actual.ids) == len(actual.means) == len(actual.colors) == 0
    assert (actual.viewmat == 0).all()


Tensor = torch.Tensor


def gradients(
    gaussians: Gaussians, cameras: Cameras, background: object = BACKGROUND, seed: int = 0, **options: bool
) -> list[Tensor]:
    *tensors, viewmats = leaves(gaussians, cameras)
    drawn = render(Gaussians(*tensors), replace(cameras, viewmats=viewmats), background, **options)
    grad_images, grad_alphas = pixel_gradients(cameras, seed)
    ((drawn.images * grad_images).sum() + (drawn.alphas * grad_alphas).sum()).backward()
    actual = [tensor.grad for tensor in (*tensors, viewmats)]
    assert all(one is not None for one in actual)
    return actual


@pytest.mark.parametrize("degree", range(5))
@sweep("seed", range(2))
def test_gradients_of_every_parameter_and_degree_match_autograd(degree: int, seed: int) -> None:
    gaussians, cameras = random_gaussians(40, degree, 10 * degree + seed), turned_cameras()
    actual, expected = gradients(gaussians, cameras, seed=seed), reference_gradients(gaussians, cameras, seed=seed)
    assert_close(actual, expected)
    for name, one in zip(NAMES, expected, strict=True):
        assert float(one.norm()) > 0 or (name == "shN" and degree == 0)


@sweep("background", [(-2.0, 0.3, 5.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)])
def test_gradients_over_any_background_match_autograd(background: tuple[float, float, float]) -> None:
    gaussians, cameras = random_gaussians(40), turned_cameras(1)
    assert_close(gradients(gaussians, cameras, background), reference_gradients(gaussians, cameras, background))


@sweep("seed", range(3))
def test_antialiased_gradients_match_autograd(seed: int) -> None:
    gaussians, cameras = random_gaussians(40, 1, seed), turned_cameras()
    gaussians = replace(gaussians, scales=gaussians.scales * 0.3)
    assert_close(
        gradients(gaussians, cameras, antialiased=True), reference_gradients(gaussians, cameras, antialiased=True)
    )


def border(g: Gaussians) -> Gaussians:
    """Move Gaussians' centres beyond the clamp of the viewing direction, so that they reach into the image."""
    side = torch.tensor([1.0, -1.0]).repeat(len(g) // 2)
    means = g.means.clone()
    means[::4, 0], means[1::4, 0] = 0.75 * means[::4, 2].abs() * side[::4], -0.9 * means[1::4, 2].abs()
    means[2::4, 1], means[3::4, 1] = 0.8 * means[2::4, 2].abs(), -0.7 * means[3::4, 2].abs()
    return replace(g, means=means, scales=g.scales * 5)


DEGENERATE: dict[str, Callable[[Gaussians], Gaussians]] = {
    "flat": lambda g: replace(g, scales=g.scales * torch.tensor([1.0, 1.0, 1e-5])),
    "needles": lambda g: replace(g, scales=g.scales * torch.tensor([4.0, 1e-4, 1e-5])),
    "border": border,
    # clamped at 0.99 around their centres, and deep behind each other
    "opaque": lambda g: replace(
        g, opacities=torch.tensor([0.995, 1, 1]).repeat(len(g))[: len(g)], scales=g.scales * 1.5
    ),
    "nearly clamped": lambda g: replace(g, opacities=torch.full((len(g),), 0.989)),
    "subpixel": lambda g: replace(g, scales=g.scales * 1e-5),
    "wide": lambda g: replace(g, scales=g.scales * 50, opacities=g.opacities * 0.2),
    "faint": lambda g: replace(g, opacities=torch.full((len(g),), 0.02)),
    "dark": lambda g: replace(g, sh0=g.sh0 - 2.0),  # most colours are cut at 0
}


@pytest.mark.parametrize("change", DEGENERATE)
def test_gradients_of_degenerate_gaussians_match_autograd(change: str) -> None:
    gaussians, cameras = DEGENERATE[change](random_gaussians(40, 1, 5)), turned_cameras()
    assert_close(gradients(gaussians, cameras), reference_gradients(gaussians, cameras))


def test_gaussians_that_are_not_drawn_have_no_gradient() -> None:
    gaussians, cameras = random_gaussians(40, 2, 6), turned_cameras(1)
    means, opacities = gaussians.means.clone(), gaussians.opacities.clone()
    means[:10, 2], opacities[10:20] = -3.0, 0.0
    actual = gradients(replace(gaussians, means=means, opacities=opacities), cameras)
    for name, one in zip(NAMES[:-1], actual, strict=False):
        assert (one[:20] == 0).all(), name
        assert (one[20:] != 0).any(), name


def test_empty_scenes_have_empty_gradients() -> None:
    gaussians, cameras = random_gaussians(3)[:0], turned_cameras()
    actual = gradients(gaussians, cameras)
    assert [one.shape[0] for one in actual] == [0, 0, 0, 0, 0, 0, 2]
    assert (actual[-1] == 0).all()


def test_inputs_that_ask_for_a_gradient_get_one_of_their_type() -> None:
    gaussians, cameras = random_gaussians(30), turned_cameras(1)
    means = gaussians.means.double().requires_grad_()
    scales = gaussians.scales.clone().requires_grad_()
    drawn = render(replace(gaussians, means=means, scales=scales), cameras)
    assert drawn.images.requires_grad
    assert drawn.alphas.requires_grad
    drawn.images.sum().backward()
    assert means.grad.dtype == torch.float64
    assert scales.grad.dtype == torch.float32
    assert gaussians.opacities.grad is None


def test_images_with_gradients_are_those_without() -> None:
    gaussians, cameras = random_gaussians(40, 1), turned_cameras()
    plain = render(gaussians, cameras, BACKGROUND, with_depths=True)
    *tensors, viewmats = leaves(gaussians, cameras)
    drawn = render(Gaussians(*tensors), replace(cameras, viewmats=viewmats), BACKGROUND, with_depths=True)
    assert torch.equal(drawn.images, plain.images)
    assert torch.equal(drawn.alphas, plain.alphas)
    assert torch.equal(drawn.depths, plain.depths)
    assert not drawn.depths.requires_grad
    with torch.no_grad():
        assert not render(Gaussians(*tensors), cameras).images.requires_grad


def test_overwritten_input_is_refused_in_the_backward_pass() -> None:
    gaussians, cameras = random_gaussians(30), turned_cameras(1)
    scales = gaussians.scales.clone().requires_grad_()
    drawn = render(replace(gaussians, scales=scales), cameras)
    with torch.no_grad():
        scales *= 2
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        drawn.images.sum().backward()


def test_far_away_scenes_keep_their_gradients() -> None:
    """Around a geographic position, in float64, gradients are those around zero."""
    gaussians, cameras = random_gaussians(40, 1, 7), turned_cameras()
    shift = torch.tensor([4.2e6, -1.3e5, 4.8e6], dtype=torch.float64)
    viewmats = cameras.viewmats.clone()
    viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ shift
    moved = gradients(replace(gaussians, means=gaussians.means.double() + shift), replace(cameras, viewmats=viewmats))
    assert_close(moved[:-1], [one.double() for one in gradients(gaussians, cameras)[:-1]])
