from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from scenes import make_features

from gsmerge import geometry
from gsmerge.geometry import covariances
from gsmerge.moments import feature_to_gaussians
from gsmerge.networks.modules import Bounds
from gsmerge.networks.residuals import (
    COLOR,
    LOGIT,
    MEAN,
    RESIDUAL,
    ROTATION,
    SIZE,
    bound_residuals,
    gaussian_sizes,
    move_features,
    move_gaussians,
    quat_to_rotmat,
    residual_limits,
    rotate_quats,
    rotation_matrices,
)
from gsmerge.types import SH_C0, FeatureGaussians, Gaussians


def some(count: int = 20) -> FeatureGaussians:
    rng = np.random.default_rng(0)
    features = make_features(rng.normal(size=(count, 3)), opacities=0.6)
    half = rng.normal(size=(count, 3, 3)).astype(np.float32)
    covars = half @ half.swapaxes(1, 2)
    scales = np.sqrt(np.linalg.eigvalsh(covars).clip(1e-6))
    return replace(features, covars=covars, extinctions=-math.log(0.4) * scales[:, 1] * scales[:, 2])


def base_of(features: FeatureGaussians) -> Gaussians:
    """The Gaussian of each, tensors."""
    return feature_to_gaussians(features).to("cpu")


def frames(count: int = 20, seed: int = 1) -> torch.Tensor:
    return quat_to_rotmat(torch.randn(count, 4, generator=torch.Generator().manual_seed(seed)))


def test_zero_changes_no_bit() -> None:
    features = some()
    base, zero = base_of(features), torch.zeros(20, RESIDUAL)
    for before, after in (
        (base, move_gaussians(base, zero, frames())),
        (features, move_features(features, base, zero, frames())),
    ):
        for f in fields(before):
            assert np.array_equal(getattr(before, f.name), getattr(after, f.name)), f.name
            assert type(getattr(before, f.name)) is type(getattr(after, f.name)), f.name


@pytest.mark.parametrize("rows", [1, 7, 20])
def test_any_number_of_rows_at_once_gives_the_same_bits(rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    features, residuals = some(), 0.3 * torch.randn(20, RESIDUAL, generator=torch.Generator().manual_seed(5))
    whole = move_features(features, base_of(features), residuals, frames())
    monkeypatch.setattr("gsmerge.networks.residuals.ROWS", rows)
    parts = move_features(features, base_of(features), residuals, frames())
    for f in fields(whole):
        assert np.array_equal(getattr(whole, f.name), getattr(parts, f.name)), f.name
    none = make_features(np.zeros((0, 3)))
    assert len(move_features(none, base_of(none), residuals[:0], frames()[:0])) == 0


def test_gaussians_move_as_told() -> None:
    base = base_of(some())
    residuals = torch.zeros(20, RESIDUAL)
    residuals[:, MEAN], residuals[:, SIZE] = torch.tensor([1.0, 0, 0]), torch.tensor([0.1, 0.2, -0.3])
    residuals[:, LOGIT], residuals[:, COLOR] = 0.7, torch.tensor([0.1, -0.1, 0.2])
    moved = move_gaussians(base, residuals, frames())
    torch.testing.assert_close(moved.means, base.means + frames()[:, :, 0] * gaussian_sizes(base.scales)[:, None])
    torch.testing.assert_close(moved.scales.log() - base.scales.log(), residuals[:, SIZE], atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.logit(moved.opacities) - torch.logit(base.opacities), residuals[:, LOGIT])
    torch.testing.assert_close(SH_C0 * (moved.sh0 - base.sh0)[:, 0], residuals[:, COLOR], atol=1e-6, rtol=0)


@pytest.mark.parametrize("opacity", [0.0, 1e-6, 1.0])
def test_opacities_at_the_ends_stay_within_them(opacity: float) -> None:
    base = replace(base_of(some()), opacities=torch.full((20,), opacity))
    for logit in (-3.0, 3.0):
        residuals = torch.zeros(20, RESIDUAL)
        residuals[:, LOGIT] = logit
        moved = move_gaussians(base, residuals, frames()).opacities
        assert bool(((moved >= 0) & (moved <= 1)).all())


def test_rotations_agree_with_each_other() -> None:
    vectors = torch.randn(20, 3, generator=torch.Generator().manual_seed(3))
    quats = torch.nn.functional.normalize(torch.randn(20, 4, generator=torch.Generator().manual_seed(4)), dim=1)
    np.testing.assert_allclose(quat_to_rotmat(quats), geometry.quat_to_rotmat(quats.numpy()), atol=1e-6)
    turned = quat_to_rotmat(rotate_quats(vectors, quats))
    torch.testing.assert_close(turned, rotation_matrices(vectors) @ quat_to_rotmat(quats), atol=1e-5, rtol=0)
    quarter = rotation_matrices(torch.tensor([[0, 0, torch.pi / 2]]))[0]
    torch.testing.assert_close(quarter @ torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]), atol=1e-6, rtol=0)


def test_feature_gaussians_move_like_gaussians() -> None:
    """Means, covariances and colours alike; opacity stays with scales and follows its own column."""
    features = some()
    base = base_of(features)
    residuals = 0.3 * torch.randn(20, RESIDUAL, generator=torch.Generator().manual_seed(5))
    residuals[:, LOGIT] = 0
    residuals[:, SIZE] = residuals[:, SIZE].sort(1).values * 0.1  # scales still rise
    moved, one = move_features(features, base, residuals, frames()), move_gaussians(base, residuals, frames()).numpy()
    np.testing.assert_allclose(moved.means, one.means, atol=1e-5, rtol=1e-5)
    np.testing.assert_allclose(moved.covars, covariances(one.quats, one.scales), atol=1e-4, rtol=1e-4)
    decoded = base_of(moved)
    torch.testing.assert_close(decoded.opacities, base.opacities, atol=1e-4, rtol=0)
    residuals = torch.zeros(20, RESIDUAL)
    residuals[:, LOGIT] = np.log(2)
    doubled = base_of(move_features(features, base, residuals, frames()))
    torch.testing.assert_close(doubled.opacities, 1 - (1 - base.opacities) ** 2, atol=1e-4, rtol=0)


@pytest.mark.parametrize("raw", [1e30, -1e30, float("inf"), float("-inf"), float("nan")])
def test_whatever_comes_out_is_bounded(raw: float) -> None:
    actual = bound_residuals(torch.full((2, RESIDUAL), raw), Bounds(mean=0.5), 0.5)
    assert bool((actual.abs() <= 0.5 * residual_limits(Bounds(mean=0.5))).all())
    assert bool(torch.isfinite(actual).all())
    assert float(residual_limits(Bounds(turn=0.2))[ROTATION].max()) == pytest.approx(0.2)
