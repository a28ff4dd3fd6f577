"""Some clusters must not form (stability.md, cases 18 to 20)."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
from sweeps import sweep

from gsmerge import Cameras
from gsmerge.method.geometry.pooling import feature_to_gaussians
from gsmerge.method.stages.match import match
from gsmerge.method.stages.merge import merge
from gsmerge.settings.stages import MatchOptions
from gsmerge.types import FeatureGaussians

SIZE = 0.05


def diameters(features: FeatureGaussians, **settings: object) -> np.ndarray:
    """Return the largest distance within each cluster, in standard deviations."""
    clusters = match(features, MatchOptions(**settings)).clusters  # type: ignore[arg-type]
    means = features.means.astype(np.float64)
    own = [means[clusters == c] for c in np.unique(clusters)]
    return np.array([np.linalg.norm(m[:, None] - m[None], axis=-1).max() for m in own]) / SIZE


def chain(count: int, apart: float) -> FeatureGaussians:
    """Return Gaussians in a row along x, views taking turns, each overlapping the next."""
    means = np.stack([apart * SIZE * np.arange(count), np.zeros(count), np.full(count, 3.0)], 1)
    return scenes.make_features(means, sizes=SIZE, views=np.arange(count) % 7)


@sweep("apart", [0.5, 0.2, 1.0, 1.5], ids="{} deviations apart".format)
# One of each of the seven views is in a cluster, unless told
@pytest.mark.parametrize(("size", "most"), [(None, 7), (4, 4)], ids=["one of each view", "cluster_size=4"])
def test_chain_of_a_thousand_does_not_collapse(size: int | None, most: int, apart: float) -> None:
    features = chain(1000, apart)
    actual = diameters(features, cluster_size=size)
    assert actual.max() <= 2 * np.sqrt(-8 * np.log(0.7))  # two leaders' reaches: exp(-d^2 / 8) = 0.7
    assert len(actual) >= 1000 / most


def test_chain_of_boxes_does_not_collapse() -> None:
    """Components of boxes have no limit: only that each is compared with its nearest keeps them apart."""
    steps = np.random.default_rng(0).uniform(0.4, 1.2, 1000)
    means = np.stack([SIZE * np.cumsum(steps), np.zeros(1000), np.full(1000, 3.0)], 1)
    features = scenes.make_features(means, sizes=SIZE, views=np.arange(1000) % 7)
    assert match(features, MatchOptions(match="aabb", neighbors=16)).count == 1
    actual = diameters(features, match="aabb")
    assert len(actual) > 200
    assert actual.max() < 10


def test_chained_wall_stays_covered() -> None:
    """A closed wall of Feature Gaussians, each matching its neighbours, before and after merging."""
    n = 32
    xs, ys = np.meshgrid(np.arange(n), np.arange(n))
    means = np.stack([xs.ravel() - n / 2, ys.ravel() - n / 2, np.full(n * n, 3.0 / SIZE)], 1) * [1.2, 1.2, 1] * SIZE
    wall = scenes.make_features(means, sizes=SIZE, views=(xs + 3 * ys).ravel() % 7, opacities=0.9)
    merged = merge(wall, match(wall, MatchOptions()))
    assert len(merged) < len(wall)
    camera = scenes.arc(1, 32, 24)
    before, after = (scenes.images_of(feature_to_gaussians(f), camera)[1] for f in (wall, merged))
    assert after.mean() >= 0.95 * before.mean()
    assert after.min() >= 0.9 * before.min()


def test_wall_seen_by_many_views_does_not_collapse() -> None:
    scene = scenes.make_scene(scenes.wall(), scenes.arc(6, 32, 24, span=0.2))
    alone, actual = scenes.plain(scene, match="none"), scenes.plain(scene)
    assert 0.15 * len(alone) < len(actual) < len(alone)
    single = scenes.plain(scenes.take_views(scene, [0]))
    coverage = [scenes.images_of(g, scene.cameras[:1])[1].mean() for g in (single, actual)]
    assert coverage[1] >= coverage[0]


def opposite_cameras(width: int = 32, height: int = 24) -> Cameras:
    """Return cameras in front of and behind z = 3."""
    centre = np.array([0.0, 0.0, 3.0])
    viewmats = [scenes.look_at(np.array([0.0, 0.0, z]), centre) for z in (0.0, 6.0)]
    return Cameras(np.stack(viewmats), scenes.intrinsics(2, width, height), width, height)


@pytest.mark.parametrize("method", ["overlap", "aabb"], ids="match={}".format)
def test_two_sides_of_a_sheet_are_not_merged(method: str) -> None:
    """One colour, two footprints apart, each side seen by its own view."""
    grey, cameras = scenes.flat(0.5, 0.5, 0.5), opposite_cameras()
    footprint = 3 / cameras.width
    sides = [scenes.plane(3 - footprint, grey), scenes.plane(3 + footprint, grey)]
    scene = scenes.make_scene(sides, cameras)
    actual = scenes.compacted(scene, match=method, fit="none", checkpoint="none")
    assert actual.report.choices["clusters"] == actual.report.choices["groups"]
    off = np.abs(actual.gaussians.means[:, 2] - 3) / footprint
    assert (np.abs(off - 1) < 0.2).all()


@pytest.mark.parametrize("method", ["overlap", "aabb"], ids="match={}".format)
def test_repeated_texture_is_not_merged(method: str) -> None:
    """Every Feature Gaussian looks like every other, and none is near another."""
    rng = np.random.default_rng(0)
    means = np.stack(np.meshgrid(*[np.arange(6)] * 3), -1).reshape(-1, 3) * 5.0 * SIZE
    features = scenes.make_features(means, sizes=SIZE, views=rng.integers(0, 4, len(means)))
    assert match(features, MatchOptions(match=method)).count == len(means)  # type: ignore[arg-type]
