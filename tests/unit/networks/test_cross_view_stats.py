from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scenes import arc, make_scene, plane, room, waves

from gsmerge.moments import scene_members
from gsmerge.networks.cross_view_stats import cross_view_stats
from gsmerge.types import PixelScene


def of_view(scene: PixelScene, view: int, factor: float = 1.0) -> torch.Tensor:
    """Statistics of a view's Gaussians, moved along their rays."""
    pixels = scene.pixels_per_view
    rows = slice(view * pixels, (view + 1) * pixels)
    centre = scene.cameras.centres[view].float()
    means = centre + (scene.gaussians.means[rows] - centre) * factor
    views = torch.full((pixels,), view)
    return cross_view_stats(means, scene.gaussians.sh0[rows], views, scene_members(scene), scene.cameras)


def test_a_wall_agrees_with_itself() -> None:
    scene = make_scene([plane(3.0, waves(0, 2.0))], arc(3))
    stats = of_view(scene, 1)
    seen = stats[:, 0] > np.log(2.5) / 3
    assert float(seen.float().mean()) > 0.7
    torch.testing.assert_close(stats[seen][:, 0], torch.full((int(seen.sum()),), float(np.log(3)) / 3))
    assert bool((stats[seen][:, 1] == 1).all())
    assert bool((stats[seen][:, 2:4] == 0).all())
    assert float(stats[seen][:, 4].max()) < 0.05
    assert float(stats[:, 5].abs().max()) < 0.03
    torch.testing.assert_close(stats[:, 6], torch.full((len(stats),), float(np.log(3)) / 4))


def test_what_stands_before_the_surface_and_behind_it() -> None:
    scene = make_scene([plane(3.0, waves(0, 2.0))], arc(3))
    for factor, column in ((0.8, 2), (1.2, 3)):
        stats = of_view(scene, 1, factor)
        seen = stats[:, 0] > 0
        assert bool((stats[seen][:, column] == 1).all())
        assert bool((stats[seen][:, 5] * (1 if factor > 1 else -1) > 0.3).all())


def test_shares_add_up_and_one_view_knows_nothing() -> None:
    stats = of_view(make_scene(room(), arc(4)), 0)
    seen = stats[:, 0] > 0
    torch.testing.assert_close(stats[seen][:, 1:4].sum(1), torch.ones(int(seen.sum())))
    assert not bool(stats[~seen][:, 1:6].any())
    assert not bool(of_view(make_scene(room(), arc(1)), 0).any())


def test_unaligned_scenes_and_transparent_pixels_have_none() -> None:
    scene = make_scene(room(), arc(2))
    members, g = scene_members(scene), scene.gaussians
    views = torch.zeros(len(g), dtype=torch.int64)
    unaligned = replace(members, pixels=np.arange(len(g)))
    clear = replace(members, opacities=np.zeros_like(members.opacities))
    for unknown in (unaligned, clear):
        stats = cross_view_stats(g.means, g.sh0, views, unknown, scene.cameras)
        assert not bool(stats[:, :6].any())
    assert cross_view_stats(g.means[:0], g.sh0[:0], views[:0], members, scene.cameras).shape == (0, 7)
