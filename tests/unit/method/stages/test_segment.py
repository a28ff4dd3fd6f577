"""Regions of all views form one tree, and the plan tells to how many superpixels it is cut."""

from __future__ import annotations

from unittest import mock

import numpy as np
import pytest
import scenes
from messages import refuses

from gsmerge import CompactOptions, Scene
from gsmerge.method.stages import segment as module
from gsmerge.method.stages.limits import CountLimits
from gsmerge.method.stages.segment import (
    RegionTree,
    SharedTree,
    SuperpixelChoices,
    cut_tree,
    front_depths,
    knee,
    knee_count,
    region_tree,
    segment_scene,
)
from gsmerge.method.stages.superpixels import segment
from gsmerge.plan.make_plan import make_plan
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.settings.stages import SegmentOptions
from gsmerge.types import Groups, PicturedScene

SHARE = {"superpixels": "5%"}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24), noise=0.01)


def scene_and_choices(scene: Scene, **settings: object) -> tuple[Scene, SuperpixelChoices, CountLimits]:
    options = CompactOptions().with_settings({"fit": "none"} | settings)
    prepared = prepare(scene, options.prepare)
    plan = make_plan(prepared, options)
    return prepared.scene, plan.merge.superpixels, plan.count.limits


def test_a_fit_begins_with_a_share_of_the_number(scene: Scene) -> None:
    whole = segment_scene(*scene_and_choices(scene, **SHARE), None)
    canonical, choices, limits = scene_and_choices(scene, **SHARE, fit="full")
    assert choices.start_share < 1
    segmentation = segment_scene(canonical, choices, limits, None)
    assert segmentation.count == pytest.approx(whole.count, rel=0.02)
    assert len(segmentation.groups) < 1.02 * choices.start_share * segmentation.count


def test_an_exact_number_is_met(scene: Scene) -> None:
    assert segment_scene(*scene_and_choices(scene, **SHARE | {"superpixels": 40}), None).groups.counts == (40, 40, 40)
    assert len(segment_scene(*scene_and_choices(scene, **SHARE), 100).groups) == 100
    assert len(scenes.plain(scene, **SHARE, budget=90)) == 90


HEIGHT, WIDTH = 40, 60


def cut(images: np.ndarray, count: int) -> Groups:
    return segment(images, SegmentOptions(), count)


def tree_of(images: np.ndarray, depths: np.ndarray, count: int = 200, **constants: float) -> RegionTree:
    """Return the tree of whole pictures, with other constants, named as those of the module."""
    valid = np.ones(depths.shape, bool)
    with mock.patch.dict(vars(module), constants):
        return region_tree(images, depths, cut(images, count), valid)


def grey(num_views: int = 1) -> np.ndarray:
    return np.full((num_views, HEIGHT, WIDTH, 3), 0.5, np.float32)


def noise(num_views: int = 1) -> np.ndarray:
    return np.random.default_rng(2).random((num_views, HEIGHT, WIDTH, 3), dtype=np.float32)


