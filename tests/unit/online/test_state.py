"""The groups of a state: what they decode to, and how they are picked, joined, replaced and thinned out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
import torch
from arriving import group, random_gaussians, same_group, same_parts
from loose import far_behind, shuffled, voxels
from networks import SMALL, Made, made, noisy, written

from gsmerge import Gaussians, PixelScene, decode_scene, encode_scene
from gsmerge.geometry import covariances
from gsmerge.moments import feature_to_gaussians, gaussian_members
from gsmerge.networks import encode_features
from gsmerge.online.state import (
    Parts,
    as_encoded,
    baked,
    from_encoded,
    joined,
    moments_of,
    owning,
    part_members,
    pick,
    swapped,
    thinned,
    with_solved,
)
from gsmerge.stages.decode import DecodeOptions, decode
from gsmerge.types import SH_C0, FeatureGaussians

ALL = DecodeOptions(min_opacity=0.0)


@pytest.fixture(scope="module")
def some() -> Made:
    return made()


@pytest.fixture(scope="module")
def uneven(some: Made) -> FeatureGaussians:
    """Groups with gains and spreads of their own, as the photos leave them."""
    rng = np.random.default_rng(0)
    gains, spreads = rng.uniform(0.3, 3.0, (2, len(some.features)))
    return replace(some.features, gains=torch.from_numpy(gains).float(), spreads=torch.from_numpy(spreads).float())


@pytest.fixture(scope="module")
def parts(some: Made, uneven: FeatureGaussians) -> Parts:
    found = baked(uneven, some.members, None, 4)
    rng = torch.Generator().manual_seed(1)
    solved = found.solved + 0.1 * torch.randn(found.solved.shape, generator=rng)
    return replace(found, solved=solved, held=torch.rand(len(found), generator=rng))


def assert_close(one: Gaussians, other: Gaussians, rtol: float = 1e-4) -> None:
    """Row by row, whatever the order and signs of the axes."""
    assert len(one) == len(other)
    a, b = (covariances(g.quats.double(), g.scales.double()) for g in (one, other))
    size = b.diagonal(dim1=1, dim2=2).sum(1)
    assert float(((a - b).abs().amax((1, 2)) / size).max()) <= rtol
    largest = size.sqrt()
    assert float(((one.means - other.means).double().norm(dim=1) / largest).max()) <= rtol
    for name in ("opacities", "sh0", "shN"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=rtol)


def assert_same_children(one: Gaussians, other: Gaussians) -> None:
    """In any order; pooling takes nothing for more solid than 0.995."""
    scenes.assert_same_set(one, other, atol=5e-3, unit=0.05)


def ones_and_most(parts: Parts, most: int) -> tuple[Gaussians, Gaussians]:
    """What the state's own decoding makes of the groups at K = 1 and at most."""
    members = part_members(parts)
    return feature_to_gaussians(parts.features), decode(parts.features, members, replace(ALL, k=most))


@pytest.mark.parametrize("most", [1, 2, 4, 8])
def test_baked_is_what_the_stages_decode(most: int, some: Made, uneven: FeatureGaussians) -> None:
    found = baked(uneven, some.members, None, most)
    ones, children = ones_and_most(found, most)
    assert_close(ones, feature_to_gaussians(uneven))
    wanted = decode(uneven, some.members, replace(ALL, k=most)) if most > 1 else feature_to_gaussians(uneven)
    assert scenes.identical(found.children, wanted)
    assert_same_children(children, wanted)
    assert int(found.features.starts.diff().max()) <= most


def test_heads_are_in_what_is_baked(some: Made) -> None:
    networks = some.networks(noisy())
    features = encode_features(some.features, networks)
    assert features.latents.shape[1] == SMALL.latent
    found = baked(features, some.members, networks, 4)
    assert found.features.latents.shape == (len(features), 0)
    ones, children = ones_and_most(found, 4)
    # lengths are floored beside the largest, so that the thinnest may be told anew
    assert_close(ones, decode(features, some.members, ALL, networks=networks), rtol=1e-3)
    wanted = decode(features, some.members, replace(ALL, k=4), networks=networks)
    assert_same_children(children, wanted)
    plain = baked(features, some.members, None, 4)
    assert not torch.equal(plain.children.sh0, found.children.sh0)


def test_baked_groups_are_plain(parts: Parts, uneven: FeatureGaussians) -> None:
    f = parts.features
    assert bool((f.gains == 1).all())
    assert bool((f.spreads == 1).all())
    assert torch.equal(f.members, torch.arange(len(parts.children)))
    for name in ("weights", "masses", "footprints", "views", "backing"):
        assert torch.equal(getattr(f, name), getattr(uneven, name)), name


