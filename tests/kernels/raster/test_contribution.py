"""The dominant superpixel of every Gaussian matches sums over a dense matrix of weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_gaussians import random_gaussians
from numpy.testing import assert_allclose
from slow_renderer import render_arrays
from sweeps import sweep

from gsmerge.method.kernels.raster.contribution import FIRST_PAIRS, add_row, dominant_labels, settle_row
from gsmerge.method.raster import make_splats, tile_view
from gsmerge.method.stages.assign import find_owners
from gsmerge.method.stages.superpixels import superpixels
from gsmerge.types import Cameras, Gaussians, Groups, Scene

WIDTH, HEIGHT = 75, 53  # not multiples of a tile
K = np.array([[60.0, 0, 36.3], [0, 62.0, 27.1], [0, 0, 1]])


def some_labels(count: int, seed: int = 0) -> np.ndarray:
    return superpixels(np.random.default_rng(seed).random((HEIGHT, WIDTH, 3)), count)


def superpixel_sums(gaussians: Gaussians, labels: np.ndarray, viewmat: np.ndarray | None = None) -> np.ndarray:
    """Return every Gaussian's weights ``[n,labels]``, one pixel after the other, float64."""
    weights = render_arrays(gaussians, np.eye(4) if viewmat is None else viewmat, K, WIDTH, HEIGHT).weights
    sums = np.zeros((labels.max() + 1, len(gaussians)))
    np.add.at(sums, labels.reshape(-1), weights.reshape(len(gaussians), -1).T)
    return sums.T


# Gaussians of a few pixels; wide ones, that reach over many rows of tiles; hardly opaque and fully opaque ones.
CASES = [(300, 0, 0.5, -3.5, 90), (80, 1, 0.5, -1.0, 200), (400, 2, 3.0, -2.5, 40), (200, 3, 0.05, -2.0, 400),
         (1, 4, 0.5, -1.0, 7), (100, 5, 0.5, -2.0, 1)]  # fmt: skip


@sweep("case", CASES, often=2)
def test_owner_is_the_superpixel_of_the_largest_sum_of_weights(case: tuple[int, int, float, float, int]) -> None:
    n, seed, opacity, size, count = case
    gaussians, labels = random_gaussians(n, seed, opacity=opacity, size=size), some_labels(count)
    tiled = tile_view(make_splats(gaussians), np.eye(4), K, WIDTH, HEIGHT)
    values, actual = dominant_labels(*tiled.lists, labels, count)
    sums = superpixel_sums(gaussians, labels)[tiled.ids]
    assert_allclose(values, sums.max(1), rtol=1e-3, atol=1e-4)
    seen = actual >= 0
    assert (seen == (values > 0)).all()
    # where two superpixels get nearly the same, either may win
    assert_allclose(sums[seen, actual[seen]], sums[seen].max(1), rtol=1e-3, atol=1e-4)
    assert sums[~seen].max(initial=0) < 1e-4
    assert (actual[seen] == sums[seen].argmax(1)).mean() > 0.98


def test_owners_are_right_where_pairs_outgrow_their_arrays() -> None:
    """Every pixel its own superpixel, and Gaussians over the whole picture: pairs outgrow their arrays."""
    gaussians = random_gaussians(400, 7, opacity=3.0, size=0.3)
    gaussians = replace(gaussians, opacities=0.01 + 0.03 * gaussians.opacities)
    labels = np.arange(HEIGHT * WIDTH, dtype=np.int32).reshape(HEIGHT, WIDTH)
    tiled = tile_view(make_splats(gaussians), np.eye(4), K, WIDTH, HEIGHT)
    values, actual = dominant_labels(*tiled.lists, labels, HEIGHT * WIDTH)
    sums = superpixel_sums(gaussians, labels)[tiled.ids]
    assert (sums[:, : 16 * WIDTH] > 0).sum() > FIRST_PAIRS
    assert_allclose(values, sums.max(1), rtol=1e-3, atol=1e-4)
    assert_allclose(sums[np.arange(len(actual)), actual], sums.max(1), rtol=1e-3, atol=1e-4)


