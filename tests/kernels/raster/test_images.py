"""The renderer, its footprints and its culling match the slow float64 one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_gaussians import random_gaussians
from slow_renderer import Reference, footprints, render_arrays
from sweeps import sweep

from gsmerge import Cameras, Gaussians
from gsmerge.method.kernels import elementary
from gsmerge.method.raster import composite, contributions, make_splats, render, splat_adjoint, tile_view
from gsmerge.method.raster.metrics import psnr

WIDTH, HEIGHT = 45, 37  # not multiples of a tile


def turned_camera() -> Cameras:
    viewmat = np.eye(4)
    viewmat[0, 0] = viewmat[2, 2] = elementary.cos(0.2)
    viewmat[0, 2], viewmat[2, 0] = elementary.sin(0.2), -elementary.sin(0.2)
    viewmat[:3, 3] = [-0.4, 0.1, 0.2]
    K = np.array([[40.0, 0, 21.3], [0, 42.0, 19.1], [0, 0, 1]])
    return Cameras(viewmat[None], K[None], WIDTH, HEIGHT)


def reference(gaussians: Gaussians, cameras: Cameras, **options: object) -> Reference:
    return render_arrays(gaussians, cameras.viewmats[0], cameras.Ks[0], cameras.width, cameras.height, **options)


def assert_alike(image: object, expected: object, most: float = 0.02) -> None:
    """Check for equality up to rounding but for single pixels where a threshold or a depth tie falls the other way."""
    error = np.abs(np.asarray(image, np.float64) - np.asarray(expected))
    assert error.max() < most
    assert np.quantile(error, 0.99) < 2e-5


@sweep("degree", range(5), often=2)
def test_images_match_the_slow_renderer(degree: int) -> None:
    gaussians, cameras = random_gaussians(300, degree, degree=degree), turned_camera()
    rendering = render(gaussians, cameras, (0.2, 0.5, 0.9), with_depths=True)
    expected = reference(gaussians, cameras, background=(0.2, 0.5, 0.9))
    assert_alike(rendering.images[0], expected.image)
    assert_alike(rendering.alphas[0, ..., 0], 1 - expected.transmittance)
    assert_alike(rendering.depths[0, ..., 0], expected.depth, 0.1)


def test_antialiased_images_match_the_slow_renderer() -> None:
    gaussians, cameras = random_gaussians(300, 7, degree=1), turned_camera()
    rendering = render(gaussians, cameras, antialiased=True)
    assert_alike(rendering.images[0], reference(gaussians, cameras, antialiased=True).image)
    assert psnr(rendering.images[0], render(gaussians, cameras).images[0]) < 60


def test_range_of_depths_matches_the_slow_renderer() -> None:
    gaussians, cameras = random_gaussians(300, 8), turned_camera()
    rendering = render(gaussians, cameras, near=2.5, far=3.5)
    assert_alike(rendering.images[0], reference(gaussians, cameras, near=2.5, far=3.5).image)


@sweep("scale", [1e-6, 0.3, 3.0], often=2)
def test_tiny_and_large_gaussians_match_the_slow_renderer(scale: float) -> None:
    gaussians, cameras = random_gaussians(200, 9), turned_camera()
    scales = elementary.exp(0.5 * elementary.log(gaussians.scales / 0.05)) * scale
    resized = replace(gaussians, scales=scales, opacities=gaussians.opacities * 0.3)
    assert_alike(render(resized, cameras).images[0], reference(resized, cameras).image)


def test_needles_match_the_slow_renderer() -> None:
    """Long and thin: where the determinant of the footprint cancels."""
    gaussians, cameras = random_gaussians(100, 10), turned_camera()
    scales = np.array([[2.0, 1e-4, 1e-5]], np.float32).repeat(100, 0)
    needles = replace(gaussians, scales=scales)
    assert_alike(render(needles, cameras).images[0], reference(needles, cameras).image, 0.05)


@sweep("channels", [1, 3, 4, 5, 8], often=2)
def test_adjoint_matches_the_weights(channels: int) -> None:
    gaussians, cameras = random_gaussians(200, 11), turned_camera()
    tiled = tile_view(make_splats(gaussians), cameras.viewmats[0], cameras.Ks[0], WIDTH, HEIGHT)
    image = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, channels))
    expected = np.einsum("nhw,hwc->nc", reference(gaussians, cameras).weights, image)
    np.testing.assert_allclose(splat_adjoint(tiled, image), expected, atol=0.02)
    assert np.median(np.abs(splat_adjoint(tiled, image) - expected)) < 1e-5


def test_contributions_match_the_weights() -> None:
    gaussians, cameras = random_gaussians(200, 12), turned_camera()
    mass, peak = contributions(tile_view(make_splats(gaussians), cameras.viewmats[0], cameras.Ks[0], WIDTH, HEIGHT))
    weights = reference(gaussians, cameras).weights
    np.testing.assert_allclose(mass, weights.sum((1, 2)), atol=0.02)
    np.testing.assert_allclose(peak, weights.max((1, 2)), atol=0.01)


def test_any_colours_are_blended_as_they_are() -> None:
    gaussians, cameras = random_gaussians(200, 13), turned_camera()
    colors = np.random.default_rng(0).normal(size=(200, 3)) * 10
    tiled = tile_view(make_splats(gaussians), cameras.viewmats[0], cameras.Ks[0], WIDTH, HEIGHT)
    image, _ = composite(tiled, colors)
    assert_alike(image / 10, np.einsum("nhw,nc->hwc", reference(gaussians, cameras).weights, colors) / 10)


torch = pytest.importorskip("torch", reason="torch is not installed")


def spread_gaussians(n: int, seed: int, *, spread: float, depth: float, sizes: float) -> Gaussians:
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
    gaussians = spread_gaussians(n, 0, spread=0.6, depth=3, sizes=1.0)
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
    gaussians = spread_gaussians(n, 1, spread=2.0, depth=2, sizes=1.5)
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
