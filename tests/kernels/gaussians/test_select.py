from __future__ import annotations

import numpy as np
import pytest

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
    """By a column of points, through an order that holds some of them; the values stay as they are."""
    rng = np.random.default_rng(0)
    points, order = rng.normal(size=(200, 3)), rng.permutation(200)[:90]
    before, values = order.copy(), points[:, 1].copy()
    partition(points[:, 1], order, 20, 70, 31)
    np.testing.assert_array_equal(points[:, 1], values)
    np.testing.assert_array_equal(order[:20], before[:20])
    np.testing.assert_array_equal(order[70:], before[70:])
    assert set(order[20:70]) == set(before[20:70])
    assert values[order[31]] == np.partition(values[before[20:70]], 11)[11]
