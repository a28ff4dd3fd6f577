"""The backing layer's kernels against slow, obvious numpy in float64."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from renderer import footprints as project_footprints
from torch import from_numpy

from gsmerge.kernels.gaussians.backing import draw_in, image_extinctions


def draw_in_reference(groups: list[np.ndarray], depths: np.ndarray, pixel: float) -> np.ndarray:
    """Factors on the depth: at most sqrt(n) pixels of relative inverse depth away from the group's median."""
    factors = np.ones(len(depths))
    for rows in groups:
        inverse = 1 / depths[rows]
        middle = np.sort(inverse)[len(rows) // 2]
        reach = min(pixel * len(rows) ** 0.5, 0.9)
        drawn = np.clip(inverse, middle * (1 - reach), middle * (1 + reach))
        factors[rows] = inverse / drawn
    return factors


@pytest.mark.parametrize("pixel", [1e-3, 0.02, 1.0])
def test_draw_in_matches(pixel: float) -> None:
    rng = np.random.default_rng(0)
    depths = np.exp(rng.normal(size=60))
    ids = rng.permutation(50)  # ten members belong to no group
    starts = np.array([0, 1, 3, 3, 20, 50])
    groups = [ids[a:b] for a, b in pairwise(starts) if b > a]
    factors = np.ones(60)
    draw_in(starts, ids, 1 / depths, pixel, factors)
    np.testing.assert_allclose(factors, draw_in_reference(groups, depths, pixel), rtol=1e-12)


def test_drawn_depths_are_within_a_group_footprint() -> None:
    rng = np.random.default_rng(1)
    depths = np.where(rng.random(40) < 0.4, 2.0, 9.0) * rng.uniform(0.99, 1.01, 40)
    factors = np.ones(40)
    draw_in(np.array([0, 40]), np.arange(40), 1 / depths, 0.01, factors)
    drawn = depths * factors
    assert drawn.max() / drawn.min() < 1.2
    assert drawn.max() / drawn.min() > 1.05


def test_image_extinctions_match() -> None:
    """Optical depth times area in the image; the footprints come from the slow renderer."""
    rng = np.random.default_rng(2)
    n = 40
    means = (rng.normal(size=(n, 3)) * 0.3 + [0, 0, 3]).astype(np.float32)
    quats = rng.normal(size=(n, 4)).astype(np.float32)
    scales = np.exp(rng.normal(size=(n, 3)) - 4).astype(np.float32)
    opacities = rng.uniform(0, 1, n).astype(np.float32)
    pixels = rng.uniform(0.01, 0.02, n).astype(np.float32)
    turn = np.linalg.qr(rng.normal(size=(3, 3)) * 0.1 + np.eye(3))[0]
    turn *= np.sign(np.diag(turn))
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turn, [0.1, -0.2, 0.3]
    fx, fy = 50.0, 60.0
    starts, ids = np.array([0, 1, 12, 40]), rng.permutation(n)
    out = np.zeros(3)
    image_extinctions(starts, ids, means, quats, scales, opacities, pixels, viewmat, fx, fy, out)

    K = np.array([[fx, 0, 2000], [0, fy, 2000], [0, 0, 1]])
    for g in range(3):
        rows = ids[starts[g] : starts[g + 1]]
        extents = scales[rows].max(1).astype(float) / pixels[rows]
        caps = np.minimum(1, 3 * np.sort(extents)[(len(rows) - 1) // 2] / extents)
        columns = [means[rows], quats[rows], scales[rows] * caps[:, None]]
        _, covars, _ = project_footprints(
            *(from_numpy(np.asarray(c, float)) for c in columns), from_numpy(viewmat), from_numpy(K), 4000, 4000
        )
        areas = np.sqrt(np.maximum(np.linalg.det(covars.numpy()), 0))
        depths = -np.log(1 - np.minimum(opacities[rows].astype(float), 0.995))
        assert out[g] == pytest.approx((depths * areas).sum(), rel=1e-4)
