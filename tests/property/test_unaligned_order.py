"""Gaussians in no order give the same result after a permutation of them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import scenes
import unaligned_scenes
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from sweeps import sweep

from gsmerge import Scene, compact
from gsmerge.method.geometry.pooling import scene_members
from gsmerge.method.stages.assign import find_owners, owner_pixels
from gsmerge.method.stages.encode import member_rows
from gsmerge.method.stages.segment import SegmentOptions, segment
from gsmerge.prepare.true_pixels import with_pixels
from gsmerge.types import Groups

FEW = settings(max_examples=3, deadline=None, derandomize=True)
ROOM = scenes.make_scene(scenes.room(), scenes.arc(4, 32, 24), noise=0.005)
TURNED = scenes.make_scene(scenes.room(), scenes.arc(4, 32, 24), noise=0.02, opacity=(0.05, 0.95), seed=3)


@cache
def groups(count: int) -> Groups:
    return segment(ROOM.images, SegmentOptions(), count)


@FEW
@given(st.integers(0, 1000), st.integers(1, 300), st.sampled_from([ROOM, TURNED]))
def test_permuted_gaussians_have_permuted_owners(seed: int, count: int, scene: Scene) -> None:
    """Of so few no two have the same depth in float32, so that each view has one order."""
    few = replace(unaligned_scenes.without_order(scene), gaussians=scene.gaussians[::8])
    order = np.random.default_rng(seed).permutation(len(few.gaussians))
    one = find_owners(few, groups(count))
    other = find_owners(replace(few, gaussians=few.gaussians[order]), groups(count))
    for name in ("values", "views", "labels"):
        assert np.array_equal(getattr(one, name)[order], getattr(other, name)), name


@FEW
@given(st.integers(1, 300))
def test_each_gaussian_is_in_at_most_one_superpixel(count: int) -> None:
    scene = unaligned_scenes.without_order(TURNED)
    owners = find_owners(scene, groups(count))
    members = replace(scene_members(with_pixels(scene)), pixels=owner_pixels(owners, groups(count)))
    starts, ids, views = member_rows(scene, members, groups(count))
    assert len(np.unique(ids)) == len(ids)
    assert set(ids) == set(np.flatnonzero(owners.labels >= 0))
    assert (np.diff(starts) > 0).all()
    assert starts[-1] == len(ids)
    assert len(views) == len(starts) - 1
    sizes = np.diff(starts)
    assert (owners.views[ids] == np.repeat(views, sizes)).all()
    assert len(set(zip(owners.views[ids], owners.labels[ids], strict=True))) == len(views)


@FEW
@given(st.integers(0, 1000), st.sampled_from([{}, {"k": 2}, {"budget": 200}]))
def test_permuted_gaussians_merge_alike(seed: int, options: dict) -> None:
    one, other = (
        compact(scene, superpixels="10%", fit="none", poses="fixed", **options).gaussians
        for scene in (unaligned_scenes.without_order(ROOM), unaligned_scenes.shuffled(ROOM, seed))
    )
    assert abs(len(one) - len(other)) <= 2
    assert abs(scenes.psnr_of(one, ROOM) - scenes.psnr_of(other, ROOM)) < 0.1


@sweep("options", [{"fit_steps": 12, "budget": 150}, {"budget": "auto"}])
def test_threads_change_no_bit(options: dict) -> None:
    scene = unaligned_scenes.voxels(ROOM, 0.06)
    actual = [compact(scene, superpixels="10%", threads=threads, **options).gaussians for threads in (1, 3)]
    assert scenes.identical(*actual)


@FEW
@given(st.integers(0, 1000), st.floats(-3, 3))
def test_result_moves_with_a_similarity_of_the_scene(seed: int, exponent: float) -> None:
    """A world in other units, turned and elsewhere."""
    rng = np.random.default_rng(seed)
    factor = 10.0**exponent
    transform = scenes.random_rotation(seed), factor, factor * rng.uniform(-10, 10, 3)
    moved = scenes.move(ROOM, *transform)
    one, other = (
        compact(unaligned_scenes.without_order(scene), superpixels="10%", fit="none", poses="fixed").gaussians
        for scene in (ROOM, moved)
    )
    expected = scenes.move_gaussians(one, *transform)
    assert abs(len(one) - len(other)) <= 2
    distances = cKDTree(expected.means.astype(np.float64)).query(other.means.astype(np.float64))[0] / factor
    assert (distances < 1e-3).mean() > 0.97
