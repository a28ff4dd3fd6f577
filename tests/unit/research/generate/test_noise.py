"""The noise model changes nothing where nothing is drawn, and what is drawn is found in the Gaussians."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from gsmerge import Cameras, Gaussians
from gsmerge.method.geometry.transforms import project, quat_to_rotmat
from gsmerge.method.kernels.elementary import log
from gsmerge.method.kernels.raster.project import view_colors
from gsmerge.research.generate import NoiseOptions
from gsmerge.research.generate.noise import (
    ERRORS,
    Noise,
    TrueView,
    draw_noise,
    edge_mask,
    pixel_gaussians,
    predict_depth,
    quats_facing,
    texture_mask,
)
from gsmerge.research.generate.photograph import Pinhole
from gsmerge.research.generate.synthetic_scene import look_at

W, H = 64, 48
LENS = Pinhole(W, H, 60.0)
POSE = look_at(np.array([0.3, -0.2, 0.1]), np.array([0.5, 0.1, 3.0]), 0.1)
NONE = Noise(**{f.name: 0 for f in fields(Noise)})
CLEAN = replace(
    NONE, scale=1.0, flatness=1.0, far=9.0, bleed_width=1.0, oversize=2.0, trust=1.0, opacity_high=0.9, unit=1.0
)


def seen(step: float = 0.0) -> TrueView:
    """Return a slanted wall with detail; its right half is nearer by ``step``."""
    rng = np.random.default_rng(0)
    x = np.broadcast_to(np.arange(W), (H, W))
    depth = 1 / (0.3 + 0.001 * x) * np.where(x < W // 2, 1, 1 - step)
    normals = np.broadcast_to(-POSE[:3, 2], (H, W, 3)).astype(np.float32)
    return TrueView(rng.uniform(0.2, 0.8, (H, W, 3)).astype(np.float32), depth, normals, POSE)


def made(noise: Noise, given: TrueView | None = None, seed: int = 0) -> Gaussians:
    return pixel_gaussians(given or seen(), LENS, noise, np.random.default_rng(seed))


def seen_again(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Return pixel positions and depths of means."""
    cameras = Cameras(np.linalg.inv(POSE)[None], LENS.intrinsics[None], W, H)
    pixels, depths = project(gaussians.means, cameras)
    return pixels[0], depths[0].reshape(H, W)


def test_without_noise_every_gaussian_is_where_its_pixel_looks() -> None:
    gaussians = made(CLEAN)
    pixels, depths = seen_again(gaussians)
    centres = np.stack(np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5), -1).reshape(-1, 2)
    np.testing.assert_allclose(pixels, centres, atol=1e-3)
    np.testing.assert_allclose(depths, seen().depth, rtol=1e-5)
    np.testing.assert_allclose(gaussians.scales[:, 0].reshape(H, W), seen().depth / LENS.focal, rtol=1e-5)
    colors = 0.5 + 0.28209479 * gaussians.sh0[:, 0]
    np.testing.assert_allclose(colors, seen().image.reshape(-1, 3), atol=1e-6)


def test_thin_axes_of_gaussians_are_normals_of_the_surface() -> None:
    turns = quat_to_rotmat(made(replace(CLEAN, flatness=0.2)).quats)
    np.testing.assert_allclose(np.abs(turns[:, :, 2] @ POSE[:3, 2]), 1, atol=1e-5)
    normals = np.random.default_rng(0).normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    axis = quat_to_rotmat(quats_facing(normals))[:, :, 2]
    np.testing.assert_allclose(np.abs((axis * normals).sum(1)), 1, atol=1e-6)


@pytest.mark.parametrize("bias", [0.01, 0.05])
def test_a_view_s_bias_is_one_factor(bias: float) -> None:
    ratios = [log(seen_again(made(replace(CLEAN, view_bias=bias), seed=s))[1] / seen().depth) for s in range(60)]
    assert max(r.std() for r in ratios) < 1e-5
    assert np.std([r.mean() for r in ratios]) == pytest.approx(bias, rel=0.35)


def test_grain_and_drift_have_their_strengths() -> None:
    grain = log(seen_again(made(replace(CLEAN, grain=0.01)))[1] / seen().depth)
    assert grain.std() == pytest.approx(0.01, rel=0.05)
    drift = log(seen_again(made(replace(CLEAN, drift=0.01)))[1] / seen().depth)
    assert drift.std() == pytest.approx(0.01, rel=0.4)
    assert np.abs(np.diff(drift, axis=1)).mean() < 0.15 * drift.std()


