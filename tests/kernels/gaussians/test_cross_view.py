"""What other views say of points matches a loop over one point and one view at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import arc, make_scene, room

from gsmerge.geometry.pooling import Members, scene_members
from gsmerge.geometry.transforms import camera_distances, project
from gsmerge.kernels import elementary
from gsmerge.kernels.gaussians.cross_view import sum_cross_view
from gsmerge.networks.cross_view_stats import FAR_LOG, MIN_SURFACE_OPACITY, NEAR_LOG, cross_view_stats
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
