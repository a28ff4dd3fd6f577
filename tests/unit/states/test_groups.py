"""The groups of a state: what they decode to, and how they are picked, joined, replaced and thinned out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from network_fixtures import SMALL, Made, made, noisy, written
from view_batches import decoded, group, one_batch, random_gaussians, same_group, same_groups

from gsmerge import Gaussians, Scene
from gsmerge.geometry import covariances
from gsmerge.networks.apply import encode_features
from gsmerge.networks.corrector import ANALYTIC
from gsmerge.pooling import feature_to_gaussians, gaussian_members
from gsmerge.settings.stages import DecodeOptions
from gsmerge.stages.decode import decode
from gsmerge.states.groups import (
    bake,
    child_members,
    divide_groups,
    limit_children,
    moments_of,
    select_groups,
    share,
    with_fitted_colors,
)
from gsmerge.states.state import Colors, GroupSet
from gsmerge.types import FeatureGaussians

ALL = DecodeOptions(min_opacity=0.0)


@pytest.fixture(scope="module")
def some() -> Made:
    return made()


@pytest.fixture(scope="module")
def uneven(some: Made) -> FeatureGaussians:
    """Groups with gains of their own, as the photos leave them."""
    gains = np.random.default_rng(0).uniform(0.3, 3.0, len(some.features))
    return replace(some.features, gains=gains.astype(np.float32))


@pytest.fixture(scope="module")
def groups(some: Made, uneven: FeatureGaussians) -> GroupSet:
    actual = bake(uneven, some.members, ANALYTIC, 4)
    rng = np.random.default_rng(1)
    fitted_sh0 = actual.colors.sh0 + rng.normal(0, 0.1, actual.colors.sh0.shape).astype(np.float32)
    return replace(actual, colors=Colors(fitted_sh0, rng.random(len(actual), np.float32)))


def assert_close(one: Gaussians, other: Gaussians, rtol: float = 1e-4) -> None:
    """Row by row, whatever the order and signs of the axes."""
    assert len(one) == len(other)
    a, b = (covariances(g.quats.astype(np.float64), g.scales.astype(np.float64)) for g in (one, other))
    size = np.trace(b, axis1=1, axis2=2)
    assert (np.abs(a - b).max((1, 2)) / size).max() <= rtol
    assert (np.linalg.norm(one.means - other.means, axis=1) / np.sqrt(size)).max() <= rtol
    for name in ("opacities", "sh0", "shN"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=rtol)


def assert_same_children(one: Gaussians, other: Gaussians) -> None:
    """In any order; pooling takes nothing for more solid than 0.995."""
    scenes.assert_same_set(one, other, atol=5e-3, unit=0.05)


def ones_and_most(groups: GroupSet, most: int) -> tuple[Gaussians, Gaussians]:
    """What the state's own decoding makes of the groups at K = 1 and at most."""
    members = child_members(groups)
    return feature_to_gaussians(groups.features), decode(groups.features, members, replace(ALL, k=most))


@pytest.mark.parametrize("most", [1, 4])
def test_baked_is_what_the_stages_decode(most: int, some: Made, uneven: FeatureGaussians) -> None:
    actual = bake(uneven, some.members, ANALYTIC, most)
    ones, children = ones_and_most(actual, most)
    assert_close(ones, feature_to_gaussians(uneven))
    expected = decode(uneven, some.members, replace(ALL, k=most)) if most > 1 else feature_to_gaussians(uneven)
    assert scenes.identical(actual.children, expected)
    assert_same_children(children, expected)
    assert int(np.diff(actual.features.starts).max()) <= most


def test_heads_are_in_what_is_baked(some: Made) -> None:
    networks = some.networks(noisy())
    features = encode_features(some.features, networks)
    assert features.latents.shape[1] == SMALL.latent
    actual = bake(features, some.members, networks, 4)
    assert actual.features.latents.shape == (len(features), 0)
    ones, children = ones_and_most(actual, 4)
    # lengths are floored beside the largest, so that the thinnest may be told anew
    assert_close(ones, decode(features, some.members, ALL, networks=networks), rtol=1e-3)
    expected = decode(features, some.members, replace(ALL, k=4), networks=networks)
    assert_same_children(children, expected)
    plain = bake(features, some.members, ANALYTIC, 4)
    assert not np.array_equal(plain.children.sh0, actual.children.sh0)


def test_moments_are_what_is_decoded_from_them() -> None:
    gaussians = random_gaussians(60, 3, degree=3)
    features = scenes.make_features(gaussians.means, degree=3)
    assert_close(feature_to_gaussians(replace(features, **moments_of(gaussians))), gaussians)