def slanted(num_views: int = 1) -> np.ndarray:
    """Return depths of a wall that is not parallel to the image."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return np.stack([(1 / (1 + 0.01 * x - 0.008 * y)).astype(np.float32)] * num_views)


# ---------------------------------------------------------------- merging regions


def test_noise_gets_nearly_all_regions_beside_a_plain_wall() -> None:
    """One view of a plain wall and one of noise: nearly all regions go to the noise."""
    images = np.concatenate([grey(), noise()])
    groups = cut_tree(tree_of(images, slanted(2), MAX_EXTENT=0.5), 200)
    assert groups.counts[0] + groups.counts[1] == 200
    assert groups.counts[0] < 15


def test_depth_edges_are_kept() -> None:
    """Of equal colour, but the right half is nearer: no region reaches across."""
    depths = slanted()
    depths[:, :, WIDTH // 2 :] *= 0.7
    images = grey()
    labels = np.arange(HEIGHT * WIDTH // 4, dtype=np.int32).reshape(1, HEIGHT // 2, WIDTH // 2)
    fine = labels.repeat(2, 1).repeat(2, 2)
    groups = Groups(fine, (HEIGHT * WIDTH // 4,))
    with mock.patch.object(module, "MAX_EXTENT", 1.0):
        tree = region_tree(images, depths, groups, np.ones_like(depths, dtype=bool))
    coarse = cut_tree(tree, 20).labels[0]
    assert not set(np.unique(coarse[:, : WIDTH // 2])) & set(np.unique(coarse[:, WIDTH // 2 :]))
    assert tree.distortions[-1] > 10 * tree.distortions[-20]
    without = tree_of(images, depths, DEPTH_WEIGHT=0.0)
    np.testing.assert_allclose(without.distortions, 0, atol=1e-9)


@pytest.mark.parametrize("portrait", [False, True])
def test_regions_keep_below_the_largest_extent_until_there_is_no_other_way(portrait: bool) -> None:
    """A quarter of the longer side, whichever that is."""
    images, depths = grey(), slanted()
    if portrait:
        images, depths = images.swapaxes(1, 2), depths.swapaxes(1, 2)
    tree = tree_of(images, depths, MAX_EXTENT=1 / 4)
    side = WIDTH / 4

    def extents(count: int) -> np.ndarray:
        labels = cut_tree(tree, count).labels[0]
        boxes = [np.nonzero(labels == i) for i in range(count)]
        return np.array([max(np.ptp(y), np.ptp(x)) for y, x in boxes])

    assert tree.min_regions < 60
    assert side / 2 < extents(tree.min_regions).max() < side
    assert extents(3).max() >= side


@pytest.mark.parametrize("depth_weight", [0.0, 4.0])
def test_distortions_are_those_of_the_cuts(depth_weight: float) -> None:
    images, tree = noise(2), tree_of(noise(2), slanted(2), 50, DEPTH_WEIGHT=depth_weight)
    assert tree.counts.tolist() == list(range(100, 1, -1))
    assert (np.diff(tree.distortions) >= 0).all()
    for count in (100, 60, 20, 2):
        groups, error = cut_tree(tree, count), 0.0
        for view in range(2):
            labels, pixels = groups.labels[view], images[view].astype(np.float64)
            error += sum(
                ((pixels[labels == i] - pixels[labels == i].mean(0)) ** 2).sum() for i in range(groups.counts[view])
            )
        assert tree.distortions[100 - count] == pytest.approx(error / images.size, rel=1e-3)


def test_regions_without_valid_pixels_go_first() -> None:
    images, depths = noise(), slanted()
    valid = np.ones_like(depths, dtype=bool)
    valid[:, :, : WIDTH // 2] = False
    groups = cut(images, 100)
    filled = len(np.unique(groups.labels[valid]))
    coarse = cut_tree(region_tree(images, depths, groups, valid), filled)
    assert len(np.unique(coarse.labels[valid])) == filled


def test_strange_depths_do_no_harm() -> None:
    depths = slanted(3)
    depths[0, :5], depths[0, 5:10], depths[0, 10:15], depths[0, 15:20] = 0, -1, np.nan, np.inf
    depths[1], depths[2] = -1, np.nan
    tree = tree_of(noise(3), depths)
    assert np.isfinite(tree.distortions).all()
    assert len(cut_tree(tree, 100)) == 100


def test_front_depths_are_along_the_axis_of_the_camera() -> None:
    scene = scenes.make_scene(scenes.wall(), scenes.arc(2, 8, 6))
    depths = front_depths(scene)
    eyes = scene.cameras.centres.repeat(48, 0)
    forward = scene.cameras.viewmats[:, 2, :3].repeat(48, 0)
    expected = ((scene.gaussians.means - eyes) * forward).sum(1)
    np.testing.assert_allclose(depths.reshape(-1), expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("name", "value", "found"),
    [
        ("images", np.zeros((1, HEIGHT, WIDTH)), [[1, 40, 60, 3], [1, 40, 60]]),
        ("depths", np.zeros((2, HEIGHT, WIDTH)), [[1, 40, 60], [2, 40, 60]]),
        ("valid", np.zeros((1, 3, 3)), [[1, 40, 60], [1, 3, 3]]),
        ("groups", Groups(np.zeros((1, HEIGHT, WIDTH), np.int32), (2,)), ["2 superpixels", "view 0"]),
        ("groups", Groups(np.ones((1, HEIGHT, WIDTH), np.int32), (1,)), ["1 superpixels", "view 0"]),
    ],
)
def test_arguments_that_do_not_fit_are_refused(name: str, value: object, found: list[object]) -> None:
    good = {"images": grey(), "depths": slanted(), "groups": cut(grey(), 5), "valid": slanted() > 0}
    with refuses(ValueError, name, *found):
        region_tree(**good | {name: value})


def test_budget_below_the_number_of_views() -> None:
    with refuses(ValueError, "budget", 2, 1):
        cut_tree(tree_of(noise(2), slanted(2)), 1)


# ---------------------------------------------------------------- the knee


def test_knee_is_at_one_for_a_wall_and_far_up_for_a_texture() -> None:
    wall, texture = tree_of(grey(), slanted()), tree_of(noise(), slanted())
    assert knee(wall.counts, wall.distortions) == 1
    assert knee(texture.counts, texture.distortions) > 100


def test_knee_count_of_a_wall_is_the_least_that_keeps_regions_small() -> None:
    wall, texture = tree_of(grey(), slanted()), tree_of(noise(), slanted())
    scene = PicturedScene.with_pictures(
        scenes.make_scene(scenes.room(), scenes.arc(1, WIDTH, HEIGHT)), noise(), None
    )  # whose tree is there

    def count(tree: RegionTree, most: int = 1000) -> int:
        limits = CountLimits(1, 1, min_count=1, max_count=most, exact=None, num_pixels=1, num_input=1000, most=1000)
        return knee_count(scene, SuperpixelChoices(SegmentOptions(), shared=SharedTree(tree)), limits)

    assert count(wall) == wall.min_regions < 150
    assert count(wall, most=5) == 5
    labels = cut_tree(wall, wall.min_regions).labels[0]
    boxes = [np.nonzero(labels == i) for i in range(wall.min_regions)]
    assert max(max(np.ptp(y), np.ptp(x)) for y, x in boxes) < WIDTH / 8
    assert count(texture) == knee(texture.counts, texture.distortions) > wall.min_regions


@pytest.mark.parametrize("floor", [1e-3, 1e-4])
def test_knee_is_where_the_slope_is_the_one_that_is_worth_it(floor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """D = 0.1 / N without a floor: 10 / ln 10 = 4.3 dB per relative increase everywhere; with one it falls."""
    counts = np.arange(1, 2000)
    monkeypatch.setattr(module, "REGION_KNEE_SLOPE", 2.0)
    monkeypatch.setattr(module, "KNEE_FLOOR", floor)
    actual = knee(counts, 0.1 / counts)
    middle = actual / 1.25**0.5  # the slope is measured over a factor of 1.25
    share = (0.1 / middle) / (floor + 0.1 / middle)
    assert 10 / np.log(10) * share == pytest.approx(2.0, rel=0.02)


def test_knee_of_no_distortions_is_refused() -> None:
    with refuses(ValueError, "", "distortions", "(0,)"):
        knee(np.array([], int), np.array([]))