def test_equal_sums_go_to_the_smaller_label() -> None:
    gaussians = random_gaussians(1, 0)
    middle = Gaussians(
        np.array([[0.0, 0.0, 3.0]]), np.array([[1.0, 0, 0, 0]]), np.full((1, 3), 0.2), np.array([0.5]),
        gaussians.sh0, gaussians.shN,
    )  # fmt: skip
    even = np.array([[60.0, 0, 32], [0, 60.0, 1], [0, 0, 1]])
    tiled = tile_view(make_splats(middle), np.eye(4), even, 64, 2)
    rows = np.repeat(np.array([[0], [1]], np.int32), 64, 1)
    assert dominant_labels(*tiled.lists, rows, 2)[1].tolist() == [0]
    assert dominant_labels(*tiled.lists, 1 - rows, 2)[1].tolist() == [0]


@sweep("seed", [0, 1])
def test_owner_is_in_the_view_of_the_largest_sum(seed: int) -> None:
    gaussians = random_gaussians(150, seed, size=-2.5)
    viewmats = np.stack([np.eye(4)] * 3)
    viewmats[1, 0, 3], viewmats[2, 2, 3] = 0.7, 1.0
    cameras = Cameras(viewmats, np.stack([K] * 3), WIDTH, HEIGHT)
    labels = np.stack([some_labels(60, view) for view in range(3)])
    scene = Scene(gaussians, cameras, None, None, ("a", "b", "c"))
    owners = find_owners(scene, Groups(labels, (60,) * 3))
    sums = np.stack([superpixel_sums(gaussians, labels[v], viewmats[v]) for v in range(3)], 1)
    assert_allclose(owners.values, sums.max((1, 2)), rtol=1e-3, atol=1e-4)
    seen = np.flatnonzero(owners.views >= 0)
    assert_allclose(sums[seen, owners.views[seen], owners.labels[seen]], sums[seen].max((1, 2)), rtol=1e-3, atol=1e-4)
    assert len(seen) > 100


def test_owner_is_in_the_first_of_equal_views() -> None:
    gaussians = random_gaussians(100, 3, size=-3.5)
    cameras = Cameras(np.stack([np.eye(4)] * 4), np.stack([K] * 4), WIDTH, HEIGHT)
    labels = np.stack([some_labels(30)] * 4)
    owners = find_owners(Scene(gaussians, cameras, None, None, tuple("abcd")), Groups(labels, (30,) * 4))
    assert set(owners.views.tolist()) <= {-1, 0}


@pytest.mark.parametrize(
    ("pairs", "num_pairs"),
    [
        pytest.param([(0, 1, 0), (1, 1, -1)], 2, id="a ring"),
        pytest.param([(0, 1, 1), (1, 1, 0)], 2, id="a longer ring"),
        pytest.param([(0, 0, 1), (0, 0, 2), (0, 0, -1)], 3, id="sums of zero"),
        pytest.param([(0, 1, -1)], 0, id="a pair that is not there"),
        pytest.param([(2, 1, -1)], 1, id="a label that is not there"),
        pytest.param([(np.nan, 1, -1)], 1, id="a label that is no number"),
    ],
)
def test_damaged_chains_of_pairs_are_refused(pairs: list[tuple[float, float, float]], num_pairs: int) -> None:
    rows, num_labels = np.array(pairs, float), 2
    heads, active, counts = np.zeros(1, np.int32), np.zeros(2, np.int32), np.array([num_pairs, 1, 0])
    totals, seen = np.zeros(num_labels), np.empty(num_labels, np.int32)
    values, owners = np.zeros(1, np.float32), np.zeros(1, np.int32)
    with pytest.raises(ValueError, match=r"settle_row: .*indices"):
        settle_row(
            0, np.zeros((1, 8), np.float32), heads, rows, rows.copy(), active, totals, seen, values, owners, counts
        )


@pytest.mark.parametrize(("line", "tile_width"), [(2**63 - 1, 1), (2**62, 2), (0, 2**63 - 1), (-1, 1)])
def test_rows_of_tiles_that_no_picture_has_are_refused(line: int, tile_width: int) -> None:
    labels, ids, counts = np.zeros((1, 1), np.int32), np.zeros(1, np.int32), np.zeros(3, np.int64)
    with pytest.raises(ValueError, match=r"add_row: (line|tile_width)"):
        add_row(
            np.zeros((1, 8), np.float32), ids, np.array([0, 1]), tile_width, line, labels, ids.copy(),
            np.empty((1, 3)), np.zeros(2, np.int32), np.full(1, -1, np.int32), counts,
        )  # fmt: skip
