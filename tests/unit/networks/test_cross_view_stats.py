from __future__ import annotations

from dataclasses import replace

import numpy as np
from scenes import arc, make_scene, plane, room, waves

from gsmerge.moments import scene_members
from gsmerge.networks.cross_view_stats import cross_view_stats
from gsmerge.types import Scene


def of_view(scene: Scene, view: int, factor: float = 1.0) -> np.ndarray:
    """Statistics of a view's Gaussians, moved along their rays."""
    pixels = scene.pixels_per_view
    rows = slice(view * pixels, (view + 1) * pixels)
    centre = scene.cameras.centres[view].astype(np.float32)
    means = centre + (scene.gaussians.means[rows] - centre) * factor
    views = np.full(pixels, view)
    return cross_view_stats(means, scene.gaussians.sh0[rows], views, scene_members(scene), scene.cameras)


def test_a_wall_agrees_with_itself() -> None:
    scene = make_scene([plane(3.0, waves(0, 2.0))], arc(3))
    stats = of_view(scene, 1)
    seen = stats[:, 0] > np.log(2.5) / 3
    assert seen.mean() > 0.7
    np.testing.assert_allclose(stats[seen][:, 0], np.log(3) / 3, rtol=1.3e-6, atol=1e-5)
    assert (stats[seen][:, 1] == 1).all()
    assert (stats[seen][:, 2:4] == 0).all()
    assert stats[seen][:, 4].max() < 0.05
    assert np.abs(stats[:, 5]).max() < 0.03
    np.testing.assert_allclose(stats[:, 6], np.log(3) / 4, rtol=1.3e-6, atol=1e-5)


def test_what_stands_before_the_surface_and_behind_it() -> None:
    scene = make_scene([plane(3.0, waves(0, 2.0))], arc(3))
    for factor, column in ((0.8, 2), (1.2, 3)):
        stats = of_view(scene, 1, factor)
        seen = stats[:, 0] > 0
        assert (stats[seen][:, column] == 1).all()
        assert (stats[seen][:, 5] * (1 if factor > 1 else -1) > 0.3).all()


def test_shares_add_up_and_one_view_knows_nothing() -> None:
    stats = of_view(make_scene(room(), arc(4)), 0)
    seen = stats[:, 0] > 0
    np.testing.assert_allclose(stats[seen][:, 1:4].sum(1), 1, rtol=1.3e-6, atol=1e-5)
    assert not stats[~seen][:, 1:6].any()
    assert not of_view(make_scene(room(), arc(1)), 0).any()


def test_unaligned_scenes_and_transparent_pixels_have_none() -> None:
    scene = make_scene(room(), arc(2))
    members, g = scene_members(scene), scene.gaussians
    views = np.zeros(len(g), np.int64)
    unaligned = replace(members, pixels=np.arange(len(g)))
    clear = replace(members, opacities=np.zeros_like(members.opacities))
    for unknown in (unaligned, clear):
        stats = cross_view_stats(g.means, g.sh0, views, unknown, scene.cameras)
        assert not stats[:, :6].any()
    assert cross_view_stats(g.means[:0], g.sh0[:0], views[:0], members, scene.cameras).shape == (0, 7)
