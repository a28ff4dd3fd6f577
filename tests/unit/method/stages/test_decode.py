"""Groups are split into children that keep their moments."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import scenes
from messages import refuses

from gsmerge import Gaussians, Scene
from gsmerge.method.geometry.pooling import Members, feature_to_gaussians, scene_members
from gsmerge.method.geometry.transforms import covariances
from gsmerge.method.kernels import elementary
from gsmerge.method.stages.decode import deal_visible, decode, hull_gains, mixed_counts, split_counts
from gsmerge.method.stages.encode import encode
from gsmerge.method.stages.segment import SegmentOptions, segment
from gsmerge.settings.stages import DecodeOptions
from gsmerge.types import FeatureGaussians, Groups

COUNT = 12  # so that no superpixel has fewer than 8 pixels


def make_scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(2, 24, 18), degree=1)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


@pytest.fixture(scope="module")
def members() -> Members:
    return scene_members(make_scene())


@pytest.fixture(scope="module")
def features() -> FeatureGaussians:
    scene = make_scene()
    groups = segment(scene.images, SegmentOptions(), COUNT)
    return encode(scene, scene_members(scene), groups)


def assert_alike(a: Gaussians, b: Gaussians) -> None:
    for name in ("means", "opacities", "sh0", "shN"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-4, atol=1e-6, err_msg=name)
    one, two = (covariances(g.quats.astype(np.float64), g.scales.astype(np.float64)) for g in (a, b))
    np.testing.assert_allclose(one, two, rtol=1e-4, atol=1e-9)


def test_single_child_is_the_feature(features: FeatureGaussians, members: Members) -> None:
    assert_alike(decode(features, members, DecodeOptions(k=1)), feature_to_gaussians(features))


@pytest.mark.parametrize("k", [2, 4])
def test_children_keep_the_groups_moments(features: FeatureGaussians, members: Members, k: int) -> None:
    """Opacity, colour and place of a group's children average to the group's."""
    children = decode(features, members, DecodeOptions(k=k, min_opacity=0))
    areas = np.sort(children.scales.astype(np.float64), 1)[:, 1:].prod(1)
    depths = -elementary.log1p(-children.opacities.astype(np.float64)) * areas
    assert len(children) == 2 * COUNT * k
    np.testing.assert_allclose(depths.reshape(-1, k).sum(1), features.extinctions, rtol=0.1)
    for name in ("means", "sh0"):
        of_groups = getattr(children, name).reshape(2 * COUNT, k, 3)
        low, high = of_groups.min(1), of_groups.max(1)
        own = getattr(features, name).reshape(-1, 3)
        assert (own >= low - 1e-5).all()
        assert (own <= high + 1e-5).all()


def test_mixed_k_goes_by_the_saliency(features: FeatureGaussians, members: Members) -> None:
    """Half of the groups one, a third two, the rest four: those whose pixels are the most salient."""
    saliency = np.random.default_rng(0).random(len(members.means)).astype(np.float32)
    options = DecodeOptions(k="mixed", k_low=50, k_high=80)
    counts = mixed_counts(features, members, saliency, options)
    ids, starts = features.members, features.starts
    means = [saliency[ids[a:b]].mean() for a, b in pairwise(starts)]
    ranks = np.argsort(np.argsort(means, kind="stable"), kind="stable") / (len(means) - 1) * 100
    assert counts.tolist() == [1 if rank <= 50 else 2 if rank <= 80 else 4 for rank in ranks]
    assert options.mean_k == pytest.approx(1.9)


def test_mixed_k_has_as_many_children_by_distortion_as_by_saliency(
    features: FeatureGaussians, members: Members
) -> None:
    saliency = np.random.default_rng(0).random(len(members.means)).astype(np.float32)
    by_saliency = mixed_counts(features, members, saliency, DecodeOptions(k="mixed"))
    by_distortion = mixed_counts(features, members, saliency, DecodeOptions(k="mixed", k_rule="distortion"))
    assert by_distortion.sum() == by_saliency.sum()
    assert by_distortion.max() <= 4
    np.testing.assert_array_equal(by_distortion, split_counts(features, members, (by_saliency - 1).sum(), 4))


@pytest.mark.parametrize(("low", "high"), [(-1, 50), (101, 101), (60, 50), (50, 101), (float("nan"), 50)])
def test_percentiles_out_of_range_are_refused(low: float, high: float) -> None:
    with pytest.raises(ValueError, match=r"k_low|k_high: expected"):
        DecodeOptions(k="mixed", k_low=low, k_high=high)


def test_groups_of_one_member_are_not_split(scene: Scene, members: Members) -> None:
    """Every pixel its own superpixel: K changes nothing."""
    labels = np.stack([np.arange(scene.pixels_per_view, dtype=np.int32).reshape(18, 24)] * 2)
    features = encode(scene, members, Groups(labels, (432, 432)))
    assert_alike(decode(features, members, DecodeOptions(k=4)), decode(features, members, DecodeOptions(k=1)))


def test_gains_reach_the_children(features: FeatureGaussians, members: Members) -> None:
    plain = decode(features, members, DecodeOptions(k=2, min_opacity=0))
    stronger = replace(features, gains=2 * features.gains)
    changed = decode(stronger, members, DecodeOptions(k=2, min_opacity=0))
    np.testing.assert_array_equal(changed.scales, plain.scales)
    expected = 1 - (1 - plain.opacities.astype(np.float64)) ** 2
    np.testing.assert_allclose(changed.opacities, expected.clip(max=0.999), rtol=1e-4)


@pytest.mark.parametrize("k", [1, 4])
def test_faint_children_are_left_out(scene: Scene, k: int) -> None:
    opacities = scene.gaussians.opacities.copy()
    opacities[: scene.pixels_per_view] = 0
    half = replace(scene, gaussians=replace(scene.gaussians, opacities=opacities))
    own = scene_members(half)
    features = encode(half, own, segment(half.images, SegmentOptions(), COUNT))
    assert len(features) == 2 * COUNT
    actual = decode(features, own, DecodeOptions(k=k))
    assert len(actual) == COUNT * k
    assert (actual.opacities >= 1 / 255).all()


def faint_division(counts: np.ndarray) -> Gaussians:
    """Return groups whose further children are too faint to be seen, except the last two groups'."""
    opacities = np.concatenate(
        [[0.5] + [0.5 if i > 1 else 1e-4 * j for j in range(1, n)] for i, n in enumerate(counts)]
    )
    n = len(opacities)
    columns = np.zeros((n, 3)), np.tile([1.0, 0, 0, 0], (n, 1)), np.ones((n, 3)), opacities
    return Gaussians(*(c.astype(np.float32) for c in columns), np.zeros((n, 1, 3), "f4"), np.zeros((n, 0, 3), "f4"))


