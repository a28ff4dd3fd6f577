"""Members of groups are sampled and put into tables."""

from __future__ import annotations

import numpy as np
import pytest

from gsmerge.method.networks.tokens import hash_uniform, sample_members, split_tables


def test_token_tables_hold_every_group_once() -> None:
    sizes = np.random.default_rng(0).integers(1, 100, 5000)
    actual = list(split_tables(sizes, 16))
    assert sorted(np.concatenate([rows for rows, _ in actual]).tolist()) == list(range(5000))
    for rows, width in actual:
        assert width in (1, 2, 4, 8, 16)
        assert len(rows) * width <= 16384
        assert (np.minimum(sizes[rows], 16) <= width).all()
        assert width == 1 or (np.minimum(sizes[rows], 16) > width // 2).all()


@pytest.mark.parametrize("size", [9, 16, 23, 1000])
def test_large_groups_are_sampled_once_from_every_run(size: int) -> None:
    keys = np.random.default_rng(1).permutation(size).astype(float)
    picked, mask = sample_members(keys, np.array([size]), 8, np.array([7], np.uint64))
    assert mask.all()
    ranks = keys[picked[0]]
    edges = np.arange(9) * size // 8
    assert (ranks >= edges[:-1]).all()
    assert (ranks < edges[1:]).all()


def test_hashed_numbers_are_uniform_without_correlation() -> None:
    numbers = hash_uniform(np.arange(20000, dtype=np.uint64), np.zeros(1, np.uint64))
    assert 0 <= numbers.min() < numbers.max() < 1
    assert abs(numbers.mean() - 0.5) < 0.01
    assert abs(np.corrcoef(numbers[1:], numbers[:-1])[0, 1]) < 0.02
