"""Depth order and tile lists match sorting and loops."""

from __future__ import annotations

import numpy as np
import pytest

from gsmerge.method.kernels import elementary
from gsmerge.method.kernels.raster import binning

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
def test_depth_order_matches_a_stable_sort(values: np.ndarray) -> None:
    depths = values.astype(np.float32)
    np.testing.assert_array_equal(binning.depth_order(depths), np.argsort(depths, kind="stable"))


def random_boxes(count: int, tile_height: int, tile_width: int) -> np.ndarray:
    """Draw first and exclusive last column and row; every fifth one is empty."""
    x, y = (
        np.sort(RNG.integers(0, tile_width + 1, (count, 2)), 1),
        np.sort(RNG.integers(0, tile_height + 1, (count, 2)), 1),
    )
    boxes = np.concatenate([x, y], 1).astype(np.int16)
    boxes[(boxes[:, 1] == boxes[:, 0]) | (boxes[:, 3] == boxes[:, 2])] = 0
    boxes[::5] = 0
    return boxes


@pytest.mark.parametrize(("tile_height", "tile_width"), [(1, 1), (1, 9), (9, 1), (5, 7)])
def test_tile_lists_match_a_loop_over_boxes(tile_height: int, tile_width: int) -> None:
    boxes, order = random_boxes(200, tile_height, tile_width), RNG.permutation(200).astype(np.int32)
    expected: list[list[int]] = [[] for _ in range(tile_height * tile_width)]
    for k, (x0, x1, y0, y1) in zip(order.tolist(), boxes[order].tolist(), strict=True):
        for y in range(y0, y1):
            for x in range(x0, x1):
                expected[y * tile_width + x].append(k)
    counts = binning.count_tiles(boxes, tile_height, tile_width)
    assert counts.tolist() == [len(tile) for tile in expected]
    flatten_ids, starts = np.full(counts.sum(), -1, np.int32), np.cumsum(counts) - counts
    binning.deal_tiles(order, boxes[order], tile_width, starts.copy(), flatten_ids)
    assert flatten_ids.tolist() == [k for tile in expected for k in tile]


def test_tile_lists_end_where_nothing_behind_is_seen() -> None:
    conics = np.tile(np.array([8, 8, 1e-6, 0, 1e-9, elementary.log(0.9), 0, 40], np.float32), (9, 1))
    conics[2] = [8, 8, 9, 0, 9, 0, 0, 40]  # covers no tile
    order, boxes = np.arange(9, dtype=np.int32), np.tile(np.array([0, 2, 0, 3], np.int16), (9, 1))
    boxes[:, 1] = [1, 2, 2, 2, 2, 2, 2, 2, 1]

    def deal(first: int, last: int, cursors: np.ndarray, flatten_ids: np.ndarray) -> list[int]:
        lines = 2, first, last, np.ones(6, np.float32)
        binning.deal_open_tiles(order, boxes, conics, *lines, cursors, flatten_ids)
        return cursors.tolist()

    assert deal(0, 3, np.zeros(6, np.int64), np.empty(0, np.int32)) == [6, 6] * 3
    flatten_ids = np.zeros(36, np.int32)
    assert deal(1, 3, np.arange(0, 36, 6), flatten_ids) == [0, 6, 18, 24, 30, 36]
    assert flatten_ids.reshape(6, 6)[2:].tolist() == [[0, 1, 2, 3, 4, 5], [1, 2, 3, 4, 5, 6]] * 2
    for wrong in ((0, 4), (-1, 2), (2, 1)):
        with pytest.raises(ValueError, match="indices"):
            deal(*wrong, np.zeros(6, np.int64), flatten_ids)
    with pytest.raises(ValueError, match="indices"):
        deal(0, 3, np.full(6, 33), flatten_ids)
