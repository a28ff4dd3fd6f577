"""The renderer's kernels one by one, against obvious twins."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from renderer import footprints, view_colors

from gsmerge import Gaussians
from gsmerge.kernels.raster import binning, harmonics
from gsmerge.render import plan_view, prepare

RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    "values",
    [
        np.empty(0),
        np.ones(1),
        np.ones(100),
        RNG.uniform(0.01, 100, 5000),
        RNG.lognormal(0, 20, 5000),
        RNG.choice([0.5, 0.5000001, 2.0, 1e30], 1000),
        np.array([1e-38, 3e38, 1.0]),
    ],
    ids=["none", "one", "equal", "usual", "wide", "ties", "extremes"],
)
def test_depth_order_is_a_stable_sort(values: np.ndarray) -> None:
    depths = values.astype(np.float32)
    np.testing.assert_array_equal(binning.depth_order(depths.view(np.uint32)), np.argsort(depths, kind="stable"))


def random_boxes(count: int, lines: int, columns: int) -> np.ndarray:
    """First and exclusive last column and row; every fifth one empty."""
    x, y = np.sort(RNG.integers(0, columns + 1, (count, 2)), 1), np.sort(RNG.integers(0, lines + 1, (count, 2)), 1)
    boxes = np.concatenate([x, y], 1).astype(np.int16)
    boxes[(boxes[:, 1] == boxes[:, 0]) | (boxes[:, 3] == boxes[:, 2])] = 0
    boxes[::5] = 0
    return boxes


@pytest.mark.parametrize(("lines", "columns"), [(1, 1), (1, 9), (9, 1), (5, 7)])
def test_tile_lists(lines: int, columns: int) -> None:
    boxes, order = random_boxes(200, lines, columns), RNG.permutation(200).astype(np.int32)
    expected: list[list[int]] = [[] for _ in range(lines * columns)]
    for k, (x0, x1, y0, y1) in zip(order.tolist(), boxes[order].tolist(), strict=True):
        for y in range(y0, y1):
            for x in range(x0, x1):
                expected[y * columns + x].append(k)
    counts = binning.count_tiles(boxes, lines, columns)
    assert counts.tolist() == [len(tile) for tile in expected]
    members, starts = np.full(counts.sum(), -1, np.int32), np.cumsum(counts) - counts
    binning.deal_tiles(order, boxes[order], columns, starts.copy(), members)
    assert members.tolist() == [k for tile in expected for k in tile]


@pytest.mark.parametrize("degree", range(5))
def test_view_colors(degree: int) -> None:
    means = RNG.normal(size=(50, 3)).astype(np.float32)
    sh0 = RNG.normal(size=(50, 1, 3)).astype(np.float32)
    shN = RNG.normal(size=(50, (degree + 1) ** 2 - 1, 3)).astype(np.float32)
    eye, ids = np.array([0.3, -2.0, 1.0], np.float32), np.arange(1, 50, 2, dtype=np.int32)
    colors = np.full((25, 3), -1, np.float32)
    harmonics.view_colors(means, sh0, shN, ids, eye, 0, 25, colors)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = -torch.from_numpy(eye).double()
    sh = torch.from_numpy(np.concatenate([sh0, shN], 1)).double()
    np.testing.assert_allclose(colors, view_colors(torch.from_numpy(means).double(), sh, viewmat)[ids], atol=1e-5)
    assert (colors == 0).any()


def random_gaussians(n: int, seed: int, *, spread: float, depth: float, sizes: float) -> Gaussians:
    """About a point on the axis, with quaternions of any length."""
    rng = np.random.default_rng(seed)
    columns = (
        rng.normal(size=(n, 3)) * spread + [0, 0, depth], rng.normal(size=(n, 4)),
        np.exp(rng.normal(size=(n, 3)) * sizes - 3), rng.random(n), np.zeros((n, 1, 3)), np.zeros((n, 0, 3)),
    )  # fmt: skip
    return Gaussians(*(column.astype(np.float32) for column in columns))


def slow_footprints(gaussians: Gaussians, viewmat: np.ndarray, K: np.ndarray, *size: int) -> tuple[np.ndarray, ...]:
    """Image positions ``[n,2]``, undilated covariances ``[n,2,2]`` and depths ``[n]``."""
    columns = (torch.from_numpy(c).double() for c in (gaussians.means, gaussians.quats, gaussians.scales))
    return tuple(t.numpy() for t in footprints(*columns, torch.from_numpy(viewmat), torch.from_numpy(K), *size))


def test_footprints() -> None:
    """Position, precision and rows of what a plan holds; a row is listed if a pixel column could reach 1/255."""
    n, width, height = 300, 60, 40
    gaussians = random_gaussians(n, 0, spread=0.6, depth=3, sizes=1.0)
    K, viewmat = np.array([[50.0, 0, 30], [0, 50.0, 20], [0, 0, 1]]), np.eye(4)
    plan = plan_view(prepare(gaussians), viewmat, K, width, height)
    positions, covars, depths = slow_footprints(gaussians, viewmat, K, width, height)
    ids = plan.ids
    mean_x, mean_y, rate_x, slope, rate_y, lnop, first, last = plan.footprints.T.astype(np.float64)
    np.testing.assert_allclose(np.stack([mean_x, mean_y], 1), positions[ids], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(plan.depths, depths[ids], rtol=1e-5)
    conics = np.linalg.inv(covars + 0.3 * np.eye(2))[ids]
    np.testing.assert_allclose(2 * rate_x**2, conics[:, 0, 0], rtol=1e-3)
    np.testing.assert_allclose(-2 * rate_x**2 * slope, conics[:, 0, 1], rtol=1e-2, atol=1e-4)
    np.testing.assert_allclose(2 * (rate_x**2 * slope**2 + rate_y), conics[:, 1, 1], rtol=1e-3)
    np.testing.assert_allclose(np.exp(lnop), gaussians.opacities[ids], rtol=1e-5)

    rows = np.arange(height)[:, None] + 0.5
    reached = (lnop - rate_y * (rows - mean_y) ** 2 >= np.log(1 / 255)) & np.isin(np.arange(len(ids)), plan.members)
    listed = (rows - 0.5 >= first) & (rows - 0.5 <= last)
    assert (listed | ~reached).all()
    assert (listed == reached)[:, reached.any(0)].mean() > 0.999


def test_no_gaussian_that_adds_light_is_missing() -> None:
    """Culling and boxes drop only what stays below 1/255 in every pixel."""
    n, width, height = 2000, 50, 40
    gaussians = random_gaussians(n, 1, spread=2.0, depth=2, sizes=1.5)
    K, viewmat = np.array([[50.0, 0, 25], [0, 50.0, 20], [0, 0, 1]]), np.eye(4)
    plan = plan_view(prepare(gaussians), viewmat, K, width, height)
    positions, covars, depths = slow_footprints(gaussians, viewmat, K, width, height)
    conics = np.linalg.inv(covars + 0.3 * np.eye(2))
    ys, xs = np.mgrid[:height, :width] + 0.5
    offsets = np.stack([xs, ys], -1).reshape(1, -1, 2) - positions[:, None]
    distances = ((offsets @ conics) * offsets).sum(-1)
    alphas = gaussians.opacities[:, None] * np.exp(-0.5 * distances)
    visible = (alphas.max(1) > 1.001 / 255) & (depths > 0.01)
    drawn = set(plan.ids[np.unique(plan.members)].tolist())
    assert set(np.flatnonzero(visible).tolist()) <= drawn
    # boxes have corners that their ellipses do not fill, and culling only looks at the longest axis
    assert visible.sum() > 0.9 * len(drawn)
    assert len(drawn) > 0.6 * len(plan.ids)
