"""Merging neighbours by the growth of the error, and rows of regions, match slow, obvious twins."""

from __future__ import annotations

import numpy as np
import pytest
from regions_of_noise import SPREAD, features, neighbours, squared_error, total_error

from gsmerge.method.kernels.superpixels import ward
from gsmerge.method.kernels.superpixels.regions import pad_labels, region_rows


def test_region_rows_are_means(pixels: np.ndarray, labels: np.ndarray) -> None:
    rows = region_rows(pad_labels(labels), pixels, 30, 33, SPREAD)
    assert rows.shape == (33, 8)
    for k in range(30):
        members = features(pixels)[labels.reshape(-1) == k]
        assert rows[k, :5] == pytest.approx(members.mean(0), abs=1e-6)
        assert rows[k, 5] == len(members)


@pytest.mark.parametrize(("u", "v"), [(0, 1), (4, 20), (7, 29)])
def test_merge_cost_is_the_growth_of_the_error(u: int, v: int, pixels: np.ndarray, labels: np.ndarray) -> None:
    rows, points, flat = region_rows(pad_labels(labels), pixels, 30, 30, SPREAD), features(pixels), labels.reshape(-1)
    rows[:, ward.INVERSE] = 1 / rows[:, 5]
    apart = squared_error(points[flat == u]) + squared_error(points[flat == v])
    together = squared_error(points[(flat == u) | (flat == v)])
    cost = np.empty(1, np.float32)
    ward.merge_costs(rows, np.array([[u, v]], np.int32), cost)
    assert cost[0] == pytest.approx(together - apart, rel=1e-3)


def test_adjacent_pairs_are_all_neighbours(labels: np.ndarray) -> None:
    pairs = ward.adjacent_pairs(pad_labels(labels))
    assert {(int(min(p)), int(max(p))) for p in pairs} == neighbours(labels)
    assert len(ward.adjacent_pairs(pad_labels(np.zeros((3, 4), int)))) == 0


def greedy_merge(pixels: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """Merge the cheapest pair of neighbours, again and again."""
    labels, points = labels.copy(), features(pixels)

    def cost(pair: tuple[int, int]) -> float:
        u, v = (points[labels.reshape(-1) == k] for k in pair)
        return len(u) * len(v) / (len(u) + len(v)) * float(((u.mean(0) - v.mean(0)) ** 2).sum())

    while len(np.unique(labels)) > count:
        u, v = min(neighbours(labels), key=cost)
        labels[labels == v] = u
    return labels


@pytest.mark.parametrize("count", [1, 2, 8, 15, 29, 30])
def test_merged_regions_have_nearly_the_error_of_greedy_merges(
    pixels: np.ndarray, labels: np.ndarray, count: int
) -> None:
    merged = ward.merge_regions(pad_labels(labels), pixels, 30, count, SPREAD)[1:-1, 1:-1]
    assert len(np.unique(merged)) == merged.max() + 1 == count
    for k in range(30):
        assert len(np.unique(merged[labels == k])) == 1  # regions merge whole
    expected = total_error(pixels, greedy_merge(pixels, labels, count))
    assert total_error(pixels, merged) == pytest.approx(expected, rel=0.01)


def test_merging_from_a_low_ceiling_gives_the_same(pixels: np.ndarray, labels: np.ndarray) -> None:
    """Parked edges come back: where the ceiling starts changes the work, not the heights of the lowest merges."""
    heights = []
    for ceiling in (1e-6, 1e9):
        rows = region_rows(pad_labels(labels), pixels, 30, 60, SPREAD)
        rows[:30, ward.INVERSE] = 1 / rows[:30, 5]
        _, num_nodes = ward.merge_tree(ward.adjacent_pairs(pad_labels(labels)), rows, 30, 15, np.float32(ceiling))
        assert num_nodes >= 45
        heights.append(np.sort(rows[30:num_nodes, ward.MERGE_HEIGHT])[:15])
    assert heights[0] == pytest.approx(heights[1], rel=0.02)
