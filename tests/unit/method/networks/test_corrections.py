"""Corrections move Gaussians by their formulas, within bounds."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from scenes import make_features

from gsmerge.method.geometry import transforms
from gsmerge.method.geometry.pooling import feature_to_gaussians
from gsmerge.method.geometry.transforms import covariances, quat_to_rotmat
from gsmerge.method.kernels import elementary
from gsmerge.method.networks.corrections import (
    COLOR_COLUMNS,
    LOGIT_COLUMN,
    MASS_COLUMN,
    MEAN_COLUMNS,
    ROTATION_COLUMNS,
    SIZE_COLUMNS,
    move_features,
    move_gaussians,
    residual_limits,
)
from gsmerge.method.networks.options import FEATURE, RESIDUAL, Bounds
from gsmerge.types import SH_C0, FeatureGaussians, Gaussians

EACH = np.arange(20)  # its own group


def some(count: int = 20) -> FeatureGaussians:
    rng = np.random.default_rng(0)
    features = make_features(rng.normal(size=(count, 3)), opacities=0.6)
    half = rng.normal(size=(count, 3, 3)).astype(np.float32)
    covars = half @ half.swapaxes(1, 2)
    scales = np.sqrt(np.linalg.eigvalsh(covars).clip(1e-6))
    return replace(features, covars=covars, extinctions=-float(elementary.log(0.4)) * scales[:, 1] * scales[:, 2])


def move(gaussians: Gaussians, residuals: np.ndarray, owners: np.ndarray, axes: np.ndarray) -> Gaussians:
    """Move Gaussians by the corrections of Feature Gaussians, without their last column."""
    return move_gaussians(gaussians, residuals[:, :RESIDUAL].copy(), owners, axes)


def base_of(features: FeatureGaussians) -> Gaussians:
    """Return the Gaussian of each, in C order."""
    return Gaussians(*(np.ascontiguousarray(column) for column in vars(feature_to_gaussians(features)).values()))


def frames(count: int = 20, seed: int = 1) -> np.ndarray:
    return quat_to_rotmat(np.random.default_rng(seed).normal(size=(count, 4))).astype(np.float32)


def noise(count: int = 20, seed: int = 5) -> np.ndarray:
    return 0.3 * np.random.default_rng(seed).normal(size=(count, FEATURE)).astype(np.float32)


def zeros() -> np.ndarray:
    return np.zeros((20, FEATURE), np.float32)


def test_corrections_of_zero_change_no_bit() -> None:
    features = some()
    base = base_of(features)
    for before, after in (
        (base, move(base, zeros(), EACH, frames())),
        (features, move_features(features, base, zeros(), frames())),
    ):
        for f in fields(before):
            assert np.array_equal(getattr(before, f.name), getattr(after, f.name)), f.name


@pytest.mark.parametrize("rows", [1, 7, 20])
def test_any_number_of_rows_at_once_gives_the_same_bits(rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    features, base = some(), base_of(some())

    def moved() -> list[Gaussians | FeatureGaussians]:
        own = EACH[::-1].copy()
        return [move_features(features, base, noise(), frames()), move(base, noise(), own, frames())]

    whole = moved()
    monkeypatch.setattr("gsmerge.method.networks.corrections.CORRECTION_ROWS", rows)
    for one, other in zip(whole, moved(), strict=True):
        for f in fields(one):
            assert np.array_equal(getattr(one, f.name), getattr(other, f.name)), f.name
    none = make_features(np.zeros((0, 3)))
    assert len(move_features(none, base_of(none), noise()[:0], frames()[:0])) == 0
    assert len(move(base[:0], noise()[:0], EACH[:0], frames())) == 0


def test_corrections_move_gaussians_by_their_formulas() -> None:
    base, residuals = base_of(some()), zeros()
    residuals[:, MEAN_COLUMNS], residuals[:, SIZE_COLUMNS] = [1.0, 0, 0], [0.1, 0.2, -0.3]
    residuals[:, LOGIT_COLUMN], residuals[:, COLOR_COLUMNS] = 0.7, [0.1, -0.1, 0.2]
    moved = move(base, residuals, EACH, frames())
    sizes = np.sqrt(np.sort(base.scales, 1)[:, 1:].prod(1))
    np.testing.assert_allclose(moved.means, base.means + frames()[:, :, 0] * sizes[:, None], atol=1e-6)
    np.testing.assert_allclose(np.log(moved.scales) - np.log(base.scales), residuals[:, SIZE_COLUMNS], atol=1e-5)
    logits = [elementary.log(g.opacities / (1 - g.opacities)) for g in (base, moved)]
    np.testing.assert_allclose(logits[1] - logits[0], residuals[:, LOGIT_COLUMN], atol=1e-5)
    np.testing.assert_allclose(SH_C0 * (moved.sh0 - base.sh0)[:, 0], residuals[:, COLOR_COLUMNS], atol=1e-6)


def test_corrections_of_tensors_are_those_of_arrays(torch: Any) -> None:
    """Training's Gaussians, through which gradients flow, are those of use."""
    from gsmerge.method.networks import tensors

    base, own = base_of(some()), np.random.default_rng(2).integers(0, 20, 20)
    actual = move(base, noise(), own, frames())
    expected = tensors.move_tensors(base.to("cpu"), torch.from_numpy(noise()), torch.from_numpy(frames()[own])).numpy()
    for f in fields(actual):
        one, other = getattr(actual, f.name), getattr(expected, f.name)
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6, err_msg=f.name)


