"""Colours seen from a camera, and their gradient, match the slow renderer."""

from __future__ import annotations

import numpy as np
import pytest
from slow_renderer import random_gaussians, turned_cameras, view_colors
from view_gradients_of import assert_near, full, normal, turned_view

from gsmerge.method.kernels.raster import project
from gsmerge.method.raster.composite import view_colors as drawn_colors
from gsmerge.method.raster.gradient import color_gradients

torch = pytest.importorskip("torch", reason="torch is not installed")

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("degree", range(5))
def test_colours_seen_from_a_camera_match_the_slow_renderer(degree: int) -> None:
    means = RNG.normal(size=(50, 3)).astype(np.float32)
    sh0 = RNG.normal(size=(50, 1, 3)).astype(np.float32)
    shN = RNG.normal(size=(50, (degree + 1) ** 2 - 1, 3)).astype(np.float32)
    eye, ids = np.array([0.3, -2.0, 1.0], np.float32), np.arange(1, 50, 2, dtype=np.int32)
    colors = np.full((25, 3), -1, np.float32)
    project.view_colors(means, sh0, shN, ids, eye, 0, 25, colors)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = -torch.from_numpy(eye).double()
    coeffs = torch.from_numpy(np.concatenate([sh0, shN], 1)).double()
    np.testing.assert_allclose(colors, view_colors(torch.from_numpy(means).double(), coeffs, viewmat)[ids], atol=1e-5)
    assert (colors == 0).any()


@pytest.mark.parametrize("degree", range(5))
def test_gradient_of_colours_of_every_degree(degree: int) -> None:
    gaussians, viewmat = random_gaussians(150, degree, degree), turned_cameras(1).viewmats[0]
    tiled = turned_view(gaussians)
    grad_colors = normal(len(tiled.ids), 3)
    actual = color_gradients(tiled, grad_colors, drawn_colors(tiled))
    means, sh0, shN = (getattr(gaussians, name).double().requires_grad_() for name in ("means", "sh0", "shN"))
    colors = view_colors(means, torch.cat([sh0, shN], 1), viewmat)
    (colors[torch.from_numpy(tiled.ids).long()] * torch.from_numpy(grad_colors)).sum().backward()
    for name, tensor in (("means", means), ("sh0", sh0), ("shN", shN)):
        expected = np.zeros(tensor.shape) if tensor.grad is None else tensor.grad.numpy()
        assert_near(full(actual, name, 150), expected, 1e-5)


@pytest.mark.parametrize("degree", [0, 2, 3, 4])
@pytest.mark.parametrize(("number", "enough"), [(100, False), (200, True)])
def test_gradients_are_written_into_used_memory(number: int, enough: bool, degree: int) -> None:
    """Where it is large enough; the answer is the same."""
    tiled, other = turned_view(random_gaussians(150, degree, degree)), turned_view(random_gaussians(number, degree, 5))
    assert (len(other.ids) > len(tiled.ids)) == enough
    used = color_gradients(other, normal(len(other.ids), 3), drawn_colors(other))
    given = normal(len(tiled.ids), 3), drawn_colors(tiled)
    expected, actual = color_gradients(tiled, *given), color_gradients(tiled, *given, used=used)
    for one, again in zip(vars(expected).values(), vars(actual).values(), strict=True):
        np.testing.assert_array_equal(one, again)
    assert np.shares_memory(actual.sh0, used.sh0) == enough
