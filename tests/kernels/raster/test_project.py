"""Footprints and culling match the slow renderer."""

from __future__ import annotations

import numpy as np
import pytest
from slow_renderer import footprints

from gsmerge import Gaussians
from gsmerge.kernels import elementary
from gsmerge.raster import make_splats, tile_view

torch = pytest.importorskip("torch", reason="torch is not installed")


def random_gaussians(n: int, seed: int, *, spread: float, depth: float, sizes: float) -> Gaussians:
    """Draw Gaussians about a point on the axis, with quaternions of any length."""
    rng = np.random.default_rng(seed)
    columns = (
        rng.normal(size=(n, 3)) * spread + [0, 0, depth], rng.normal(size=(n, 4)),
        elementary.exp(rng.normal(size=(n, 3)) * sizes - 3), rng.random(n), np.zeros((n, 1, 3)), np.zeros((n, 0, 3)),
    )  # fmt: skip
    return Gaussians(*(column.astype(np.float32) for column in columns))


def slow_footprints(gaussians: Gaussians, viewmat: np.ndarray, K: np.ndarray, *size: int) -> tuple[np.ndarray, ...]:
    """Return image positions ``[n,2]``, undilated covariances ``[n,2,2]`` and depths ``[n]``."""
    columns = (torch.from_numpy(c).double() for c in (gaussians.means, gaussians.quats, gaussians.scales))
    return tuple(t.numpy() for t in footprints(*columns, torch.from_numpy(viewmat), torch.from_numpy(K), *size))


def test_footprints_match_the_slow_renderer() -> None:
    """Position, precision and rows of what a tiled view holds; a row is listed if a pixel column could reach 1/255."""
    n, width, height = 300, 60, 40
    gaussians = random_gaussians(n, 0, spread=0.6, depth=3, sizes=1.0)
    K, viewmat = np.array([[50.0, 0, 30], [0, 50.0, 20], [0, 0, 1]]), np.eye(4)
    tiled = tile_view(make_splats(gaussians), viewmat, K, width, height)
    positions, covars, depths = slow_footprints(gaussians, viewmat, K, width, height)
    ids = tiled.ids
    mean_x, mean_y, rate_x, slope, rate_y, lnop, first, last = tiled.conics.T.astype(np.float64)
    np.testing.assert_allclose(np.stack([mean_x, mean_y], 1), positions[ids], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(tiled.depths, depths[ids], rtol=1e-5)
    conics = np.linalg.inv(covars + 0.3 * np.eye(2))[ids]
    np.testing.assert_allclose(2 * rate_x**2, conics[:, 0, 0], rtol=1e-3)
    np.testing.assert_allclose(-2 * rate_x**2 * slope, conics[:, 0, 1], rtol=1e-2, atol=1e-4)
    np.testing.assert_allclose(2 * (rate_x**2 * slope**2 + rate_y), conics[:, 1, 1], rtol=1e-3)
    np.testing.assert_allclose(np.exp(lnop), gaussians.opacities[ids], rtol=1e-5)

    rows = np.arange(height)[:, None] + 0.5
    reached = (lnop - rate_y * (rows - mean_y) ** 2 >= elementary.log(1 / 255)) & np.isin(
        np.arange(len(ids)), tiled.flatten_ids
    )
    listed = (rows - 0.5 >= first) & (rows - 0.5 <= last)
    assert (listed | ~reached).all()
    assert (listed == reached)[:, reached.any(0)].mean() > 0.999


def test_no_gaussian_that_adds_light_is_missing() -> None:
    """Culling and boxes drop only what stays below 1/255 in every pixel."""
    n, width, height = 800, 50, 40
    gaussians = random_gaussians(n, 1, spread=2.0, depth=2, sizes=1.5)
    K, viewmat = np.array([[50.0, 0, 25], [0, 50.0, 20], [0, 0, 1]]), np.eye(4)
    tiled = tile_view(make_splats(gaussians), viewmat, K, width, height)
    positions, covars, depths = slow_footprints(gaussians, viewmat, K, width, height)
    conics = np.linalg.inv(covars + 0.3 * np.eye(2))
    ys, xs = np.mgrid[:height, :width] + 0.5
    offsets = np.stack([xs, ys], -1).reshape(1, -1, 2) - positions[:, None]
    distances = ((offsets @ conics) * offsets).sum(-1)
    alphas = gaussians.opacities[:, None] * elementary.exp(-0.5 * distances)
    visible = (alphas.max(1) > 1.001 / 255) & (depths > 0.01)
    drawn = set(tiled.ids[np.unique(tiled.flatten_ids)].tolist())
    assert set(np.flatnonzero(visible).tolist()) <= drawn
    # boxes have corners that their ellipses do not fill, and culling only looks at the longest axis
    assert visible.sum() > 0.9 * len(drawn)
    assert len(drawn) > 0.6 * len(tiled.ids)
