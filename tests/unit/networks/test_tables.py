from __future__ import annotations

import numpy as np
import pytest

from gsmerge.networks.tokens import group_rows, hash_uniform, point_seeds, sample_members, split_tables


def test_tables_hold_every_group_once() -> None:
    sizes = np.random.default_rng(0).integers(1, 100, 5000)
    actual = list(split_tables(sizes, 16))
    assert sorted(np.concatenate([rows for rows, _ in actual]).tolist()) == list(range(5000))
    for rows, width in actual:
        assert width in (1, 2, 4, 8, 16)
        assert len(rows) * width <= 16384
        assert (np.minimum(sizes[rows], 16) <= width).all()
        assert width == 1 or (np.minimum(sizes[rows], 16) > width // 2).all()


def test_no_groups() -> None:
    assert list(split_tables(np.zeros(0, np.int64), 16)) == []


def test_runs_by_hand() -> None:
    places, owners = group_rows(np.array([10, 3]), np.array([2, 3]))
    assert places.tolist() == [10, 11, 3, 4, 5]
    assert owners.tolist() == [0, 0, 1, 1, 1]


def test_small_groups_are_taken_whole_in_order_of_their_key() -> None:
    keys = np.array([3.0, 1.0, 2.0, 9.0])
    picked, mask = sample_members(keys, np.array([3, 1]), 4, np.zeros(2, np.uint64))
    assert picked.tolist() == [[1, 2, 0, 1], [3, 3, 3, 3]]
    assert mask.tolist() == [[True, True, True, False], [True, False, False, False]]


@pytest.mark.parametrize("size", [9, 16, 23, 1000])
def test_large_groups_are_sampled_once_from_every_run(size: int) -> None:
    keys = np.random.default_rng(1).permutation(size).astype(float)
    picked, mask = sample_members(keys, np.array([size]), 8, np.array([7], np.uint64))
    assert mask.all()
    ranks = keys[picked[0]]
    edges = np.arange(9) * size // 8
    assert (ranks >= edges[:-1]).all()
    assert (ranks < edges[1:]).all()


def test_the_sample_does_not_depend_on_the_order_but_on_the_dice() -> None:
    rng = np.random.default_rng(2)
    keys = rng.normal(size=200)
    order = rng.permutation(200)
    sizes, seeds = np.array([200]), np.array([5], np.uint64)
    a, b = sample_members(keys, sizes, 8, seeds)[0][0], sample_members(keys[order], sizes, 8, seeds)[0][0]
    assert a.tolist() == order[b].tolist()
    assert a.tolist() != sample_members(keys, sizes, 8, seeds + np.uint64(1))[0][0].tolist()


def test_numbers_are_uniform_and_their_own() -> None:
    numbers = hash_uniform(np.arange(20000, dtype=np.uint64), np.zeros(1, np.uint64))
    assert 0 <= numbers.min() < numbers.max() < 1
    assert abs(numbers.mean() - 0.5) < 0.01
    assert abs(np.corrcoef(numbers[1:], numbers[:-1])[0, 1]) < 0.02


def test_dice_hang_on_place_and_seed() -> None:
    points = np.random.default_rng(3).normal(size=(50, 3)).astype(np.float32)
    seeds = point_seeds(points, 0)
    assert len(np.unique(seeds)) == 50
    assert point_seeds(points[::-1], 0).tolist() == seeds[::-1].tolist()
    assert not (point_seeds(points, 1) == seeds).any()