@pytest.mark.parametrize("opacity", [0.0, 1e-6, 1.0])
@pytest.mark.parametrize("logit", [-3.0, 3.0])
def test_opacities_of_0_and_1_stay_within_0_and_1(logit: float, opacity: float) -> None:
    base = replace(base_of(some()), opacities=np.full(20, opacity, np.float32))
    residuals = zeros()
    residuals[:, LOGIT_COLUMN] = logit
    moved = move(base, residuals, EACH, frames()).opacities
    assert ((moved >= 0) & (moved <= 1)).all()


def test_rotations_of_means_and_covariances_agree(torch: Any) -> None:
    """A quaternion and a covariance turn alike, also by more than a whole turn."""
    from gsmerge.method.networks import tensors

    features, residuals = some(), zeros()
    residuals[:, ROTATION_COLUMNS] = 3 * np.random.default_rng(3).normal(size=(20, 3))
    base = base_of(features)
    turned, one = move_features(features, base, residuals, frames()), move(base, residuals, EACH, frames())
    np.testing.assert_allclose(turned.covars, covariances(one.quats, one.scales), atol=1e-4, rtol=1e-4)
    quarter = zeros()
    quarter[:, ROTATION_COLUMNS] = [0, 0, np.pi / 2]
    same = np.tile(np.eye(3, dtype=np.float32), (20, 1, 1))
    round_ones = replace(base, quats=np.tile(np.float32([1, 0, 0, 0]), (20, 1)))
    quats = move(round_ones, quarter, EACH, same).quats
    np.testing.assert_allclose(transforms.quat_to_rotmat(quats) @ [1.0, 0, 0], [[0.0, 1, 0]] * 20, atol=1e-6)
    np.testing.assert_allclose(
        tensors.quat_to_rotmat(torch.from_numpy(quats)), transforms.quat_to_rotmat(quats), atol=1e-6
    )


def test_feature_gaussians_move_like_gaussians() -> None:
    """Means, covariances and colours alike; opacity stays with scales and follows its own column."""
    features = some()
    base, residuals = base_of(features), noise()
    residuals[:, LOGIT_COLUMN] = 0
    residuals[:, SIZE_COLUMNS] = np.sort(residuals[:, SIZE_COLUMNS], 1) * 0.1  # scales still rise
    moved = move_features(features, base, residuals, frames())
    one = move(base, residuals, EACH, frames())
    np.testing.assert_allclose(moved.means, one.means, atol=1e-5, rtol=1e-5)
    np.testing.assert_allclose(moved.covars, covariances(one.quats, one.scales), atol=1e-4, rtol=1e-4)
    decoded = base_of(moved)
    np.testing.assert_allclose(decoded.opacities, base.opacities, atol=1e-4)
    residuals = zeros()
    residuals[:, LOGIT_COLUMN] = elementary.log(2)
    doubled = base_of(move_features(features, base, residuals, frames()))
    np.testing.assert_allclose(doubled.opacities, 1 - (1 - base.opacities) ** 2, atol=1e-4)
    residuals[:, MASS_COLUMN] = elementary.log(3)
    heavier = move_features(features, base, residuals, frames())
    np.testing.assert_allclose(heavier.masses, 6 * features.masses, rtol=1e-5)


def test_limits_of_corrections_are_their_bounds() -> None:
    limits = residual_limits(Bounds(mean=0.5, turn=0.2))
    assert limits.tolist() == np.float32([0.5] * 3 + [1.1] * 3 + [0.2] * 3 + [3.0] + [0.25] * 3 + [3.0]).tolist()
