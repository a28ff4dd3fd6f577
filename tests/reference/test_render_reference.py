"""The renderer against the slow float64 one of this folder."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from renderer import Reference, render_reference, view_colors

from gsmerge import Cameras, Gaussians
from gsmerge.render import composite, contributions, plan_view, prepare, render, splat_adjoint
from gsmerge.render.metrics import psnr

WIDTH, HEIGHT = 45, 37  # not multiples of a tile


def random_gaussians(n: int, degree: int, seed: int) -> Gaussians:
    """Around (0, 0, 3), of all sizes and flatnesses, some of them behind the camera."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    means = normal(n, 3) * torch.tensor([0.9, 0.8, 1.0]) + torch.tensor([0.0, 0.0, 3.0])
    means[: n // 20, 2] -= 4
    return Gaussians(
        means,
        torch.nn.functional.normalize(normal(n, 4), dim=1),
        torch.exp(normal(n, 3) * 0.9 - 3),
        torch.rand(n, generator=generator) ** 0.5,
        normal(n, 1, 3),
        normal(n, (degree + 1) ** 2 - 1, 3) * 0.2,
    )


def turned_camera() -> Cameras:
    angle = torch.tensor(0.2, dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 0] = viewmat[2, 2] = torch.cos(angle)
    viewmat[0, 2], viewmat[2, 0] = torch.sin(angle), -torch.sin(angle)
    viewmat[:3, 3] = torch.tensor([-0.4, 0.1, 0.2])
    K = torch.tensor([[40.0, 0, 21.3], [0, 42.0, 19.1], [0, 0, 1]], dtype=torch.float64)
    return Cameras(viewmat[None], K[None], WIDTH, HEIGHT)


def reference(gaussians: Gaussians, cameras: Cameras, **options: object) -> Reference:
    means, viewmat = gaussians.means.double(), cameras.viewmats[0]
    colors = view_colors(means, torch.cat([gaussians.sh0, gaussians.shN], 1).double(), viewmat)
    return render_reference(
        means, gaussians.quats.double(), gaussians.scales.double(), gaussians.opacities.double(), colors,
        viewmat, cameras.Ks[0], cameras.width, cameras.height, **options,
    )  # fmt: skip


def assert_alike(image: object, expected: object, most: float = 0.02) -> None:
    """Equal up to rounding but for single pixels where a threshold or a depth tie falls the other way."""
    error = np.abs(np.asarray(image, np.float64) - np.asarray(expected))
    assert error.max() < most
    assert np.quantile(error, 0.99) < 2e-5


@pytest.mark.parametrize("degree", range(5))
def test_images_match(degree: int) -> None:
    gaussians, cameras = random_gaussians(300, degree, degree), turned_camera()
    rendering = render(gaussians, cameras, (0.2, 0.5, 0.9), with_depths=True)
    expected = reference(gaussians, cameras, background=(0.2, 0.5, 0.9))
    assert rendering.depths is not None
    assert_alike(rendering.images[0], expected.image)
    assert_alike(rendering.alphas[0, ..., 0], 1 - expected.transmittance)
    assert_alike(rendering.depths[0, ..., 0], expected.depth, 0.1)


def test_antialiased_images_match() -> None:
    gaussians, cameras = random_gaussians(300, 1, 7), turned_camera()
    rendering = render(gaussians, cameras, antialiased=True)
    assert_alike(rendering.images[0], reference(gaussians, cameras, antialiased=True).image)
    assert psnr(rendering.images[0], render(gaussians, cameras).images[0]) < 60


def test_depth_range_matches() -> None:
    gaussians, cameras = random_gaussians(300, 0, 8), turned_camera()
    rendering = render(gaussians, cameras, near=2.5, far=3.5)
    assert_alike(rendering.images[0], reference(gaussians, cameras, near=2.5, far=3.5).image)


@pytest.mark.parametrize("scale", [1e-6, 0.3, 3.0])
def test_tiny_and_large_gaussians_match(scale: float) -> None:
    gaussians, cameras = random_gaussians(200, 0, 9), turned_camera()
    scales = torch.exp(0.5 * torch.log(gaussians.scales / 0.05)) * scale
    resized = Gaussians(
        gaussians.means, gaussians.quats, scales, gaussians.opacities * 0.3, gaussians.sh0, gaussians.shN
    )
    assert_alike(render(resized, cameras).images[0], reference(resized, cameras).image)


def test_needles_match() -> None:
    """Long and thin: where the determinant of the footprint cancels."""
    gaussians, cameras = random_gaussians(100, 0, 10), turned_camera()
    scales = torch.tensor([2.0, 1e-4, 1e-5]).expand(100, 3)
    needles = Gaussians(gaussians.means, gaussians.quats, scales, gaussians.opacities, gaussians.sh0, gaussians.shN)
    assert_alike(render(needles, cameras).images[0], reference(needles, cameras).image, 0.05)


@pytest.mark.parametrize("channels", [1, 3, 4, 5, 8])
def test_adjoint_matches_the_weights(channels: int) -> None:
    gaussians, cameras = random_gaussians(200, 0, 11), turned_camera()
    plan = plan_view(prepare(gaussians), cameras.viewmats[0], cameras.Ks[0], WIDTH, HEIGHT)
    image = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, channels))
    expected = torch.einsum("nhw,hwc->nc", reference(gaussians, cameras).weights, torch.from_numpy(image))
    np.testing.assert_allclose(splat_adjoint(plan, image), expected, atol=0.02)
    assert np.median(np.abs(splat_adjoint(plan, image) - expected.numpy())) < 1e-5


def test_contributions_match_the_weights() -> None:
    gaussians, cameras = random_gaussians(200, 0, 12), turned_camera()
    mass, peak = contributions(plan_view(prepare(gaussians), cameras.viewmats[0], cameras.Ks[0], WIDTH, HEIGHT))
    weights = reference(gaussians, cameras).weights
    np.testing.assert_allclose(mass, weights.sum((1, 2)), atol=0.02)
    np.testing.assert_allclose(peak, weights.amax((1, 2)), atol=0.01)


def test_any_colours_are_blended_as_they_are() -> None:
    gaussians, cameras = random_gaussians(200, 0, 13), turned_camera()
    colors = np.random.default_rng(0).normal(size=(200, 3)) * 10
    plan = plan_view(prepare(gaussians), cameras.viewmats[0], cameras.Ks[0], WIDTH, HEIGHT)
    image, _ = composite(plan, colors)
    assert_alike(
        image / 10, torch.einsum("nhw,nc->hwc", reference(gaussians, cameras).weights, torch.from_numpy(colors)) / 10
    )
