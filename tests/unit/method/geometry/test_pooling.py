from __future__ import annotations

import numpy as np
import pytest
import scenes

from gsmerge.method.geometry.pooling import (
    Members,
    gaussian_members,
    pool_members,
    principal_axes,
    scene_members,
    to_gaussians,
)
from gsmerge.method.geometry.transforms import covariances
from gsmerge.method.kernels.elementary import exp, log, log1p
from gsmerge.types import Gaussians


def random_members(count: int, seed: int = 0, coefficients: int = 1, opacity: float | None = None) -> Members:
    rng = np.random.default_rng(seed)
    columns = (
        rng.normal(size=(count, 3)), rng.normal(size=(count, 4)), 0.05 * exp(0.3 * rng.normal(size=(count, 3))),
        np.full(count, opacity) if opacity else rng.uniform(0.2, 0.9, count), rng.normal(size=(count, 1, 3)),
        rng.normal(size=(count, coefficients - 1, 3)), np.full(count, 0.05),
    )  # fmt: skip
    *values, footprints = (np.ascontiguousarray(c, np.float32) for c in columns)
    return gaussian_members(Gaussians(*values), footprints)


def pool_all(of: Members) -> Gaussians:
    """Pool all members into one Gaussian."""
    m = pool_members(of, np.array([0, len(of.means)]), np.arange(len(of.means)))
    return to_gaussians(m.covars, m.extinctions, m.means, m.sh)


@pytest.mark.parametrize("seed", range(5))
def test_pooling_one_member_gives_itself_but_for_the_floor(seed: int) -> None:
    one = random_members(1, seed, coefficients=16)
    result = pool_all(one)
    covar = covariances(result.quats.astype(np.float64), result.scales.astype(np.float64))[0]
    np.testing.assert_allclose(result.means, one.means, rtol=1e-6)
    floor = (0.1 * 0.05) ** 2 * np.eye(3)
    np.testing.assert_allclose(
        covar,
        covariances(one.quats[0].astype(np.float64), one.scales[0].astype(np.float64)) + floor,
        rtol=1e-5,
        atol=1e-9,
    )
    np.testing.assert_allclose(result.sh0, one.sh0, rtol=1e-6)
    np.testing.assert_allclose(result.shN, one.shN, rtol=1e-6)
    # the floor makes the disc larger, and the conserved optical depth thinner by as much
    before, after = np.sort(one.scales[0].astype(float)), np.sort(result.scales[0].astype(np.float64))
    depth = -log1p(-one.opacities[0]) * before[1:].prod() / after[1:].prod()
    assert float(result.opacities[0]) == pytest.approx(1 - np.exp(-depth), rel=1e-5)
    assert float(result.opacities[0]) == pytest.approx(one.opacities[0], rel=0.05)


def test_pooling_two_members_is_as_by_hand() -> None:
    """Balls of radius 1 at x = 0 and 4, opacities 0.3 and 0.1: weights 3 to 1."""
    two = random_members(2, opacity=0.3)
    two.opacities[1] = 0.1
    two.means[:] = [[0, 0, 0], [4, 0, 0]]
    two.quats[:] = [1, 0, 0, 0]
    two.scales[:] = 1
    two.footprints[:] = 1e-6
    two.sh0[:, 0] = [[0, 0, 0], [1, 2, 4]]
    result = pool_all(two)
    np.testing.assert_allclose(result.means[0], [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(np.sort(result.scales[0]), [1, 1, 2], rtol=1e-6)
    np.testing.assert_allclose(result.sh0[0, 0], [0.25, 0.5, 1], rtol=1e-6)
    depth = -(log(0.7) + log(0.9)) / 2  # two unit discs over the disc of 2 x 1
    assert float(result.opacities[0]) == pytest.approx(1 - np.exp(-depth), rel=1e-5)


def test_pooling_the_tiles_of_a_sheet_keeps_it_closed() -> None:
    """A square of n x n tiles: the peak optical depth is 12 / 2 pi times the sheet's mean (stability.md)."""
    n, sigma, depth = 40, 0.6, 0.7
    xs, ys = np.meshgrid(np.arange(n), np.arange(n))
    sheet = random_members(n * n, opacity=1 - exp(-depth))
    sheet.means[:] = np.stack([xs.ravel(), ys.ravel(), np.zeros(n * n)], 1)
    sheet.quats[:] = [1, 0, 0, 0]
    sheet.scales[:] = [sigma, sigma, 0.1]
    sheet.footprints[:] = 1e-3
    result = pool_all(sheet)
    mean_depth = depth * 2 * np.pi * sigma**2  # per unit area
    peak = -log1p(-float(result.opacities[0]))
    assert peak == pytest.approx(mean_depth * 12 / (2 * np.pi), rel=0.01)


def test_pooling_many_groups_matches_pooling_one_by_one() -> None:
    """More groups than one task takes."""
    of = random_members(9000)
    starts = np.arange(0, 9001, 2)
    at_once = pool_members(of, starts, np.arange(9000))
    for g in (0, 4095 // 2, 4096 // 2 + 1, 4499):
        alone = pool_members(of, np.array([0, 2]), np.arange(2 * g, 2 * g + 2))
        for name in at_once.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(at_once, name)[g], getattr(alone, name)[0])


def test_pooling_by_the_rule_of_the_paper_is_as_by_hand() -> None:
    """Spread of the means alone, and an opacity that is the members' mean."""
    of = random_members(3)
    of.means[:] = [[0, 0, 0], [2, 0, 0], [0, 4, 0]]
    of.opacities[:] = [0.2, 0.2, 0.4]
    m = pool_members(of, np.array([0, 3]), np.arange(3), "paper")
    np.testing.assert_allclose(m.means[0], [0.5, 2, 0], atol=1e-6)
    floor = 0.005**2
    np.testing.assert_allclose(m.covars[0], [[0.75 + floor, -1, 0], [-1, 4 + floor, 0], [0, 0, floor]], atol=1e-6)
    made = to_gaussians(m.covars, m.extinctions, m.means, m.sh)
    assert float(made.opacities[0]) == pytest.approx(0.8 / 3, rel=1e-5)


def test_scales_of_an_empty_covariance_are_above_zero() -> None:
    scales, quats = principal_axes(np.zeros((1, 3, 3)))
    assert (scales > 0).all()
    np.testing.assert_allclose(np.linalg.norm(quats), 1)


def test_footprints_of_members_are_depth_over_focal_length() -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24), degree=1)
    actual = scene_members(scene)
    assert actual.sh0.shape == (3 * 24 * 32, 1, 3)
    assert actual.shN.shape == (3 * 24 * 32, 3, 3)
    _, depths, _ = scenes.trace(scenes.room(), scene.cameras)
    np.testing.assert_allclose(actual.footprints, depths.ravel() / 32, rtol=1e-5)
    for values in (actual.means, actual.quats, actual.scales, actual.opacities, actual.sh0, actual.shN):
        assert values.dtype == np.float32
        assert values.flags.c_contiguous
