"""Merging regions matches slow, obvious numpy."""

from __future__ import annotations

import numpy as np
import pytest
from sweeps import sweep

from gsmerge.method.kernels import elementary
from gsmerge.method.kernels.superpixels import merge_tree as kernels
from gsmerge.method.kernels.superpixels.bass import hexagonal_seeds, voronoi
from gsmerge.method.kernels.superpixels.regions import pad_labels
from gsmerge.method.kernels.superpixels.ward import adjacent_pairs

SLOPE_RIDGE = 1e-3  # square pixels, as in merge_tree.c

HEIGHT, WIDTH, COUNT = 14, 19, 24
DEPTH_WEIGHT, COMPACTNESS = 3.0, 1e-4


class View:
    """A picture with depths, some pixels invalid (depth 0), cut into 24 regions."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.pixels = rng.random((HEIGHT, WIDTH, 3), dtype=np.float32)
        self.depths = elementary.exp(0.4 * rng.normal(size=(HEIGHT, WIDTH))).astype(np.float32)
        self.depths[rng.random((HEIGHT, WIDTH)) < 0.1] = 0
        self.labels = voronoi(hexagonal_seeds(HEIGHT, WIDTH, COUNT), HEIGHT, WIDTH)
        self.y, self.x = np.mgrid[:HEIGHT, :WIDTH] + 0.5

    def colour_error(self, mask: np.ndarray) -> float:
        mask = mask & (self.depths > 0)
        return float(((self.pixels[mask] - self.pixels[mask].mean(0, dtype=float)) ** 2).sum()) if mask.any() else 0.0

    def plane_error(self, mask: np.ndarray) -> float:
        """Fit z (a x + b y + c) to 1 by least squares, the slopes damped; in coordinates about the region's middle."""
        mask = mask & (self.depths > 0)
        if not mask.any():
            return 0.0
        z = self.depths[mask].astype(float)
        x, y = (np.append(c[mask] - np.average(c[mask], weights=z**2), 0) for c in (self.x, self.y))
        ridge = np.sqrt(SLOPE_RIDGE * (z**2).sum())
        rows = np.append(z, 0)[:, None] * np.stack([x, y, np.ones_like(x)], 1)
        system = np.concatenate([rows[:-1], [[ridge, 0, 0], [0, ridge, 0]]])
        expected = np.append(np.ones(len(z)), [0, 0])
        solution = np.linalg.lstsq(system, expected, rcond=None)[0]
        return float(((system @ solution - expected) ** 2).sum())

    def error(self, mask: np.ndarray) -> float:
        return self.colour_error(mask) + DEPTH_WEIGHT * self.plane_error(mask)

    def place_error(self, mask: np.ndarray) -> float:
        places = np.stack([self.y, self.x], -1)[mask & (self.depths > 0)]
        return float(((places - places.mean(0)) ** 2).sum()) if len(places) else 0.0

    def extent(self, mask: np.ndarray) -> float:
        used = mask & (self.depths > 0)
        return max(np.ptp(self.y[used]), np.ptp(self.x[used])) if used.any() else 0.0

    def rows(self) -> tuple[np.ndarray, float]:
        rows = np.empty((2 * COUNT, kernels.TREE_COLUMNS))
        return rows, kernels.region_sums(pad_labels(self.labels), self.pixels, self.depths, COUNT, rows)

    def merges(self, max_extent: float = 1e9) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        pairs = adjacent_pairs(pad_labels(self.labels))
        return kernels.merge_order(pairs, self.rows()[0], DEPTH_WEIGHT, COMPACTNESS, max_extent)

    def growths_of(self, a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
        return tuple(f(a | b) - f(a) - f(b) for f in (self.error, self.place_error))


def merge_reference(view: View, max_extent: float) -> tuple[list[int], list[float], list[float]]:
    """Merge the cheapest pair of neighbours of all, again and again."""
    masks = {i: view.labels == i for i in range(COUNT)}
    touching = {tuple(sorted(p)) for p in adjacent_pairs(pad_labels(view.labels)).tolist()}
    parents, heights, growths = [-1] * (2 * COUNT - 1), [0.0] * (2 * COUNT - 1), []
    costs = {}
    for node in range(COUNT, 2 * COUNT - 1):
        for u, v in touching - costs.keys():
            error, place = view.growths_of(masks[u], masks[v])
            oversize = view.extent(masks[u] | masks[v]) >= max_extent
            costs[u, v] = error + COMPACTNESS * place + kernels.OVERSIZE * oversize, error
        u, v = min(touching, key=lambda pair: costs[pair])
        parents[u] = parents[v] = node
        masks[node] = masks[u] | masks[v]
        heights[node] = max(costs[u, v][0], heights[u], heights[v])
        growths.append(costs[u, v][1])
        renamed = {tuple(sorted(node if i in (u, v) else i for i in pair)) for pair in touching}
        touching = {pair for pair in renamed if pair[0] != pair[1]}
    return parents, heights[COUNT:], growths


@pytest.mark.parametrize("seed", range(3))
def test_sums_of_leaves_match_their_pixels(seed: int) -> None:
    view = View(seed)
    rows, colour_error = view.rows()
    masks = [view.labels == i for i in range(COUNT)]
    assert colour_error == pytest.approx(sum(map(view.colour_error, masks)), rel=1e-9)
    np.testing.assert_allclose(rows[:COUNT, kernels.PLANE_ERROR], [view.plane_error(m) for m in masks], atol=1e-9)
    assert rows[:COUNT, kernels.TREE_PIXELS].tolist() == [((view.depths > 0) & m).sum() for m in masks]


@pytest.mark.parametrize("max_extent", [1e9, 9.0])
@sweep("seed", range(3))
def test_merges_match_a_slow_twin(seed: int, max_extent: float) -> None:
    view = View(seed)
    parents, heights, growths = view.merges(max_extent)
    expected = merge_reference(view, max_extent)
    assert parents.tolist() == expected[0]
    np.testing.assert_allclose(heights, expected[1], rtol=1e-7)
    np.testing.assert_allclose(growths, expected[2], atol=1e-8)


def test_regions_without_pixels_cost_nothing() -> None:
    view = View(0)
    view.depths[view.labels < 10] = 0
    parents, heights, growths = view.merges()
    assert parents.tolist() == merge_reference(view, 1e9)[0] or (heights[:10] == 0).all()
    assert (np.sort(growths)[:10] == 0).all()
    assert (parents[:-1] >= 0).all()


@pytest.mark.parametrize(
    ("keep", "expected"),
    [
        ([False] * 4, [0, 1, 2, 3, 4]),
        ([True, False, False, False], [0, 0, 1, 2, 3]),
        ([True, True, False, False], [0, 0, 1, 2, 2]),
        ([True] * 3 + [False], [0, 0, 0, 1, 1]),
        ([True] * 4, [0] * 5),
    ],
)
def test_cut_of_a_tree_numbers_its_leaves_by_branch(keep: list[bool], expected: list[int]) -> None:
    parents = np.array([5, 5, 7, 6, 6, 7, 8, 8, -1], np.int32)  # ((0 1) 2) (3 4)
    assert kernels.cut_labels(parents, np.array(keep), 5).tolist() == expected