def test_nothing_is_held_to_begin_with(some: Made, uneven: FeatureGaussians) -> None:
    found = baked(uneven, some.members, None, 2)
    assert not found.held.any()
    assert torch.equal(found.solved, found.features.sh0)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_moments_are_what_is_decoded_from_them(degree: int) -> None:
    gaussians = random_gaussians(60, 3, degree=degree)
    features = scenes.make_features(gaussians.means, degree=degree)
    assert_close(feature_to_gaussians(replace(features, **moments_of(gaussians))), gaussians)


def test_moments_of_the_faintest_and_the_most_solid() -> None:
    gaussians = replace(random_gaussians(4, 5), opacities=torch.tensor([0.0, 1e-6, 0.999, 1.0]))
    features = replace(scenes.make_features(gaussians.means), **moments_of(gaussians))
    found = feature_to_gaussians(features).opacities
    np.testing.assert_allclose(found, [0, 1e-6, 0.999, 0.999], atol=1e-6)


def test_moments_of_none() -> None:
    gaussians = random_gaussians(0, 0)
    assert {name: len(tensor) for name, tensor in moments_of(gaussians).items()} == dict.fromkeys(
        ("means", "covars", "extinctions", "sh0", "shN"), 0
    )


def test_pick_takes_groups_with_their_children(parts: Parts) -> None:
    rows = torch.tensor([5, 0, 17, 5])
    found = pick(parts, rows)
    assert len(found) == 4
    for place, row in enumerate(rows.tolist()):
        assert same_group(found, place, parts, row)
    assert torch.equal(found.features.members, torch.arange(len(found.children)))


def test_pick_of_all_and_of_none(parts: Parts) -> None:
    same_parts(pick(parts, torch.arange(len(parts))), parts)
    none = pick(parts, torch.zeros(0, dtype=torch.int64))
    assert (len(none), len(none.children)) == (0, 0)


def test_joined_keeps_all_in_order(parts: Parts) -> None:
    rows = torch.arange(len(parts))
    halves = [pick(parts, rows[:7]), pick(parts, rows[7:7]), pick(parts, rows[7:])]
    same_parts(joined(halves), parts)


def test_swapped_groups_take_the_places_of_others(parts: Parts) -> None:
    rows = torch.tensor([8, 2])
    others = pick(parts, torch.tensor([20, 21]))
    found = swapped(parts, rows, others)
    assert len(found) == len(parts)
    for row in range(len(parts)):
        wanted = {8: 20, 2: 21}.get(row, row)
        assert same_group(found, row, parts, wanted)


def test_thinned_pools_the_children_of_crowded_groups(parts: Parts) -> None:
    found = thinned(parts, 2)
    sizes, before = found.features.starts.diff(), parts.features.starts.diff()
    assert int(sizes.max()) == 2
    assert int(before.max()) > 2
    for row in range(len(parts)):
        if before[row] <= 2:
            assert same_group(found, row, parts, row)
            continue
        crowded = pick(parts, torch.tensor([row]))
        wanted = decode(crowded.features, part_members(crowded), replace(ALL, k=2))
        columns, children = group(found, row)
        assert scenes.identical(children, wanted)
        own, _ = group(parts, row)
        assert all(torch.equal(columns[name], own[name]) for name in columns)


def test_nothing_is_thinned_where_none_is_crowded(parts: Parts) -> None:
    assert thinned(parts, 4) is parts


def test_children_of_one_member_each_are_left_as_they_are(parts: Parts) -> None:
    """Members of their own: asked for as many as there are, each is what it was."""
    found = decode(parts.features, part_members(parts), replace(ALL, k=4))
    assert_same_children(found, parts.children)


def test_solved_colours_move_groups_and_children_alike(parts: Parts) -> None:
    """Real photos differ from what exports say, whatever the number of Gaussians."""
    found = with_solved(parts)
    assert torch.equal(found.features.sh0, parts.solved)
    offsets, sizes = parts.solved - parts.features.sh0, parts.features.starts.diff()
    wanted = parts.children.sh0 + offsets.repeat_interleave(sizes, 0)
    np.testing.assert_allclose(found.children.sh0, wanted, atol=1e-6)
    same = replace(found, features=parts.features, children=replace(found.children, sh0=parts.children.sh0))
    same_parts(same, parts)


def test_owning_counts_children_of_groups_without_any(some: Made) -> None:
    few = owning(pick_features(some.features, 3), np.array([0, 0, 2]))
    assert few.starts.tolist() == [0, 2, 2, 3]
    assert few.members.tolist() == [0, 1, 2]


def pick_features(features: FeatureGaussians, count: int) -> FeatureGaussians:
    """The first few."""
    return scenes.make_features(features.means[:count])


