"""The written-out blending weights match a dense matrix, and lists that point outside their arrays are refused."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from made_gaussians import random_gaussians
from numpy.testing import assert_allclose, assert_array_equal
from slow_renderer import render_arrays

from gsmerge.method.geometry.transforms import quat_to_rotmat
from gsmerge.method.kernels.raster.blend import (
    SUMS,
    add_slots,
    blend,
    blend_backward,
    contributions,
    cover,
    gather_slots,
    parts_of_tile,
    survey,
    weighted_sums,
)
from gsmerge.method.kernels.raster.list_weights import LANES, collect, list_weights
from gsmerge.method.raster import TiledView, composite, make_splats, splat_adjoint, tile_view
from gsmerge.method.raster.composite import find_covered
from gsmerge.types import Gaussians

WIDTH, HEIGHT = 45, 37  # not multiples of a tile
K = np.array([[40.0, 0, 21.3], [0, 42.0, 19.1], [0, 0, 1]])


@dataclass(frozen=True)
class ViewWeights:
    """The entries of a view, and the lists of its tiles."""

    ids: np.ndarray
    flatten_ids: np.ndarray
    isect_offsets: np.ndarray
    tile_width: int
    starts: np.ndarray
    lanes: np.ndarray
    weights: np.ndarray


def of_case(case: tuple[int, int, float]) -> Gaussians:
    return random_gaussians(case[0], case[1], opacity=case[2])


def tile_and_weigh(gaussians: Gaussians) -> tuple[TiledView, ViewWeights]:
    tiled = tile_view(make_splats(gaussians), np.eye(4), K, WIDTH, HEIGHT)
    return tiled, ViewWeights(tiled.ids, *tiled.lists[1:], *list_weights(*tiled.lists, HEIGHT, WIDTH))


def apply_transposed(view: ViewWeights, image: np.ndarray) -> np.ndarray:
    """Return, for each listed Gaussian, its weights times the pixels of ``image [h,w,c]``, by the kernel."""
    padded, sums = np.zeros((HEIGHT, WIDTH, LANES), np.float32), np.zeros((len(view.ids), LANES))
    padded[..., : image.shape[2]] = image
    lists = view.flatten_ids, view.isect_offsets, view.tile_width
    collect(view.starts, view.lanes, view.weights, *lists, padded, sums)
    return sums[:, : image.shape[2]]


def entry_pixels(weights: ViewWeights) -> np.ndarray:
    """Return the row-major pixel of the image of every entry."""
    tiles = np.repeat(np.arange(len(weights.isect_offsets) - 1), np.diff(weights.isect_offsets))
    tiles = np.repeat(tiles, np.diff(weights.starts))
    y = tiles // weights.tile_width * 16 + weights.lanes // 16
    x = tiles % weights.tile_width * 16 + weights.lanes % 16
    assert (x < WIDTH).all()
    assert (y < HEIGHT).all()
    return y * WIDTH + x


def dense(weights: ViewWeights, count: int) -> np.ndarray:
    """Return the weights as a matrix ``[pixels,n]``."""
    matrix, pixels = np.zeros((HEIGHT * WIDTH, count)), entry_pixels(weights)
    for i, member in enumerate(weights.flatten_ids):
        entries = slice(weights.starts[i], weights.starts[i + 1])
        np.add.at(matrix, (pixels[entries], weights.ids[member]), weights.weights[entries])
    return matrix


# many faint ones exceed the first buffer; opaque ones stop pixels early
CASES = [(200, 0, 0.5), (3000, 1, 0.05), (3000, 2, 3.0), (1, 3, 0.5)]


@pytest.mark.parametrize("case", CASES)
def test_entries_are_positive_with_one_for_each_gaussian_and_pixel(case: tuple[int, int, float]) -> None:
    tiled, weights = tile_and_weigh(of_case(case))
    assert len(weights.starts) == len(tiled.flatten_ids) + 1
    assert weights.starts[0] == 0
    assert (np.diff(weights.starts) >= 0).all()
    assert weights.starts[-1] == len(weights.lanes) == len(weights.weights)
    assert (weights.weights > 0).all()
    owners = weights.ids[np.repeat(weights.flatten_ids, np.diff(weights.starts))].astype(np.int64)
    assert len(np.unique(owners * HEIGHT * WIDTH + entry_pixels(weights))) == len(owners)


@pytest.mark.parametrize("case", CASES)
def test_weights_give_the_composite(case: tuple[int, int, float]) -> None:
    gaussians = of_case(case)
    tiled, weights = tile_and_weigh(gaussians)
    colors = np.random.default_rng(0).normal(size=(len(gaussians), 3))
    image = (dense(weights, len(gaussians)) @ colors).reshape(HEIGHT, WIDTH, 3)
    assert_allclose(image, composite(tiled, colors)[0], atol=2e-5)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_transposed_product_matches_adjoint_and_dense_matrix(channels: int) -> None:
    gaussians = random_gaussians(400, 5)
    tiled, weights = tile_and_weigh(gaussians)
    image = np.random.default_rng(1).normal(size=(HEIGHT, WIDTH, channels))
    sums = apply_transposed(weights, image)
    assert sums.shape == (len(tiled.ids), channels)
    assert_allclose(sums, splat_adjoint(tiled, image)[tiled.ids], atol=2e-4)
    expected = dense(weights, 400).T @ image.reshape(-1, channels)
    assert_allclose(sums, expected[tiled.ids], atol=2e-4)
    left_out = np.setdiff1d(np.arange(400), tiled.ids)
    assert not expected[left_out].any()


@pytest.mark.parametrize("limit", [0.25, 0.9, 0.001])
@pytest.mark.parametrize("case", CASES)
def test_covered_pixels_are_those_of_the_transmittance(case: tuple[int, int, float], limit: float) -> None:
    """A tile ends early, but no pixel changes sides."""
    tiled, _ = tile_and_weigh(of_case(case))
    assert_array_equal(find_covered(tiled, limit), composite(tiled)[1] <= limit)


def test_weights_match_the_slow_renderer() -> None:
    gaussians = random_gaussians(200, 7)
    _, weights = tile_and_weigh(gaussians)
    expected = render_arrays(gaussians, np.eye(4), K, WIDTH, HEIGHT).weights
    error = np.abs(dense(weights, 200).T - expected.reshape(200, -1))
    assert np.quantile(error, 0.999) < 1e-5
    assert error.max() < 0.02  # single pixels where a threshold falls the other way


def test_needles_lose_no_pixel() -> None:
    """Columns are cut to what a thin slanted Gaussian can touch; nothing that blends may fall outside."""
    gaussians = random_gaussians(300, 8)
    needles = replace(gaussians, scales=np.array([[0.7, 1e-4, 1e-4]], np.float32).repeat(300, 0))
    slanted = np.abs(quat_to_rotmat(needles.quats)[:, :2, 0]).min(1)
    assert (slanted > 0.1).sum() > 100
    tiled, weights = tile_and_weigh(needles)
    colors = np.random.default_rng(0).normal(size=(300, 3))
    image = (dense(weights, 300) @ colors).reshape(HEIGHT, WIDTH, 3)
    assert_allclose(image, composite(tiled, colors)[0], atol=2e-5)


@pytest.mark.parametrize("count", [0, 5])
def test_weights_of_nothing_in_view_are_empty(count: int) -> None:
    gaussians = random_gaussians(5, 9)[:count]
    _, weights = tile_and_weigh(replace(gaussians, means=gaussians.means - 10))
    assert len(weights.lanes) == 0
    assert apply_transposed(weights, np.ones((HEIGHT, WIDTH, 3))).shape == (0, 3)


@pytest.mark.parametrize("more", [0, 1, 3])
def test_starts_of_another_length_are_refused(more: int) -> None:
    entries = (np.zeros(more, np.int64), np.zeros(1, np.uint8), np.zeros(1, np.float32), np.zeros(1, np.int32))
    lists, rows = (*entries, np.array([0, 1]), 1), np.zeros((1, 4), np.float32)
    with pytest.raises(ValueError, match=r"collect: .*indices"):
        collect(*lists, rows[None], np.zeros((1, 4)))


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
        lambda: cover(*walked, first, last, 0.5, np.empty((SIDE, SIDE), np.uint8)),
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
@pytest.mark.parametrize("walk", range(7))
def test_walks_refuse_lists_outside_their_arrays(walk: int, change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="indices"):
        walks(lists(**change))[walk]()


@pytest.mark.parametrize("span", [(-1, 2), (0, 5), (0, 1 << 62)])
@pytest.mark.parametrize("walk", [0, 1, 4, 6])
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
