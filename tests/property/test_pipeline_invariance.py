"""The whole command does not depend on order of views, similarity transforms, seeds and threads."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import scenes
from hypothesis import given, settings
from hypothesis import strategies as st
from sweeps import sweep

from gsmerge import Scene

FEW = settings(max_examples=3, deadline=None, derandomize=True)
ROOM = scenes.make_scene(scenes.room(), scenes.arc(4, 32, 24), noise=0.005)


@FEW
@given(st.permutations(range(4)), st.sampled_from([1, 2]))
def test_result_does_not_depend_on_the_order_of_views(order: list[int], k: int) -> None:
    one, other = scenes.plain(ROOM, k=k), scenes.plain(scenes.take_views(ROOM, order), k=k)
    scenes.assert_same_set(one, other, atol=1e-4)


@FEW
@given(st.integers(0, 1000), st.floats(-4, 4), st.sampled_from([{}, {"match": "none"}, {"k": 2}]))
def test_a_run_of_a_moved_scene_is_the_moved_result(seed: int, exponent: float, options: dict) -> None:
    rng = np.random.default_rng(seed)
    factor = 10.0**exponent
    transform = scenes.random_rotation(seed), factor, factor * rng.uniform(-10, 10, 3)
    one, other = (scenes.plain(scene, **options) for scene in (ROOM, scenes.move(ROOM, *transform)))
    scenes.assert_same_set(other, scenes.move_gaussians(one, *transform), atol=5e-4, unit=factor)


CASES = [
    {"fit_steps": 20, "budget": "10%"}, {}, {"fit": "none", "k": 4, "seed": 3}, {"match": "aabb", "effort": "draft"},
    {"segmentation": "bass-st", "fit": "none"},
    {"dropout": 0.2, "k": 2, "seed": 5},
]  # fmt: skip


@sweep("settings", CASES)
def test_threads_change_no_bit(settings: dict) -> None:
    actual = [scenes.compacted(ROOM, threads=threads, **settings).gaussians for threads in (1, 3)]
    assert scenes.identical(*actual)


def test_two_runs_at_once_do_not_disturb_each_other() -> None:
    expected = [scenes.compacted(ROOM, k=k, fit_steps=10, poses="fixed").gaussians for k in (1, 2)]
    with ThreadPoolExecutor(2) as pool:
        actual = list(pool.map(lambda k: scenes.compacted(ROOM, k=k, fit_steps=10, poses="fixed").gaussians, (1, 2)))
    assert all(scenes.identical(a, b) for a, b in zip(expected, actual, strict=True))


def test_large_groups_of_tasks_change_no_bit() -> None:
    """More superpixels than one task takes."""
    scene: Scene = scenes.make_scene(scenes.wall(), scenes.arc(2, 128, 96))
    actual = [scenes.plain(scene, superpixels="45%", k=2, match="none", threads=threads) for threads in (1, 3)]
    assert len(actual[0]) > 8192
    assert scenes.identical(*actual)