def test_part_members_know_the_footprint_of_their_group(parts: Parts) -> None:
    members, starts = part_members(parts), parts.features.starts
    for row in (0, 4):
        own = members.footprints[int(starts[row]) : int(starts[row + 1])]
        assert (own == own[0]).all()
        assert 0 < own[0] < 0.01 * float(parts.features.footprints[row])  # theirs is no floor any more
    assert members.pixels is None
    assert members.means.shape == gaussian_members(parts.children, members.footprints).means.shape


# of an encoded scene


@pytest.fixture(scope="module")
def pixels() -> PixelScene:
    return scenes.make_scene(scenes.room(), scenes.arc(3), degree=1)


@pytest.mark.parametrize("most", [1, 2, 4])
@pytest.mark.parametrize("networks", [False, True])
def test_an_encoded_scene_is_a_state(networks: bool, most: int, pixels: PixelScene, tmp_path: Path) -> None:
    checkpoint = str(written(tmp_path / "a.safetensors", noisy())) if networks else "none"
    encoded = encode_scene(pixels, density=0.05, max_k=most, checkpoint=checkpoint)
    assert (encoded.heads is not None) == networks
    state = from_encoded(encoded)
    assert (len(state), len(state.replay), state.sh_degree) == (len(encoded), 0, 1)
    again = as_encoded(state)
    assert again.heads is None
    for k in {1, most}:
        assert_same_children(decode_scene(again, k=k), decode_scene(encoded, k=k))


@pytest.mark.parametrize("settings", [{"budget": "10%"}, {"k": "auto"}, {"k": 2, "rule": "paper"}], ids=str)
def test_settings_of_an_encoded_scene(settings: dict[str, object], pixels: PixelScene) -> None:
    encoded = encode_scene(pixels, density=0.05, checkpoint="none", robust=False, **settings)
    state = from_encoded(encoded)
    assert state.settings.wanted is None
    assert state.settings.most == encoded.settings.most
    found = as_encoded(state)
    assert len(decode_scene(found, k=1)) <= len(encoded)
    for k in (1, encoded.settings.most):
        assert_same_children(decode_scene(found, k=k), decode_scene(encoded, k=k))


def test_division_between_one_and_most_is_about_as_good(pixels: PixelScene) -> None:
    """Children are divided again, of what they are and not of the pixels: close, not equal."""
    for rule in ("depth", "paper"):
        encoded = encode_scene(pixels, density=0.05, checkpoint="none", robust=False, rule=rule)
        again = as_encoded(from_encoded(encoded))
        for k in (2, 3):
            before, after = (scenes.psnr_of(decode_scene(one, k=k), pixels) for one in (encoded, again))
            assert after > before - 0.3, (rule, k)


def test_scenes_in_no_order_and_what_no_view_sees(pixels: PixelScene) -> None:
    loose = voxels(pixels, 0.05)
    state = from_encoded(encode_scene(loose, density=0.1))
    assert state.settings.places is None
    assert len(decode_scene(as_encoded(state), k=2)) > len(state)
    loose = shuffled(pixels)
    hidden = far_behind(loose.gaussians, 200)
    both = replace(loose, gaussians=Gaussians.concat([loose.gaussians, hidden]))
    encoded = encode_scene(both, density=0.1, unseen="keep")
    state = from_encoded(encoded)
    assert state.kept is not None
    assert scenes.identical(state.kept, encoded.kept)  # type: ignore[arg-type]
    assert as_encoded(state).num_kept == encoded.num_kept > 0


def test_what_is_told_of_an_encoded_scene(pixels: PixelScene) -> None:
    encoded = encode_scene(pixels, density=0.05, checkpoint="none")
    about = from_encoded(encoded).about
    assert about["options"]["density"] == 0.05
    assert "fit" not in about["options"]
    assert [one["num_groups"] for one in about["batches"]] == [len(encoded)]
    assert about["batches"][0]["num_views"] == 3
    assert about["batches"][0]["num_input"] == pixels.num_gaussians


def test_unsolved_colours_are_there_too(parts: Parts, pixels: PixelScene) -> None:
    state = from_encoded(encode_scene(pixels, density=0.05, checkpoint="none", robust=False))
    state = replace(state, parts=replace(state.parts, solved=state.parts.solved + 0.2 / SH_C0))
    as_came, fitted = as_encoded(state, solved=False), as_encoded(state)
    assert torch.equal(as_came.features.sh0, state.parts.features.sh0)
    assert torch.equal(fitted.features.sh0, state.parts.solved)
    moved = fitted.division.children.sh0 - as_came.division.children.sh0
    np.testing.assert_allclose(moved, 0.2 / SH_C0, atol=1e-5)
