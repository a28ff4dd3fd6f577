"""The walks refuse lists that point outside their arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gsmerge.kernels.raster.blend import (
    SUMS,
    add_slots,
    blend,
    blend_backward,
    contributions,
    gather_slots,
    parts_of_tile,
    survey,
    weighted_sums,
)
from gsmerge.kernels.raster.list_weights import list_weights

M, N, SIDE = 3, 5, 20


def lists(**changes: Any) -> dict[str, Any]:
    """Return lists of three Gaussians in the first and the last of four tiles."""
    conics = np.tile(np.array([8, 8, 0.2, 0, 0.04, -1, 0, SIDE], np.float32), (M, 1))
    flatten_ids, isect_offsets = np.array([0, 1, 2, 0, 1], np.int32), np.array([0, 3, 3, 3, 5])
    lists = {"conics": conics, "flatten_ids": flatten_ids, "isect_offsets": isect_offsets, "tile_width": 2}
    return lists | changes


def walks(given: dict[str, Any], first: int = 0, last: int = 4) -> list[Any]:
    """Return calls of all walks with the same lists."""
    colors, image, left = (
        np.ones((M, 3), np.float32),
        np.empty((SIDE, SIDE, 3), np.float32),
        np.empty((SIDE, SIDE), "f4"),
    )
    walked = list(given.values())
    slots = np.empty((len(walked[1]), SUMS), np.float32)
    return [
        lambda: blend(*walked, colors, first, last, 0, np.zeros(3, np.float32), image, left),
        lambda: weighted_sums(*walked, first, last, image, np.empty((len(walked[1]), 4), np.float32)),
        lambda: survey(*walked, colors, image, np.zeros((M, 2), np.float32)),
        lambda: contributions(*walked, SIDE, SIDE, np.zeros((M, 2), np.float32)),
        lambda: blend_backward(*walked, colors, first, last, image, left, image, None, slots),
        lambda: list_weights(*walked, SIDE, SIDE),
    ]


def test_walks_take_sound_lists() -> None:
    for walk in walks(lists()):
        walk()


@pytest.mark.parametrize(
    "change",
    [
        pytest.param({"flatten_ids": np.array([0, 1, M, 0, 1], np.int32)}, id="member too large"),
        pytest.param({"flatten_ids": np.array([0, 1, 2, 0, -1], np.int32)}, id="member below zero"),
        pytest.param({"isect_offsets": np.array([0, 3, 3, 3, N + 1])}, id="end too large"),
        pytest.param({"isect_offsets": np.array([-1, 3, 3, 3, 5])}, id="start below zero"),
        pytest.param({"isect_offsets": np.array([0, 3, 2, 3, 5])}, id="falling"),
        pytest.param({"isect_offsets": np.array([0, 1 << 62, 3, 3, 5])}, id="huge"),
        pytest.param({"tile_width": 0}, id="no columns"),
    ],
)
@pytest.mark.parametrize("walk", range(6))
def test_walks_refuse_lists_outside_their_arrays(walk: int, change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="indices"):
        walks(lists(**change))[walk]()


@pytest.mark.parametrize("span", [(-1, 2), (0, 5), (0, 1 << 62)])
@pytest.mark.parametrize("walk", [0, 1, 4])
def test_tiles_that_are_not_there_are_refused(walk: int, span: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="indices"):
        walks(lists(), *span)[walk]()


@pytest.mark.parametrize("bad", [M, -1, np.iinfo(np.int32).min])
def test_kernels_that_add_up_refuse_members_outside(bad: int) -> None:
    flatten_ids, rows = np.array([0, bad], np.int32), np.zeros((1, 8), np.float32)
    sums, ids = np.zeros((M, SUMS), np.float32), np.arange(M, dtype=np.int32)
    with pytest.raises(ValueError, match="add_slots"):
        add_slots(flatten_ids, np.zeros((2, 4), np.float32), ids, 0, sums)
    with pytest.raises(ValueError, match="add_slots"):
        add_slots(np.zeros(2, np.int32), np.zeros((2, 4), np.float32), np.full(M, bad, np.int32), 0, sums)
    with pytest.raises(ValueError, match="parts_of_tile"):
        parts_of_tile(rows, flatten_ids, 0, 0, np.zeros((2, 3), np.int32))
    gather_slots(flatten_ids, np.ones((2, SUMS), np.float32), 0, M, sums)
    assert sums.sum() == SUMS  # those outside the range of Gaussians are another thread's


@pytest.mark.parametrize("span", [(-1, 2), (0, M + 1)])
def test_a_range_of_gaussians_outside_is_refused(span: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="gather_slots"):
        gather_slots(np.zeros(1, np.int32), np.ones((1, SUMS), np.float32), *span, np.zeros((M, SUMS), np.float32))
