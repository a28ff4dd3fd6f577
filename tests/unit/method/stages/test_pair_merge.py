"""Gaussians are merged by positions and colours alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
import unaligned_scenes
from made_gaussians import random_gaussians

from gsmerge import Gaussians, Scene, render
from gsmerge.method.geometry.pooling import MAX_OPACITY
from gsmerge.method.raster.metrics import psnr
from gsmerge.method.stages.pair_merge import merge_neighbors
from gsmerge.runtime.threads import use_threads


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3), noise=0.01)


def shown(gaussians: Gaussians, scene: Scene) -> float:
    """Return the PSNR (dB) of the views against those of the scene's Gaussians."""
    pictures = [render(g, scene.cameras).images.clip(0, 1) for g in (gaussians, scene.gaussians)]
    return float(np.mean([psnr(*pair) for pair in zip(*pictures, strict=True)]))


@pytest.mark.parametrize("count", [1, 7, 100, 1999])
def test_merging_leaves_as_many_as_asked_for(count: int) -> None:
    gaussians = random_gaussians(2000, 0, degree=2)
    merged = merge_neighbors(gaussians, count)
    assert len(merged) == count
    assert merged.sh_degree == 2
    for column in vars(merged).values():
        assert np.isfinite(column).all()
    assert (merged.opacities > 0).all()
    assert (merged.opacities < 1).all()


def test_merging_to_a_count_beyond_the_gaussians_changes_none() -> None:
    gaussians = random_gaussians(50, 0)
    assert merge_neighbors(gaussians, 50) is gaussians
    assert merge_neighbors(gaussians, 90) is gaussians


def test_unmerged_gaussians_stay_as_they_were() -> None:
    gaussians = random_gaussians(500, 1, degree=1)
    merged = merge_neighbors(gaussians, 400)
    same = (merged.means[:, None] == gaussians.means).all(2)
    assert same.any(1).sum() >= 300
    rows, sources = np.nonzero(same)
    for name, column in vars(merged).items():
        assert np.array_equal(column[rows], getattr(gaussians, name)[sources]), name


def test_copies_are_merged_first() -> None:
    gaussians = random_gaussians(300, 2)
    twice = Gaussians.concat([gaussians, gaussians])
    merged = merge_neighbors(replace(twice, opacities=np.full(600, 0.3, np.float32)), 300)
    found = np.isclose(merged.means[:, None], gaussians.means, atol=1e-5).all(2).any(0)
    assert found.mean() > 0.9  # the others lie on the border of two cells


@pytest.mark.parametrize(("opacity", "wider"), [(0.3, 1.0), (0.54, 1.08**0.5), (0.9, 1.05)])
def test_scales_grow_where_opacity_cannot(opacity: float, wider: float) -> None:
    """Two copies have twice the mass: up to 5 % larger scales take what an opacity of one leaves over."""
    one = replace(random_gaussians(1, 2), opacities=np.full(1, opacity, np.float32))
    merged = merge_neighbors(Gaussians.concat([one, one]), 1)
    np.testing.assert_allclose(np.sort(merged.scales), np.sort(one.scales) * wider, rtol=1e-4)
    np.testing.assert_allclose(merged.opacities, min(2 * opacity, MAX_OPACITY), rtol=1e-4)


@pytest.mark.parametrize(("power", "kept"), [(1.0, [0, 1]), (0.3, [2, 3])])
def test_power_of_masses_decides_between_large_and_small_pairs(power: float, kept: list[int]) -> None:
    """The pair of the smaller ones fits ten times worse, and has a 64th of the area."""
    sizes, places = np.array([8, 8, 1, 1], np.float32), np.array([0, 4, 1000, 1001.8], np.float32)
    means, scales = np.zeros((4, 3), np.float32), np.repeat(sizes[:, None], 3, 1)
    means[:, 0] = places
    pairs = replace(random_gaussians(4, 0), means=means, scales=scales, opacities=np.full(4, 0.5, np.float32))
    pairs = replace(pairs, sh0=np.zeros_like(pairs.sh0))
    merged = merge_neighbors(pairs, 3, power)
    assert np.isin(places[kept], merged.means[:, 0]).all()


def test_merged_fifth_of_a_scene_looks_nearly_the_same(room: Scene) -> None:
    fifth = len(room.gaussians) // 5
    merged = merge_neighbors(room.gaussians, fifth)
    chosen = np.random.default_rng(0).choice(len(room.gaussians), fifth, replace=False)
    larger = replace(room.gaussians[chosen], scales=room.gaussians.scales[chosen] * 5**0.5)
    assert shown(merged, room) > 27
    assert shown(merged, room) > shown(larger, room) + 3


def test_order_scale_and_threads_do_not_matter(room: Scene) -> None:
    count = 300
    expected = merge_neighbors(room.gaussians, count)
    with use_threads(1):
        alone = merge_neighbors(room.gaussians, count)
    assert all(np.array_equal(a, b) for a, b in zip(vars(expected).values(), vars(alone).values(), strict=True))
    g = room.gaussians
    far = merge_neighbors(replace(g, means=g.means * 1024, scales=g.scales * 1024), count)
    np.testing.assert_allclose(far.means, expected.means * 1024, rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(far.opacities, expected.opacities, atol=1e-3)
    shuffled = merge_neighbors(unaligned_scenes.shuffled(room).gaussians, count)
    assert shown(shuffled, room) == pytest.approx(shown(expected, room), abs=0.5)


def test_cells_without_a_finite_cost_are_merged() -> None:
    """Cells of which no cost is a number end nowhere."""
    gaussians = random_gaussians(300, 3)
    same = replace(gaussians, means=np.zeros_like(gaussians.means), scales=np.full_like(gaussians.scales, 1e-9))
    assert len(merge_neighbors(same, 4)) == 4
    wide = replace(gaussians, means=gaussians.means.astype(np.float64) * 1e200)
    assert len(merge_neighbors(wide, 4)) == 4