def test_depths_bleed_across_edges_with_low_confidence() -> None:
    given = seen(step=0.4)
    depth, confidence = predict_depth(given, replace(CLEAN, bleed=1.0, bleed_width=1.5), np.random.default_rng(0))
    off = np.abs(log(depth / given.depth))
    assert off[:, W // 2 - 2 : W // 2 + 2].min() > 0.02
    assert off[:, : W // 2 - 8].max() < 1e-3
    assert confidence[:, W // 2].mean() < confidence[:, : W // 2 - 8].mean() - 0.4
    assert edge_mask(given.depth)[:, W // 2].min() > 0.9
    assert edge_mask(seen().depth).max() < 0.05  # a slant is no edge


def test_errors_are_larger_without_texture() -> None:
    image = seen().image.copy()
    image[: H // 2] = 0.5
    given = replace(seen(), image=image)
    assert texture_mask(image)[: H // 2 - 4].max() == 0
    actual = seen_again(made(replace(CLEAN, grain=0.01, blank=2.0), given))[1]
    off = log(actual / given.depth)
    assert off[: H // 2 - 4].std() == pytest.approx(3 * off[H // 2 + 4 :].std(), rel=0.2)


def test_the_sky_is_as_far_as_the_network_can_say() -> None:
    depth = seen().depth.copy()
    depth[:10] = 1e6
    actual = seen_again(made(CLEAN, replace(seen(), depth=depth)))[1]
    assert actual[:5].max() <= 9.01 * np.median(depth)
    assert np.isfinite(actual).all()


def test_floaters_oversized_gaussians_and_patches_have_their_shares() -> None:
    noise = replace(CLEAN, floaters=0.1, oversized=0.1, oversize=8.0)
    gaussians = made(noise)
    ratio = seen_again(gaussians)[1] / seen().depth
    assert (ratio < 0.96).mean() == pytest.approx(0.1, abs=0.025)
    sizes = gaussians.scales[:, 0].reshape(H, W) / (seen_again(gaussians)[1] / LENS.focal)
    assert (sizes > 1.5).mean() == pytest.approx(0.1, abs=0.025)
    patches = log(seen_again(made(replace(CLEAN, patches=0.2, patch_error=0.3)))[1] / seen().depth)
    assert (np.abs(patches) > 1e-4).mean() == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize("degree", [1, 2])
def test_harmonics_show_the_photo_to_their_own_camera(degree: int) -> None:
    gaussians = made(replace(CLEAN, sh_degree=degree, harmonics=0.05))
    assert gaussians.shN.shape[1] == (degree + 1) ** 2 - 1
    assert gaussians.shN.std() == pytest.approx(0.05, rel=0.5)
    parts = (gaussians.means, gaussians.sh0, gaussians.shN)
    actual = np.empty((W * H, 3), np.float32)
    view_colors(*parts, np.arange(W * H, dtype=np.int32), POSE[:3, 3].astype(np.float32), 0, W * H, actual)
    np.testing.assert_allclose(actual, seen().image.reshape(-1, 3), atol=1e-4)


def test_drawn_noise_lies_in_its_ranges() -> None:
    options = NoiseOptions()
    drawn = [draw_noise(options, np.random.default_rng(s)) for s in range(200)]
    for f in fields(Noise):
        values = [getattr(noise, f.name) for noise in drawn]
        low, high = (0, 2) if f.name == "sh_degree" else getattr(options, f.name)
        high = options.opacity_high[1] if f.name == "opacity_low" else high  # constant opacities
        low = 0 if f.name == "opacity_grain" else low
        assert low <= min(values) < max(values) <= high
    constant = [noise.opacity_low == noise.opacity_high for noise in drawn]
    assert np.mean(constant) == pytest.approx(options.constant_opacity, abs=0.08)
    doubled = draw_noise(options, np.random.default_rng(0), 2.0)
    assert doubled.grain == pytest.approx(2 * drawn[0].grain)
    assert doubled.scale == drawn[0].scale
    assert all(getattr(draw_noise(options, np.random.default_rng(0), 0.0), name) == 0 for name in ERRORS)
