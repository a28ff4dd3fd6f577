"""Groups of Gaussians become Feature Gaussians."""

from __future__ import annotations

import numpy as np
import pytest
import scenes

from gsmerge import Scene
from gsmerge.method.geometry.pooling import scene_members
from gsmerge.method.kernels import elementary
from gsmerge.method.stages.encode import encode, member_rows
from gsmerge.types import FeatureGaussians, Groups

WIDTH, HEIGHT = 12, 8


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(2, WIDTH, HEIGHT), degree=1)


@pytest.fixture(scope="module")
def groups() -> Groups:
    """Return squares of four pixels."""
    ys, xs = np.mgrid[:HEIGHT, :WIDTH]
    labels = (ys // 4 * (WIDTH // 4) + xs // 4).astype(np.int32)
    return Groups(np.stack([labels, labels]), (6, 6))


def encoded(scene: Scene, groups: Groups, rule: str = "depth") -> FeatureGaussians:
    return encode(scene, scene_members(scene), groups, rule=rule)


def test_member_rows_are_those_of_their_group_and_view(scene: Scene, groups: Groups) -> None:
    starts, ids, views = member_rows(scene, scene_members(scene), groups)
    assert np.diff(starts).tolist() == [16] * 12
    assert views.tolist() == [0] * 6 + [1] * 6
    labels = groups.labels.reshape(-1)
    for g in range(12):
        own = ids[starts[g] : starts[g + 1]]
        assert (labels[own] == g % 6).all()
        assert (own // (WIDTH * HEIGHT) == g // 6).all()


def test_invalid_pixels_are_left_out(scene: Scene, groups: Groups) -> None:
    valid = scene.pixels.shown.copy()
    valid[0, :4, :4] = False  # a whole superpixel
    valid[1, 0, 0] = False
    partial = scenes.shown_in(scene, valid)
    starts, ids, views = member_rows(partial, scene_members(partial), groups)
    assert np.diff(starts).tolist() == [16] * 5 + [15] + [16] * 5
    assert views.tolist() == [0] * 5 + [1] * 6
    assert len(np.unique(ids)) == len(ids) == int(valid.sum())
    features = encoded(scenes.shown_in(scene, valid), groups)
    assert len(features) == 11


@pytest.mark.parametrize("rule", ["depth", "paper"])
def test_scene_without_valid_pixels_has_no_features(scene: Scene, groups: Groups, rule: str) -> None:
    assert len(encoded(scenes.shown_in(scene, np.zeros_like(scene.pixels.shown)), groups, rule)) == 0


def test_views_may_have_different_counts(scene: Scene, groups: Groups) -> None:
    labels = groups.labels.copy()
    labels[1] = 0
    _, _, views = member_rows(scene, scene_members(scene), Groups(labels, (6, 1)))
    assert views.tolist() == [0] * 6 + [1]


def test_features_keep_the_sums_of_weights_masses_and_extinctions(scene: Scene, groups: Groups) -> None:
    features = encoded(scene, groups)
    assert len(features) == 12
    assert float(features.weights.sum()) == pytest.approx(float(scene.gaussians.opacities.sum()), rel=1e-5)
    scales = scene.gaussians.scales.astype(np.float64)
    mass = (scene.gaussians.opacities * scales.prod(1)).sum() * (2 * np.pi) ** 1.5  # paper eq. mass
    assert float(features.masses.sum()) == pytest.approx(float(mass), rel=1e-4)
    largest = np.sort(scales, 1)[:, 1:].prod(1)
    extinction = (-elementary.log1p(-scene.gaussians.opacities.astype(np.float64)) * largest).sum()
    assert float(features.extinctions.sum()) == pytest.approx(float(extinction), rel=1e-4)
    assert (features.gains == 1).all()
    assert features.shN.shape == (12, 3, 3)