@pytest.mark.parametrize(("total", "faint"), [(4, 0), (6, 0), (9, 0), (12, 2), (14, 4), (20, 4)])
def test_faint_gaussians_make_way_for_others(total: int, faint: int) -> None:
    order = np.array([0, 1, 2, 0, 3, 1, 2, 3, 2, 3])  # four groups, ten more Gaussians, four of which are faint
    actual = deal_visible(order, 4, total, 1 / 255, faint_division)
    assert len(actual) == min(total, 14)
    assert int((actual.opacities < 1 / 255).sum()) == faint


def test_splits_stop_where_members_give_no_more(features: FeatureGaussians, members: Members) -> None:
    assert split_counts(features, members, 10_000).tolist() == [8] * 24
    assert split_counts(features, members, 10_000, 3).tolist() == [3] * 24


def test_splits_go_to_the_uneven_groups(features: FeatureGaussians, members: Members) -> None:
    """Group 5 gets many colours, all others one each, on a plane."""
    sh0, own = np.zeros_like(members.sh0), features.members[features.starts[5] : features.starts[6]]
    sh0[own, 0] = np.random.default_rng(0).normal(size=(len(own), 3))
    means = members.means.copy()
    means[:, 2] = 0
    counts = split_counts(features, replace(members, sh0=sh0, means=means), 6)
    assert counts.tolist() == [7 if group == 5 else 1 for group in range(24)]


def test_gains_of_two_steps_are_averaged_where_only_the_second_pays() -> None:
    """Errors of 10, 9, 0: the two steps gain five each on average, so they come before a single gain of four."""
    gains = hull_gains(np.array([[10.0, 9.0, 0.0], [4.0, 0.0, 0.0], [3.0, 1.0, np.nan], [1.0, np.nan, np.nan]]))
    assert gains.tolist() == [[5, 5], [4, 0], [2, -np.inf], [-np.inf, -np.inf]]


def test_split_counts_out_of_range_are_refused(features: FeatureGaussians, members: Members) -> None:
    with refuses(ValueError, "extra", 0, -1):
        split_counts(features, members, -1)
    with refuses(ValueError, "max_children", 1, 0):
        split_counts(features, members, 1, 0)


def test_children_stand_in_the_order_of_their_groups(features: FeatureGaussians, members: Members) -> None:
    counts = np.arange(24) % 3 + 1
    children = decode(features, members, DecodeOptions(min_opacity=0), counts)
    one = decode(features, members, DecodeOptions(min_opacity=0))
    for group, (first, last) in enumerate(pairwise(np.append(0, np.cumsum(counts)))):
        low, high = children.means[first:last].min(0), children.means[first:last].max(0)
        assert (one.means[group] >= low - 1e-5).all()
        assert (one.means[group] <= high + 1e-5).all()
    whole = counts == 1
    np.testing.assert_array_equal(children.means[np.repeat(whole, counts)], one.means[whole])


@pytest.mark.parametrize("counts", [np.ones(3, int), np.zeros(24, int)])
def test_decode_refuses_strange_counts(counts: np.ndarray, features: FeatureGaussians, members: Members) -> None:
    with refuses(ValueError, "counts", 24):
        decode(features, members, DecodeOptions(), counts)
