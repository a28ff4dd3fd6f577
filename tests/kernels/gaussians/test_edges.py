"""Gaussians cut at the edges of photos match the formulas of the truncated normal distribution."""

from __future__ import annotations

from math import erf, exp, pi, sqrt

import numpy as np
import pytest
from made_gaussians import random_gaussians

from gsmerge.geometry.transforms import covariances
from gsmerge.kernels.gaussians.optimise import NUM_EDGES, cut_at_edges
from gsmerge.types import Gaussians

REACH = 2.0


def make_planes(views: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Make planes of cameras near the origin that look along z, each with a frustum of its own."""
    random = np.random.default_rng(seed)
    left, right, top, bottom = random.uniform([-0.9, 0.2, -0.7, 0.1], [-0.2, 0.9, -0.1, 0.7], (views, 4)).T
    zero, one = np.zeros(views), np.ones(views)
    sides = (-one, zero, left), (one, zero, -right), (zero, -one, top), (zero, one, -bottom)
    normals = np.stack([np.stack(side, 1) for side in sides], 1)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return normals, (normals * random.normal(0, 0.3, (views, 1, 3))).sum(2)


def cut_slowly(mean: np.ndarray, covar: np.ndarray, normals: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return mean and covariance of one Gaussian after two cuts at most, and whether it is cut."""
    is_cut = False
    for _ in range(2):
        sigmas = np.array([[sqrt(n @ covar @ n) for n in view] for view in normals])
        rooms = (offsets - normals @ mean) / sigmas
        view = int(rooms.min(1).argmax())
        edge = int(rooms[view].argmin())
        room, sigma, normal = rooms[view, edge], sigmas[view, edge], normals[view, edge]
        if not -REACH < room < REACH:
            break
        hazard = exp(-room * room / 2) / sqrt(2 * pi) / (0.5 + 0.5 * erf(room / sqrt(2)))
        across, is_cut = covar @ normal, True
        mean = mean - across / sigma * hazard
        covar = covar - np.outer(across, across) * hazard * (hazard + room) / sigma**2
    return mean, covar, np.array(is_cut)


def cut(gaussians: Gaussians, normals: np.ndarray, offsets: np.ndarray, *spans: tuple[int, int]) -> tuple:
    """Return the kernel's means, covariances and marks."""
    means, num = gaussians.means.astype(np.float32), len(gaussians)
    covars, is_cut = np.full((num, 3, 3), np.nan), np.zeros(num, np.uint8)
    columns = gaussians.quats.astype(np.float32), gaussians.scales.astype(np.float32)
    for first, last in spans or [(0, num)]:
        cut_at_edges(*columns, normals, offsets, first, last, means, covars, is_cut)
    return means, covars, is_cut.astype(bool)


@pytest.mark.parametrize(("count", "views", "seed"), [(300, 1, 0), (300, 5, 1), (200, 12, 2), (0, 3, 3), (1, 2, 4)])
def test_cut_gaussians_match_the_truncated_normal_distribution(count: int, views: int, seed: int) -> None:
    gaussians, planes = random_gaussians(count, seed, size=-2.0), make_planes(views, seed)
    means, covars, is_cut = cut(gaussians, *planes)
    whole = covariances(gaussians.quats.astype(np.float64), gaussians.scales.astype(np.float64))
    for i in range(count):
        mean, covar, expected = cut_slowly(gaussians.means[i].astype(np.float64), whole[i], *planes)
        assert is_cut[i] == expected
        np.testing.assert_allclose(means[i], mean, rtol=1e-5, atol=1e-5)
        if expected:
            np.testing.assert_allclose(covars[i], covar, rtol=1e-4, atol=1e-5 * np.trace(whole[i]))
    assert count < 200 or 0.1 < is_cut.mean() < 0.9


def test_gaussians_cut_in_pieces_are_those_cut_at_once() -> None:
    gaussians, planes = random_gaussians(100, 5), make_planes(3, 5)
    for whole, pieces in zip(
        cut(gaussians, *planes), cut(gaussians, *planes, (0, 33), (33, 33), (33, 100)), strict=True
    ):
        np.testing.assert_array_equal(whole, pieces)


def test_cut_gaussian_has_the_moments_of_the_part_inside() -> None:
    """Points drawn from a Gaussian that one edge cuts, those beyond left out."""
    normals = np.zeros((1, NUM_EDGES, 3))
    normals[0, :, 0] = 1
    gaussian = random_gaussians(1, 6)
    mean = gaussian.means[0].astype(np.float64)
    whole = covariances(gaussian.quats.astype(np.float64), gaussian.scales.astype(np.float64))[0]
    sigma = sqrt(whole[0, 0])
    offsets = mean[0] + sigma * np.array([[0.7, 9, 9, 9]])
    points = np.random.default_rng(7).multivariate_normal(mean, whole, 400_000)
    inside = points[points[:, 0] <= offsets[0, 0]]
    means, covars, is_cut = cut(gaussian, normals, offsets)
    assert is_cut.all()
    # the second cut of the kernel takes away what reaches beyond of the moments of the first
    first = cut_once(mean, whole, normals[0, 0], offsets[0, 0])
    np.testing.assert_allclose(inside.mean(0), first[0], atol=0.01 * sigma)
    np.testing.assert_allclose(np.cov(inside.T), first[1], atol=0.02 * np.trace(whole))
    assert normals[0, 0] @ means[0] < normals[0, 0] @ first[0]
    assert covars[0, 0, 0] < first[1][0, 0]


def cut_once(mean: np.ndarray, covar: np.ndarray, normal: np.ndarray, offset: float) -> tuple[np.ndarray, np.ndarray]:
    """Return moments of what lies inside of one plane."""
    sigma = sqrt(normal @ covar @ normal)
    room = (offset - normal @ mean) / sigma
    hazard = exp(-room * room / 2) / sqrt(2 * pi) / (0.5 + 0.5 * erf(room / sqrt(2)))
    across = covar @ normal
    return mean - across / sigma * hazard, covar - np.outer(across, across) * hazard * (hazard + room) / sigma**2


def test_gaussians_inside_or_far_outside_stay_uncut() -> None:
    normals, offsets = make_planes(1, 8)
    offsets = np.zeros_like(offsets)
    gaussians = random_gaussians(2, 8)
    gaussians.means[:] = [(0, 0, 5), (50, 0, 5)]
    gaussians.scales[:] = 0.01
    means, _, is_cut = cut(gaussians, normals, offsets)
    assert not is_cut.any()
    np.testing.assert_array_equal(means, gaussians.means)


def test_without_photos_nothing_is_cut() -> None:
    assert not cut(random_gaussians(20, 9), np.zeros((0, NUM_EDGES, 3)), np.zeros((0, NUM_EDGES)))[2].any()
