"""The renderer matches the slow float64 one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from made_gaussians import random_gaussians
from slow_renderer import Reference, render_arrays
from sweeps import sweep

from gsmerge import Cameras, Gaussians
from gsmerge.kernels import elementary
from gsmerge.raster import composite, contributions, make_splats, render, splat_adjoint, tile_view
from gsmerge.raster.metrics import psnr

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
