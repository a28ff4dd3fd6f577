from __future__ import annotations

import numpy as np
import pytest
from messages import refuses

from gsmerge.kernels.gaussians.select import partition


@pytest.mark.parametrize("kinds", [2, 10, 10**6])
@pytest.mark.parametrize("num", [1, 2, 3, 17, 400])
def test_one_place_is_as_sorted(num: int, kinds: int) -> None:
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


def test_only_a_run_is_reordered() -> None:
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


def test_nan_ends() -> None:
    values, order = np.full(50, np.nan), np.arange(50)
    values[::3] = np.arange(17)
    partition(values, order, 0, 50, 25)
    assert sorted(order) == list(range(50))


@pytest.mark.parametrize("run", [(0, 4, 1), (-1, 3, 1), (1, 3, 0), (0, 2, 2), (0, 0, 0)])
def test_places_outside_are_refused(run: tuple[int, int, int]) -> None:
    with pytest.raises(ValueError, match="partition: "):
        partition(np.zeros(3), np.arange(3), *run)
    with refuses(ValueError, "partition: order", "below 3", 3):
        partition(np.zeros(3), np.array([0, 3]), 0, 2, 1)
