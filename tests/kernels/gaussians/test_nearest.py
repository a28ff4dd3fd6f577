"""Neighbours of other views match a search through all of them."""

from __future__ import annotations

import numpy as np
import pytest
from messages import refuses

from gsmerge.kernels.gaussians.cross_view import build_tree, nearest_of_others, partition
from gsmerge.networks.cross_view_stats import nearest_of_other_views
from gsmerge.runtime.threads import use_threads


@pytest.mark.parametrize("views", [1, 2, 5])
@pytest.mark.parametrize("num", [1, 3, 16, 17, 40, 250])
def test_neighbours_match_a_search_through_all(num: int, views: int) -> None:
    """As a search through all of them."""
    generator = np.random.default_rng(num)
    means, owners, count = generator.normal(size=(num, 3)), generator.integers(-1, views, num), 4
    neighbors = nearest_of_other_views(means, owners, count)
    assert neighbors.shape == (num, count)
    for i, row in enumerate(neighbors):
        near = np.argsort(np.linalg.norm(means - means[i], axis=1), kind="stable")
        others = [j for j in near if j != i and (owners[i] < 0 or owners[j] != owners[i])][:count]
        assert row.tolist() == others + [-1] * (count - len(others))


def test_neighbours_are_the_same_on_any_number_of_threads() -> None:
    generator = np.random.default_rng(0)
    means, owners = generator.normal(size=(40_000, 3)), generator.integers(0, 3, 40_000)
    means[5000:5100] = means[5000]  # many at one place
    results = []
    for threads in (1, 3):
        with use_threads(threads):
            results.append(nearest_of_other_views(means, owners, 16))
    np.testing.assert_array_equal(*results)
    for i in generator.choice(40_000, 30):
        near = np.sort(np.linalg.norm(means[owners != owners[i]] - means[i], axis=1))[:16]
        np.testing.assert_allclose(np.linalg.norm(means[results[0][i]] - means[i], axis=1), near)


def test_search_ends_among_thousands_of_the_own_view() -> None:
    crowd = np.random.default_rng(0).normal(size=(5000, 3))
    neighbors = nearest_of_other_views(np.concatenate([crowd, [[50, 0, 0]]]), np.array([0] * 5000 + [1]), 4)
    assert (neighbors[:5000] == -1).mean() > 0.9
    nearest = np.argsort(np.linalg.norm(crowd - [50, 0, 0], axis=1), kind="stable")[:4]
    assert neighbors[5000].tolist() == nearest.tolist()


def test_the_bits_are_the_same_on_every_processor(each_target) -> None:  # type: ignore[no-untyped-def]
    generator = np.random.default_rng(0)
    means, owners = generator.normal(size=(2000, 3)), generator.integers(-1, 3, 2000)
    means[:3] = np.array([[np.nan], [np.inf], [-np.inf]])  # what is not finite must do no harm
    each_target(lambda: (nearest_of_other_views(means, owners, 7),))


@pytest.mark.parametrize(("num", "count"), [(0, 4), (1, 4), (1, 0), (40, 0)])
def test_gaussians_of_one_view_have_no_neighbours(num: int, count: int) -> None:
    assert nearest_of_other_views(np.ones((num, 3)), np.zeros(num, np.int64), count).tolist() == [[-1] * count] * num


def test_damaged_trees_are_refused() -> None:
    points, views, order = np.random.default_rng(0).normal(size=(40, 3)), np.arange(40), np.arange(40)
    axes, splits, out = np.empty(16, np.int8), np.empty(16), np.empty((40, 4), np.int64)
    with refuses(ValueError, "build_tree", "indices"):
        build_tree(points, order, axes[:1], splits[:1])
    with refuses(ValueError, "build_tree: order", "below 40"):
        build_tree(points, order + 1, axes, splits)
    build_tree(points, order, axes, splits)
    bad_axes, bad_order = axes.copy(), order.copy()
    bad_axes[0], bad_order[7] = 3, 40
    for tree in ((order, bad_axes, splits), (bad_order, axes, splits), (order, axes[:2], splits[:2])):
        with refuses(ValueError, "search_tree", "indices"):
            nearest_of_others(points, views, *tree, 0, 40, 256, out)
    for rows in ((0, 41), (-1, 3)):
        with pytest.raises(ValueError, match="search_tree: "):
            nearest_of_others(points, views, order, axes, splits, *rows, 256, out)


@pytest.mark.parametrize("kinds", [2, 10, 10**6])
@pytest.mark.parametrize("num", [1, 2, 3, 17, 400])
def test_partition_puts_at_one_place_what_sorting_would(num: int, kinds: int) -> None:
    """As numpy's partition, with many equal values and without."""
    rng = np.random.default_rng(num)
    values = rng.integers(0, kinds, num).astype(float)
    values[rng.random(num) < 0.1] = np.inf
    for place in {0, (num - 1) // 2, num // 2, num - 1}:
        order = rng.permutation(num)
        partition(values, order, 0, num, place)
        assert sorted(order) == list(range(num))
        reordered = values[order]
        assert reordered[place] == np.partition(values, place)[place]
        assert (reordered[:place] <= reordered[place]).all()
        assert (reordered[place:] >= reordered[place]).all()


def test_partition_sorts_an_order_against_its_pivots() -> None:
    """Every pivot is the smallest value that is left, so that halving would take a pass for each value."""
    num = 4096
    values, slots = np.empty(num), list(range(num))
    for low in range(num):
        middle = (low + num - 1) // 2
        values[slots[middle]] = low
        slots[low], slots[middle] = slots[middle], slots[low]
    order = np.arange(num)
    partition(values, order, 0, num, num // 2)
    np.testing.assert_array_equal(values[order], np.arange(num))


def test_partition_reorders_its_run_alone() -> None:
    """Through an order that holds some of the values; the values stay as they are."""
    rng = np.random.default_rng(0)
    values, order = rng.normal(size=200), rng.permutation(200)[:90]
    before, numbers = order.copy(), values.copy()
    partition(values, order, 20, 70, 31)
    np.testing.assert_array_equal(values, numbers)
    np.testing.assert_array_equal(order[:20], before[:20])
    np.testing.assert_array_equal(order[70:], before[70:])
    assert set(order[20:70]) == set(before[20:70])
    assert values[order[31]] == np.partition(values[before[20:70]], 11)[11]


def test_partition_of_nan_ends_with_all_ids() -> None:
    values, order = np.full(50, np.nan), np.arange(50)
    values[::3] = np.arange(17)
    partition(values, order, 0, 50, 25)
    assert sorted(order) == list(range(50))


@pytest.mark.parametrize("run", [(0, 4, 1), (-1, 3, 1), (1, 3, 0), (0, 2, 2), (0, 0, 0)])
def test_partition_refuses_places_outside(run: tuple[int, int, int]) -> None:
    with pytest.raises(ValueError, match="partition: "):
        partition(np.zeros(3), np.arange(3), *run)
    with refuses(ValueError, "partition: order", "below 3", 3):
        partition(np.zeros(3), np.array([0, 3]), 0, 2, 1)
