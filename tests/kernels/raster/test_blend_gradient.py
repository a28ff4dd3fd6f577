"""The array interface matches autograd through the slow renderer, on any threads and hostile input."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from slow_renderer import BACKGROUND, HEIGHT, WIDTH, random_gaussians, render_reference, turned_cameras
from sweeps import sweep
from view_gradients_of import assert_near, full, normal, turned_view

from gsmerge import Gaussians
from gsmerge.raster import TiledView, composite, make_splats, tile_view
from gsmerge.raster.composite import view_colors
from gsmerge.raster.gradient import Gradients, color_gradients, gradients_of
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
    monkeypatch.setattr(sys.modules["gsmerge.raster.tiled_view"], "THREAD_PIECE", 200)
    monkeypatch.setattr(sys.modules["gsmerge.raster.gradient"], "MIN_PER_THREAD", 200)
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