def test_moments_of_the_faintest_and_the_most_solid() -> None:
    gaussians = replace(random_gaussians(4, 5), opacities=np.array([0.0, 1e-6, 0.999, 1.0], np.float32))
    features = replace(scenes.make_features(gaussians.means), **moments_of(gaussians))
    actual = feature_to_gaussians(features).opacities
    np.testing.assert_allclose(actual, [0, 1e-6, 0.999, 0.999], atol=1e-6)


def test_pick_takes_groups_with_their_children(groups: GroupSet) -> None:
    rows = np.array([5, 0, 17, 5])
    actual = select_groups(groups, rows)
    assert len(actual) == 4
    for place, row in enumerate(rows.tolist()):
        assert same_group(actual, place, groups, row)
    np.testing.assert_array_equal(actual.features.members, np.arange(len(actual.children)))


def test_thinned_pools_the_children_of_crowded_groups(groups: GroupSet) -> None:
    actual = limit_children(groups, 2)
    sizes, before = np.diff(actual.features.starts), np.diff(groups.features.starts)
    assert int(sizes.max()) == 2
    assert int(before.max()) > 2
    for row in range(len(groups)):
        if before[row] <= 2:
            assert same_group(actual, row, groups, row)
            continue
        crowded = select_groups(groups, np.array([row]))
        expected = decode(crowded.features, child_members(crowded), replace(ALL, k=2))
        columns, children = group(actual, row)
        assert scenes.identical(children, expected)
        own, _ = group(groups, row)
        assert all(np.array_equal(columns[name], own[name]) for name in columns)


def test_solved_colours_move_groups_and_children_alike(groups: GroupSet) -> None:
    """Real photos differ from what exports say, whatever the number of Gaussians."""
    actual = with_fitted_colors(groups)
    np.testing.assert_array_equal(actual.features.sh0, groups.colors.sh0)
    offsets, sizes = groups.colors.sh0 - groups.features.sh0, np.diff(groups.features.starts)
    expected = groups.children.sh0 + offsets.repeat(sizes, 0)
    np.testing.assert_allclose(actual.children.sh0, expected, atol=1e-6)
    same = replace(actual, features=groups.features, children=replace(actual.children, sh0=groups.children.sh0))
    same_groups(same, groups)


def test_part_members_know_the_footprint_of_their_group(groups: GroupSet) -> None:
    members, starts = child_members(groups), groups.features.starts
    for row in (0, 4):
        own = members.footprints[int(starts[row]) : int(starts[row + 1])]
        assert (own == own[0]).all()
        assert 0 < own[0] < 0.01 * float(groups.features.footprints[row])  # theirs is no floor any more
    assert members.pixels is None
    assert members.means.shape == gaussian_members(groups.children, members.footprints).means.shape


# of one batch


@pytest.fixture(scope="module")
def pixels() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24), degree=1)


@pytest.mark.parametrize(("networks", "most"), [(False, 2), (True, 4)])
def test_others_join_the_same_groups(networks: bool, most: int, pixels: Scene, tmp_path: Path) -> None:
    """Decoded as they are then, and in the same colours while no photo said anything."""
    options = replace(SMALL, encoder=False)
    checkpoint = str(written(tmp_path / "a.safetensors", noisy(options))) if networks else "none"
    settings = {"max_k": most, "checkpoint": checkpoint, "fit_colors": False}
    state = one_batch(pixels, superpixels="5%", budget=None if networks else "10%", **settings)
    assert (state.groups.heads is not None) == networks
    assert state.networks is None
    shared = share(state)
    assert isinstance(shared.groups, GroupSet)
    assert (len(shared), shared.sh_degree) == (len(state), 1)
    assert shared.settings.target_count is None
    assert divide_groups(shared).heads is None
    for k in {1, most}:
        assert_same_children(decoded(shared, k=k), decoded(state, k=k))


def test_colours_of_one_batch_are_fitted_for_later_ones(pixels: Scene) -> None:
    """Alone it shows those of its file; where others join, all show fitted ones unless a fit begins with them."""
    state = one_batch(pixels, superpixels="5%", checkpoint="none")
    assert state.groups.colors is not None
    assert state.groups.colors.precision.any()
    plain = replace(state, groups=replace(state.groups, colors=None))
    assert scenes.identical(decoded(state, k=2), decoded(plain, k=2))
    shared = share(state)
    np.testing.assert_array_equal(shared.groups.colors.sh0, state.groups.colors.sh0)
    as_came, fitted = divide_groups(shared, fitted_colors=False), divide_groups(shared)
    np.testing.assert_array_equal(as_came.features.sh0, shared.groups.features.sh0)
    np.testing.assert_array_equal(fitted.features.sh0, shared.groups.colors.sh0)
    assert scenes.psnr_of(decoded(shared, k=1), pixels) > scenes.psnr_of(decoded(state, k=1), pixels)
