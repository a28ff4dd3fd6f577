"""What other views say of points, and nearest rows of other views, match loops over one after the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from messages import refuses
from scenes import arc, make_scene, room

from gsmerge.method.geometry.pooling import Members, scene_members
from gsmerge.method.geometry.transforms import camera_distances, project
from gsmerge.method.kernels import elementary
from gsmerge.method.kernels.gaussians.cross_view import build_tree, nearest_of_others, partition, sum_cross_view
from gsmerge.method.networks.cross_view_stats import (
    FAR_LOG,
    MIN_SURFACE_OPACITY,
    NEAR_LOG,
    cross_view_stats,
    nearest_of_other_views,
)
from gsmerge.runtime.threads import use_threads
from gsmerge.types import SH_C0, Cameras, Scene


def slowly(
    means: np.ndarray, sh0: np.ndarray, views: np.ndarray, members: Members, cameras: Cameras, most: int | None = None
) -> np.ndarray:
    """Return the statistics ``[g,7]`` by a loop over points and views."""
    distances = camera_distances(cameras)
    places, depths = project(means, cameras)
    actual = np.zeros((len(means), 7))
    actual[:, 6] = elementary.log(len(cameras)) / 4
    for i in range(len(means)):
        seen, kinds, color, ratios = 0, [0, 0, 0], 0.0, 0.0
        own = int(views[i])
        others = sorted((v for v in range(len(cameras)) if v != own), key=lambda v: distances[own, v])
        for v in others if own < 0 else others[:most]:
            x, y = (int(np.floor(float(c))) for c in places[v, i]) if depths[v, i] > 0 else (-1, -1)
            if not (0 <= x < cameras.width and 0 <= y < cameras.height):
                continue
            j = (v * cameras.height + y) * cameras.width + x
            there = project(members.means[j : j + 1], cameras)[1][v, 0]
            if not (there > 0 and members.opacities[j] > MIN_SURFACE_OPACITY):
                continue
            ratio, seen = float(elementary.log(depths[v, i] / there)), seen + 1
            kinds[0 if abs(ratio) < NEAR_LOG else 1 if ratio < 0 else 2] += 1
            if abs(ratio) < NEAR_LOG:
                color += float(np.abs(SH_C0 * (sh0[i, 0] - members.sh0[j, 0])).mean())
            ratios += float(np.clip(ratio, -FAR_LOG, FAR_LOG))
        shares = [kind / max(seen, 1) for kind in kinds]
        actual[i, :6] = [elementary.log1p(seen) / 3, *shares, color / max(kinds[0], 1), ratios / max(seen, 1) / FAR_LOG]
    return actual


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(room(), arc(4, 24, 18))


def test_statistics_match_a_loop_over_points_and_views(scene: Scene) -> None:
    """Points on surfaces, before and behind them, behind cameras, and of no view."""
    rng = np.random.default_rng(0)
    rows = rng.permutation(len(scene.gaussians))[:160]
    means = scene.gaussians.means[rows] * (1 + 0.1 * rng.normal(size=(160, 1)).astype(np.float32))
    means[:8] = -means[:8]
    views = rows // scene.pixels_per_view
    views[8:16] = -1
    members = scene_members(scene)
    members.opacities[::7] = 0
    for most in (None, 2):
        with use_threads(2):
            actual = cross_view_stats(means, scene.gaussians.sh0[rows], views, members, scene.cameras, most)
        expected = slowly(means, scene.gaussians.sh0[rows], views, members, scene.cameras, most)
        assert len(np.unique(actual[:, 0])) > (2 if most else 3)
        assert (expected[:, 1:4].max(0) > 0).all()
        np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_statistics_do_not_depend_on_the_order_of_rows(scene: Scene) -> None:
    """Rows in another order with the pixels that show them say what the grid says; pixels without any say nothing."""
    members, g, cameras = scene_members(scene), scene.gaussians, scene.cameras
    order = np.random.default_rng(1).permutation(len(g))
    fronts = np.argsort(order, kind="stable").astype(np.int32).reshape(4, 18, 24)
    columns = {name: getattr(members, name)[order] for name in ("means", "opacities", "sh0")}
    views = np.arange(len(g)) // scene.pixels_per_view
    shuffled = replace(members, **columns, pixels=order, fronts=fronts)
    expected = cross_view_stats(g.means, g.sh0, views, members, cameras)
    np.testing.assert_array_equal(cross_view_stats(g.means, g.sh0, views, shuffled, cameras), expected)
    fronts[1:] = -1
    stats = cross_view_stats(g.means, g.sh0, views, shuffled, cameras)
    assert not stats[views == 0, :6].any()
    assert stats[views > 0, 0].any()
    with pytest.raises(ValueError, match="sum_cross_view: "):
        cross_view_stats(g.means, g.sh0, views, replace(shuffled, fronts=fronts + len(g)), cameras)


def test_transparent_pixels_single_views_or_no_points_give_no_statistics() -> None:
    scene = make_scene(room(), arc(2))
    members, g = scene_members(scene), scene.gaussians
    views = np.zeros(len(g), np.int64)
    clear = replace(members, opacities=np.zeros_like(members.opacities))
    assert not cross_view_stats(g.means, g.sh0, views, clear, scene.cameras)[:, :6].any()
    alone = make_scene(room(), arc(1, 24, 18))
    own = alone.gaussians
    stats = cross_view_stats(own.means, own.sh0, views[: len(own)], scene_members(alone), alone.cameras)
    assert not stats.any()  # one view knows nothing
    assert cross_view_stats(g.means[:0], g.sh0[:0], views[:0], members, scene.cameras).shape == (0, 7)


def random_sums(num: int, pixels: int, first: int = 0, last: int | None = None, more: int = 0) -> np.ndarray:
    """Return what three views of 6 x 4 pixels say of random points, some of them no numbers."""
    rng = np.random.default_rng(0)
    points, means = rng.normal(size=(num, 3)), rng.normal(size=(pixels, 3)).astype(np.float32)
    points[:3], means[:9:3] = np.array([[np.nan], [np.inf], [-np.inf]])[:num], np.nan
    points[:, 2] += 3
    means[:, 2] += 3
    viewmats, Ks = np.tile(np.eye(4), (3, 1, 1)), np.tile([[5.0, 0, 3], [0, 5, 2], [0, 0, 1]], (3, 1, 1))
    colors, sh0 = (rng.normal(size=shape).astype(np.float32) for shape in ((num, 3), (pixels, 1, 3)))
    opacities, own = rng.uniform(0, 1, pixels).astype(np.float32), rng.integers(-1, 3, num)
    asked = np.array([[1, 2], [0, 2], [0, 1]], np.int32)
    out, fronts = np.zeros((num, 6)), more + np.arange(72, dtype=np.int32).reshape(3, 4, 6)
    last = num if last is None else last
    sum_cross_view(
        points, colors, own, asked, viewmats, Ks, 6, 4, fronts, means, opacities, sh0, 0.3, 0.5, 2.0, 0.1, first, last,
        out,
    )  # fmt: skip
    return out


def test_the_bits_are_the_same_on_every_processor(each_target) -> None:  # type: ignore[no-untyped-def]
    (sums,) = each_target(lambda: (random_sums(500, 72),))
    assert (sums.max(0)[:4] > 0).all()
    assert not sums[:3].any()


def test_ranges_of_points_or_pixels_outside_are_refused() -> None:
    assert random_sums(0, 72).shape == (0, 6)
    for arguments in ((500, 72, 0, 500, 1), (5, 72, 0, 6), (5, 72, -1, 5)):
        with pytest.raises(ValueError, match="sum_cross_view: "):
            random_sums(*arguments)


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


def test_bits_of_nearest_rows_are_the_same_on_every_processor(each_target) -> None:  # type: ignore[no-untyped-def]
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
