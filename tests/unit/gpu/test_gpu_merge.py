"""Encoding, matching, merging and decoding on a device are the stages of the CPU."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import scenes
import torch

from gsmerge import PixelScene
from gsmerge.gpu import decode as gpu_decode
from gsmerge.gpu import match as gpu_match
from gsmerge.gpu import pool as gpu_pool
from gsmerge.gpu.axes import feature_to_gaussians as gpu_feature_to_gaussians
from gsmerge.gpu.axes import principal_axes
from gsmerge.gpu.runs import group_rows, middle_of_runs, smallest_by_part
from gsmerge.gpu.scene import Features, download_features, to_device, upload_members
from gsmerge.kernels.gaussians.cluster import leader_clusters
from gsmerge.moments import Members, feature_to_gaussians, scene_members
from gsmerge.moments import principal_axes as axes_of
from gsmerge.networks.neighbors import nearest_of_other_views
from gsmerge.stages import encode as encode_stage
from gsmerge.stages.decode import DecodeOptions, deal_order, deal_visible, decode, split_counts
from gsmerge.stages.encode import EncodeOptions, encode
from gsmerge.stages.match import MatchOptions, match
from gsmerge.stages.merge import merge
from gsmerge.stages.prepare import canonicalise
from gsmerge.stages.segment import SegmentOptions, segment
from gsmerge.types import FeatureGaussians, Groups

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def scene() -> PixelScene:
    """Four views of which some pixels have no Gaussian, with harmonics."""
    made = scenes.make_scene(scenes.room(), scenes.arc(4, 40, 30, span=0.2), noise=0.004, degree=1)
    valid = made.valid.copy()
    valid[0, :9, :11] = False
    opacities = made.gaussians.opacities.copy()
    opacities[1300:1420] = 0.0
    quats = made.gaussians.quats.copy()
    quats[77] = 0.0
    gaussians = replace(made.gaussians, opacities=opacities, quats=quats)
    return canonicalise(replace(made, valid=valid, gaussians=gaussians))[0]


@pytest.fixture(scope="module")
def members(scene: PixelScene) -> Members:
    return scene_members(scene)


@pytest.fixture(scope="module")
def groups(scene: PixelScene) -> Groups:
    assert scene.images is not None
    return segment(scene.images, SegmentOptions(superpixels=60))


@pytest.fixture(scope="module")
def features(scene: PixelScene, members: Members, groups: Groups) -> FeatureGaussians:
    return encode(scene, members, groups, EncodeOptions())


def upload(features: FeatureGaussians) -> Features:
    """What a stage of the CPU made, for the functions of a device."""
    return Features(*(to_device(getattr(features, f.name), CPU) for f in fields(Features)))


def same(ours: Features, expected: FeatureGaussians, rtol: float = 1e-5) -> None:
    for f in fields(Features):
        a, b = getattr(ours, f.name), torch.as_tensor(getattr(expected, f.name))
        assert a.shape == b.shape, f.name
        assert a.dtype == b.dtype, f.name
        scale = float(b.double().abs().max()) if b.numel() else 0.0
        torch.testing.assert_close(a, b, rtol=rtol, atol=1e-7 * scale, msg=f.name)


def test_rows_of_the_superpixels(scene: PixelScene, groups: Groups) -> None:
    counts = np.array(groups.counts)
    labels = torch.as_tensor(groups.labels).long() + torch.from_numpy(np.cumsum(counts) - counts)[:, None, None]
    rows = group_rows(torch.where(torch.as_tensor(scene.valid), labels, -1).reshape(-1), int(counts.sum()))
    starts, ids, views = encode_stage.group_rows(scene, groups)
    np.testing.assert_array_equal(rows.starts, starts)
    np.testing.assert_array_equal(rows.ids, ids)
    np.testing.assert_array_equal(rows.groups // counts[0], views)
    assert len(rows) < counts.sum(), "the hole swallows some"


def test_moments_are_the_kernels(members: Members, features: FeatureGaussians, monkeypatch: pytest.MonkeyPatch) -> None:
    f = features
    rows = gpu_pool.Rows(*map(torch.as_tensor, (f.starts, f.members, f.views)))
    for at_once in (gpu_pool.AT_ONCE, 500):
        monkeypatch.setattr(gpu_pool, "AT_ONCE", at_once)
        same(gpu_pool.encode(upload_members(members, CPU), rows, rows.groups), features)


def test_large_members_are_shrunk(members: Members, features: FeatureGaussians) -> None:
    """The winsorising decides here: without it the moments would be far off."""
    scales = members.scales.copy()
    scales[::9] *= 30
    wide = upload_members(replace(members, scales=scales), CPU)
    starts, ids = torch.as_tensor(features.starts), torch.as_tensor(features.members)
    caps = gpu_pool.member_caps(wide, starts, ids, gpu_pool.owners_of(starts, len(ids)))
    assert float(caps.min()) < 0.2
    from gsmerge.moments import pool_members

    expected = pool_members(replace(members, scales=scales), np.asarray(features.starts), np.asarray(features.members))
    ours = gpu_pool.pool_members(wide, starts, ids)
    np.testing.assert_allclose(ours.covars, expected.covars, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(ours.extinctions, expected.extinctions, rtol=1e-6)


def test_principal_axes_are_the_kernels() -> None:
    rng = np.random.default_rng(0)
    half = rng.normal(size=(500, 3, 3)) * 10.0 ** rng.integers(-4, 2, (500, 1, 3))
    covars = half @ half.transpose(0, 2, 1)
    covars[:4] = np.array([np.eye(3), np.diag([3.0, 1, 2]), np.zeros((3, 3)), np.diag([1.0, 1, 5])])
    scales, quats = principal_axes(torch.from_numpy(covars))
    expected = axes_of(covars)
    np.testing.assert_allclose(scales, expected[0], rtol=1e-7, atol=1e-9)
    dots = np.abs((quats.numpy() * expected[1]).sum(1))
    np.testing.assert_allclose(dots, 1, atol=1e-7)


def test_neighbours_are_the_nearest(features: FeatureGaussians, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_match, "PAIRS_AT_ONCE", 3000)
    means, views = torch.as_tensor(features.means).double(), torch.as_tensor(features.views)
    ours = gpu_match.nearest_of_other_views(means, views, 5).numpy()
    expected = nearest_of_other_views(means.numpy(), views.numpy(), 5)
    assert (ours == expected).mean() > 0.999
    few = gpu_match.nearest_of_other_views(means[:3], torch.tensor([0, 1, 1]), 5)
    assert few.tolist()[1][:2] == [0, -1]


@pytest.mark.parametrize(
    "options", [{}, {"overlap": 0.2, "max_color": 0.5}, {"cluster_size": 2}, {"match": "none"}], ids=str
)
def test_clusters_are_the_kernels(features: FeatureGaussians, options: dict) -> None:
    settings = MatchOptions(**options)
    clusters, count = gpu_match.match(upload(features), settings)
    expected = match(features, settings)
    assert count == expected.count
    np.testing.assert_array_equal(clusters, expected.clusters)
    if settings.method != "none":
        assert count < len(features) * 0.9
        same(gpu_match.merge(upload(features), clusters, count), merge(features, expected), rtol=1e-4)


def test_rounds_of_leaders_are_the_greedy_order() -> None:
    """Long chains of preferences, ties, and leaders whose candidates are taken."""
    rng = np.random.default_rng(1)
    for size, views in ((4, 3), (2, 30), (30, 4)):
        num = 300
        neighbors = np.stack([rng.permutation(num)[:8] for _ in range(num)])
        neighbors[rng.random(neighbors.shape) < 0.1] = -1
        scores = np.where(neighbors < 0, -1.0, rng.integers(0, 10, neighbors.shape) / 10)
        of, order = rng.integers(0, views, num), rng.permutation(num)
        scores[of[neighbors] == of[:, None]] = -1
        tensors = map(torch.from_numpy, (order, neighbors, scores, of))
        ours, count = gpu_match.leader_clusters(*tensors, 0.4, size)
        expected, expected_count = leader_clusters(order, neighbors, scores, of, 0.4, size)
        assert count == expected_count
        np.testing.assert_array_equal(ours, expected)


@pytest.fixture(scope="module")
def merged(features: FeatureGaussians) -> FeatureGaussians:
    return merge(features, match(features, MatchOptions()))


@pytest.mark.parametrize("k", [1, 2, 3, 8])
def test_children_are_the_stages(merged: FeatureGaussians, members: Members, k: int) -> None:
    options = DecodeOptions(k=k)
    ours = gpu_decode.decode(upload(merged), upload_members(members, CPU), options, None)
    expected = decode(merged, members, options)
    assert len(ours) == len(expected)
    for name in ("means", "scales", "opacities", "sh0", "shN"):
        ours_is, theirs = (torch.as_tensor(getattr(g, name)) for g in (ours, expected))
        torch.testing.assert_close(ours_is, theirs, rtol=1e-4, atol=1e-6, msg=name)


def test_more_gaussians_go_where_the_stage_spends_them(merged: FeatureGaussians, members: Members) -> None:
    device = upload(merged), upload_members(members, CPU)
    for extra in (0, 1, 40, 10_000):
        np.testing.assert_array_equal(gpu_decode.split_counts(*device, extra), split_counts(merged, members, extra))
    count = len(merged) + 40
    assert len(gpu_decode.decode(*device, DecodeOptions(min_opacity=0), count)) == count


@pytest.mark.parametrize("extra", [1, 40])
def test_faint_gaussians_make_way_for_others(merged: FeatureGaussians, members: Members, extra: int) -> None:
    """An exact number is met, as the stage meets it; a tenth is below the least opacity at first."""
    device, count = (upload(merged), upload_members(members, CPU)), len(merged) + extra
    faint = float(np.quantile(feature_to_gaussians(merged).opacities, 0.1))
    few = gpu_decode.decode(*device, DecodeOptions(min_opacity=faint), count)
    exact = gpu_decode.decode(*device, DecodeOptions(min_opacity=faint), count, exact=True)
    assert len(few) < len(exact) == count
    order = deal_order(merged, members)
    np.testing.assert_array_equal(gpu_decode.deal_order(*device), order)
    every = DecodeOptions(min_opacity=0)
    expected = deal_visible(order, len(merged), count, faint, lambda counts: decode(merged, members, every, counts))
    np.testing.assert_allclose(exact.opacities, expected.opacities, rtol=1e-4, atol=1e-6)


def test_members_that_are_alike_are_not_divided(merged: FeatureGaussians, members: Members) -> None:
    alike = replace(members, means=np.zeros_like(members.means), sh0=np.zeros_like(members.sh0))
    few = upload(merged)
    counts = torch.full((len(few),), 4)
    assert len(gpu_decode.divide(few, upload_members(alike, CPU), counts)) == len(few)


def test_one_gaussian_each(merged: FeatureGaussians) -> None:
    ours, expected = gpu_feature_to_gaussians(upload(merged)), feature_to_gaussians(merged)
    torch.testing.assert_close(ours.scales, torch.as_tensor(expected.scales), rtol=1e-5, atol=0)
    torch.testing.assert_close(ours.opacities, torch.as_tensor(expected.opacities), rtol=1e-5, atol=1e-7)


def test_there_and_back(merged: FeatureGaussians) -> None:
    back = download_features(upload(merged))
    same(upload(back), merged, rtol=0)


def test_nothing_to_do() -> None:
    assert len(group_rows(torch.full((3,), -1), 2)) == 0
    empty = torch.zeros(0, dtype=torch.int64)
    assert smallest_by_part(torch.zeros(0), empty, torch.tensor([0])).tolist() == [torch.inf]
    starts = torch.tensor([0, 1, 4])
    middle = middle_of_runs(torch.tensor([5.0, 3, 1, 2]), starts, gpu_pool.owners_of(starts, 4))
    assert middle.tolist() == [5, 2]
