"""Views are clustered into blocks by what they see, and points belong to the views that show them best."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
from hypothesis import given
from hypothesis import strategies as st

from gsmerge import CompactOptions
from gsmerge.blocks.partition import (
    SHARED,
    Block,
    Covisibility,
    count_factors,
    mark_inside_and_seen,
    measure_covisibility,
    owning_views,
    partition_apart,
    partition_views,
)
from gsmerge.plan.blocks import wanted_blocks
from gsmerge.types import Cameras, Scene


def walk_weights(num_views: int, reach: int = 3) -> np.ndarray:
    """Return weights of views in a row that share less the farther apart they are."""
    distance = np.abs(np.arange(num_views)[:, None] - np.arange(num_views))
    weights = np.maximum(0.0, 1 - distance / (reach + 1))
    np.fill_diagonal(weights, 0)
    return weights


@given(st.integers(1, 40), st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_every_view_is_in_one_block(num_views: int, count: int, seed: int) -> None:
    count = min(count, num_views)
    rng = np.random.default_rng(seed)
    weights = np.triu(rng.random((num_views, num_views)) * (rng.random((num_views, num_views)) < 0.3), 1)
    blocks = partition_views(weights + weights.T, count)
    assert len(blocks) == count
    assert sorted(view for block in blocks for view in block.own) == list(range(num_views))
    for block in blocks:
        assert block.own
        assert not set(block.own) & set(block.shared)
        assert len(block.shared) <= round(SHARED * len(block.own))
        assert all((weights + weights.T)[view, list(block.own)].max() > 0 for view in block.shared)


@pytest.mark.parametrize("order", ["walk", "shuffled"])
def test_views_of_a_walk_are_cut_into_stretches(order: str) -> None:
    places = np.arange(60) if order == "walk" else np.random.default_rng(0).permutation(60)
    blocks = partition_views(walk_weights(60)[places][:, places], 3)
    for block in blocks:
        stretch = np.sort(places[list(block.own)])
        assert np.array_equal(stretch, np.arange(stretch[0], stretch[0] + len(stretch)))
        assert 16 <= len(stretch) <= 24
        near = places[list(block.shared)]
        assert ((near >= stretch[0] - 6) & (near <= stretch[-1] + 6)).all()


def test_two_rooms_are_two_blocks() -> None:
    """Whatever the order of their views."""
    rooms = np.random.default_rng(1).permutation(np.repeat([0, 1], 12))
    blocks = partition_views((rooms[:, None] == rooms).astype(float) - np.eye(24), 2)
    assert {tuple(rooms[list(block.own)]) for block in blocks} == {(0,) * 12, (1,) * 12}
    assert all(not block.shared for block in blocks)


@pytest.mark.parametrize(("rooms", "asked", "expected"), [(1, 4, 1), (2, 4, 2), (4, 4, 4), (8, 3, 3)])
def test_views_of_one_room_stay_together(rooms: int, asked: int, expected: int) -> None:
    of_view = np.arange(48) % rooms
    weights = (of_view[:, None] == of_view).astype(float) - np.eye(48) + 0.001
    blocks = partition_apart(weights - np.diag(weights.diagonal()), asked)
    assert len(blocks) == expected
    assert sorted(view for block in blocks for view in block.own) == list(range(48))


@pytest.mark.parametrize(
    ("num_gaussians", "num_views", "blocks"),
    [(19_000_000, 60, 1), (19_000_000, 168, 1), (4_838_400, 252, 6), (19_200_000, 1000, 24), (21_000_000, 20, 3)],
)
def test_many_gaussians_or_views_ask_for_blocks(num_gaussians: int, num_views: int, blocks: int) -> None:
    assert wanted_blocks(CompactOptions(), num_gaussians, num_views) == blocks


@pytest.fixture(scope="module")
def two_sides() -> Scene:
    """Make three views of a wall from near, and three of the same wall from twice as far."""
    near, far = scenes.arc(3, 48, 36, span=0.3), scenes.arc(3, 48, 36, span=0.3)
    viewmats = far.viewmats.copy()
    viewmats[:, 2, 3] += 2.0
    cameras = Cameras(np.concatenate([near.viewmats, viewmats]), np.concatenate([near.Ks, far.Ks]), 48, 36)
    return scenes.make_scene(scenes.wall(), cameras)


def test_covisibility_is_the_share_that_one_view_sees_of_another(two_sides: Scene) -> None:
    covisibility = measure_covisibility(two_sides)
    shares = covisibility.shares
    assert np.allclose(np.diag(shares), 1)
    assert shares[0, 3] > 0.95  # the far view sees all of the near one
    assert shares[3, 0] < 0.6  # and not the other way round
    assert np.array_equal(covisibility.weights, covisibility.weights.T)
    assert not covisibility.weights.diagonal().any()


def test_hidden_points_are_not_seen() -> None:
    scene = scenes.make_scene(scenes.two_planes(), scenes.arc(2, 48, 36, span=0.1))
    covisibility = measure_covisibility(scene)
    on_surface = scene.gaussians.means[: scene.pixels_per_view : 7].astype(np.float64)
    centre = scene.cameras.centres[0]
    behind = centre + 1.5 * (on_surface - centre)
    first = scene.cameras[[0]]
    inside, seen = mark_inside_and_seen(on_surface, first, covisibility.depths[:1])
    assert seen.mean() > 0.95
    assert inside.all()
    inside, seen = mark_inside_and_seen(behind, first, covisibility.depths[:1])
    assert seen.mean() < 0.1
    assert inside.all()


def test_points_belong_to_the_nearest_view_that_sees_them(two_sides: Scene) -> None:
    covisibility = measure_covisibility(two_sides)
    centre = two_sides.pixels.shown.reshape(6, 36, 48)[0, 12:24, 16:32]
    assert centre.all()
    means = two_sides.gaussians.means.reshape(6, 36, 48, 3)
    views = list(range(6))
    middle = owning_views(means[3, 14:22, 18:30].reshape(-1, 3), covisibility, views)
    assert (middle < 3).all()
    rim = owning_views(means[3:, [0, 0, -1, -1], [0, -1, 0, -1]].reshape(-1, 3), covisibility, views)
    assert (rim >= 3).all()
    assert set(owning_views(means[3, 14:22, 18:30].reshape(-1, 3), covisibility, [3, 4])) <= {3, 4}
    assert len(owning_views(np.empty((0, 3)), covisibility, views)) == 0


def test_owners_are_chosen_by_sight_then_by_picture_then_by_distance() -> None:
    rng = np.random.default_rng(0)
    turned = np.linalg.qr(rng.normal(size=(30, 3, 3)))[0]
    turned *= np.linalg.det(turned)[:, None, None]
    viewmats = np.tile(np.eye(4), (30, 1, 1))
    viewmats[:, :3, :3], viewmats[:, :3, 3] = turned, rng.normal(0, 3, (30, 3))
    Ks = np.tile(np.array([[40.0, 0, 20], [0, 50, 12], [0, 0, 1]]), (30, 1, 1))
    cameras, depths = Cameras(viewmats, Ks, 44, 30), rng.uniform(0.5, 6, (30, 5, 7))
    depths[::4, 1, 1] = np.inf  # open sky
    points = rng.normal(0, 4, (3000, 3)) * rng.choice([0.2, 1, 4], (3000, 1))
    inside, seen = mark_inside_and_seen(points, cameras, depths)
    squares = np.square(points - cameras.centres[:, None]).sum(-1)
    expected = (np.where(seen, 0, np.where(inside, 1e6, 1e12)) + squares).argmin(0)
    covisibility = Covisibility(cameras, depths, seen, points, np.zeros(len(points), int))
    assert np.array_equal(owning_views(points, covisibility, range(30)), expected)


def test_blocks_that_see_the_same_need_more_gaussians(two_sides: Scene) -> None:
    covisibility = measure_covisibility(two_sides)
    near, far = partition_of([0, 1, 2], [3, 4, 5])
    factors = count_factors([near, far], covisibility)
    assert factors[0] > 1.2  # what the far views see of the near part is made by the near ones
    assert factors[1] >= 1
    whole = partition_of(list(range(6)))
    assert count_factors(whole, covisibility) == pytest.approx([1])


def partition_of(*owns: list[int]) -> list:
    return [Block(tuple(own), ()) for own in owns]
