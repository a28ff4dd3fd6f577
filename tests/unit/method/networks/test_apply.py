"""Networks change every stage, and silent ones change nothing."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from network_fixtures import SMALL, Made, made, noisy, untrained

from gsmerge.arrays import as_array
from gsmerge.method.geometry.pooling import feature_to_gaussians
from gsmerge.method.geometry.transforms import covariances
from gsmerge.method.networks.apply import NetworkContext, decode_gaussians, encode_features, find_neighbors, run_heads
from gsmerge.method.networks.corrector import ANALYTIC
from gsmerge.method.networks.options import GROUP_COLUMNS, PAPER_NUMBERS, NetworkOptions
from gsmerge.method.networks.weights import NetworkWeights
from gsmerge.method.stages.decode import decode, divide_groups
from gsmerge.method.stages.match import match
from gsmerge.method.stages.merge import merge, take_features
from gsmerge.settings.stages import DecodeOptions, MatchOptions
from gsmerge.types import FeatureGaussians, Gaussians, Matches

PAPER = replace(SMALL, outputs="absolute", merger_start="first", geometry="carried", group_numbers=False)


@pytest.fixture(scope="module")
def scene() -> Made:
    return made()


def assert_close(a: FeatureGaussians | Gaussians, b: FeatureGaussians | Gaussians, atol: float = 0.0) -> None:
    assert type(a) is type(b)
    for f in fields(a):
        one, other = as_array(getattr(a, f.name)), as_array(getattr(b, f.name))
        assert (one.dtype, one.shape) == (other.dtype, other.shape), f.name
        tolerance = atol if one.dtype.kind == "f" else 0.0
        np.testing.assert_allclose(one, other, atol=tolerance, rtol=tolerance, err_msg=f.name)


def pairs(features: FeatureGaussians) -> Matches:
    """Match every Feature Gaussian of the first view with the same one of the second, but for the first."""
    half = len(features) // 2
    clusters = np.tile(np.arange(half), 2)
    clusters[half] = half
    return Matches(clusters, half + 1)


def encode_noisily(scene: Made) -> tuple[NetworkContext, FeatureGaussians]:
    """Return networks with weights at random, and the features that they encode."""
    context = scene.networks(noisy())
    return context, encode_features(scene.features, context)


def test_untrained_networks_change_no_bit(scene: Made) -> None:
    context = scene.networks(untrained(SMALL))
    encoded = encode_features(scene.features, context)
    assert encoded.latents.shape == (len(scene.features), SMALL.latent)
    bare = replace(encoded, latents=np.zeros((len(encoded), 0), np.float32))
    assert_close(bare, scene.features)
    assert_close(context.encode(scene.features), encoded)
    merged = merge(encoded, pairs(encoded), context)
    assert_close(merged, merge(encoded, pairs(encoded)))
    assert_close(context.refine(merged), merged)
    for k in (1, 2, 3, 4, 6):
        options = DecodeOptions(k=k)
        assert_close(decode(merged, scene.members, options, networks=context), decode(merged, scene.members, options))


def test_trained_networks_change_every_stage(scene: Made) -> None:
    context, encoded = encode_noisily(scene)
    assert not np.array_equal(encoded.means, scene.features.means)
    assert np.array_equal(encoded.covars, scene.features.covars)  # paper: the encoder leaves the geometry to the head
    merged, plain = merge(encoded, pairs(encoded), context), merge(encoded, pairs(encoded))
    assert np.array_equal(merged.means[:2], plain.means[:2])  # alone
    refined, children = context.refine(merged), decode(merged, scene.members, DecodeOptions(k=2))
    decoded = decode(merged, scene.members, DecodeOptions(k=2, min_opacity=0), networks=context)
    for after, before in ((merged, plain), (refined, merged)):
        for name in ("means", "covars", "extinctions", "sh0"):
            assert not np.array_equal(getattr(after, name), getattr(before, name)), name
    assert len(decoded) >= len(children)
    assert not np.array_equal(refined.latents, merged.latents)


def test_nothing_is_corrected_without_networks_or_features(scene: Made) -> None:
    assert ANALYTIC.refine(scene.features) is scene.features
    context = scene.networks(noisy())
    none = take_features(encode_features(scene.features, context), np.zeros(0, np.int64))
    assert len(context.refine(none)) == 0
    assert len(encode_features(none, context)) == 0
    assert len(decode(none, scene.members, DecodeOptions(), networks=context)) == 0


def test_encoding_does_not_depend_on_the_order_of_members(scene: Made) -> None:
    starts, members = scene.features.starts, scene.features.members.copy()
    rng = np.random.default_rng(0)
    for first, last in pairwise(starts):
        members[first:last] = rng.permutation(members[first:last])
    shuffled = replace(scene.features, members=members)
    context = scene.networks(noisy())
    a, b = encode_features(scene.features, context), encode_features(shuffled, context)
    assert np.array_equal(a.latents, b.latents)
    assert np.array_equal(a.means, b.means)


def test_each_group_is_encoded_as_if_alone(scene: Made) -> None:
    """Padding and bins: every group alone gives what all together give."""
    context = scene.networks(noisy())
    together = encode_features(scene.features, context)
    for row in range(0, len(scene.features), 3):
        alone = encode_features(take_features(scene.features, np.array([row])), context)
        assert_close(alone, take_features(together, np.array([row])), 2e-6)


def test_merged_cluster_does_not_depend_on_the_order_of_members(scene: Made) -> None:
    context, encoded = encode_noisily(scene)
    matches = pairs(encoded)
    back = np.arange(len(encoded))[::-1].copy()
    a = merge(encoded, matches, context)
    b = merge(take_features(encoded, back), Matches(matches.clusters[back], matches.count), context)
    np.testing.assert_allclose(np.sort(a.means, 0), np.sort(b.means, 0), atol=1e-5, rtol=1e-5)
    np.testing.assert_allclose(np.sort(a.latents, 0), np.sort(b.latents, 0), atol=1e-5, rtol=1e-5)


def test_three_children_take_slots_of_the_head_for_four(scene: Made) -> None:
    """Slots that are empty do not count, whoever shares the table."""
    context, encoded = encode_noisily(scene)
    counts = np.where(np.arange(len(encoded)) % 2 == 0, 3, 4)
    options = DecodeOptions(min_opacity=0)
    mixed_counts = decode(encoded, scene.members, options, counts, networks=context)
    plain = decode(encoded, scene.members, options, counts)
    assert len(mixed_counts) == len(plain)
    row = next(i for i in range(0, len(encoded), 2) if encoded.starts[i + 1] - encoded.starts[i] >= 13)
    one = take_features(encoded, np.array([row]))
    alone = decode(one, scene.members, options, np.array([3]), networks=context)
    before = len(decode(take_features(encoded, np.arange(row)), scene.members, options, counts[:row]))
    assert_close(alone, mixed_counts[before : before + 3], 2e-6)


def test_many_children_are_corrected_in_halves(scene: Made) -> None:
    """Six like three and three of groups of their own."""
    context, encoded = encode_noisily(scene)
    large = np.flatnonzero(np.diff(encoded.starts) >= 30)
    few = take_features(encoded, large)
    children, parents = divide_groups(few, scene.members, np.full(len(few), 6))
    assert np.bincount(parents).tolist() == [6] * len(few)
    together = context.decode(children, parents, few)
    for half in (np.arange(len(parents)) % 6 < 3, np.arange(len(parents)) % 6 >= 3):
        assert_close(together[half], context.decode(children[half], parents[half], few))
    assert not np.array_equal(together.means, children.means)


def test_refiner_reads_near_neighbours_alone(scene: Made) -> None:
    context, encoded = encode_noisily(scene)
    near = find_neighbors(encoded.means, 4)
    far = int(np.setdiff1d(np.arange(len(encoded)), np.append(near[0], 0))[-1])
    for row, same in ((int(near[0, 0]), False), (far, True)):
        latents = encoded.latents.copy()
        latents[row] += 1
        refined = context.refine(replace(encoded, latents=latents))
        assert np.array_equal(refined.means[0], context.refine(encoded).means[0]) is same


def test_nearest_neighbours_on_a_line_are_those_found_by_hand(scene: Made) -> None:
    features = take_features(scene.features, np.arange(6))
    line = np.array([0, 1, 3, 7, 7.5, 9], np.float32)
    features = replace(features, means=np.stack([line, line * 0, line * 0], 1))
    assert find_neighbors(features.means, 2).tolist() == [[1, 2], [0, 2], [1, 0], [4, 5], [3, 5], [4, 3]]
    piled = find_neighbors(np.zeros((6, 3), np.float32), 3)
    assert (piled != np.arange(6)[:, None]).all()
    assert find_neighbors(features.means[:1], 2).tolist() == [[-1, -1]]


def test_the_seed_chooses_the_sample_of_large_groups(scene: Made) -> None:
    networks = noisy()
    a, b = (encode_features(scene.features, scene.networks(networks, seed)).latents for seed in (0, 1))
    assert np.array_equal(a, encode_features(scene.features, scene.networks(networks, 0)).latents)
    sizes = np.diff(scene.features.starts)
    large = sizes > SMALL.members
    twice = sizes > 2 * SMALL.members  # a group of nine has but one place with a choice
    assert (a[twice] != b[twice]).any(1).all()
    assert np.array_equal(a[~large], b[~large])


def test_mass_of_a_sampled_group_counts_every_member(scene: Made) -> None:
    """Group mass is that of all members (paper supplement), so it does not change with the limit."""
    few, many = scene.networks(noisy()), scene.networks(noisy(replace(SMALL, members=64)))
    assert np.array_equal(few.describe(scene.features).group, many.describe(scene.features).group)


@pytest.mark.parametrize("factor", [2.0**-10, 2.0**10])
def test_encoding_does_not_depend_on_the_scale_of_the_world(scene: Made, factor: float) -> None:
    context, f = (
        scene.networks(noisy(replace(SMALL, members=64))),
        scene.features,
    )  # a sample depends on the bits of means
    cameras = scene.scene.cameras
    viewmats = cameras.viewmats.copy()
    viewmats[:, :3, 3] *= factor
    m = scene.members
    members = replace(m, means=m.means * factor, scales=m.scales * factor, footprints=m.footprints * factor)
    members = replace(members, **{n: getattr(members, n).astype(np.float32) for n in ("means", "scales", "footprints")})
    larger = replace(
        f, means=f.means * factor, covars=f.covars * factor**2, masses=f.masses * factor**3,
        extinctions=f.extinctions * factor**2, footprints=f.footprints * factor,
    )  # fmt: skip
    other = NetworkContext(context.networks, members, replace(cameras, viewmats=viewmats))
    a, b = encode_features(f, context), encode_features(larger, other)
    np.testing.assert_allclose(a.means * factor, b.means, rtol=1e-5, atol=1e-5 * factor)


def test_gradients_reach_every_parameter(scene: Made) -> None:
    torch = pytest.importorskip("torch")
    from training_runs import modules_of

    networks = modules_of(noisy())
    context = NetworkContext(networks, scene.members, scene.scene.cameras)
    features = encode_features(scene.features, context)
    group_features = context.describe(features)
    total = features.latents.square().sum()
    for k in (1, 2, 4):
        sizes = np.full(len(features), k)
        parents = np.repeat(np.arange(len(features)), sizes)
        base = feature_to_gaussians(scene.features)[parents]
        total = total + run_heads(base, parents, group_features, context).square().sum()
    merged = merge(features, pairs(features), context)
    total = total + context.refine(merged).latents.square().sum()
    total.backward()
    for name, parameter in networks.named_parameters():
        if name.startswith("encoder.shift"):  # of means, which are arrays here
            continue
        assert parameter.grad is not None, name
        assert bool(torch.isfinite(parameter.grad).all()), name
        unused = name.startswith("heads.1.block.attention.query")  # one slot attends to itself, whatever it asks
        assert unused or bool(parameter.grad.any()), name


def test_sizes_of_networks_out_of_range_are_refused() -> None:
    for wrong in ({"width": 50}, {"heads": 0}, {"members": 10**9}, {"latent": 1.5}, {"blocks": True}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            NetworkOptions(**wrong)
    assert 150_000 <= untrained().num_parameters <= 300_000


def test_absolute_heads_make_k_children_of_every_group(scene: Made) -> None:
    """Exactly K of every group, whatever its members; untrained, round Gaussians in the group's place."""
    plain, start = DecodeOptions(k=2, min_opacity=0.0), scene.networks(untrained(PAPER))
    encoded = encode_features(scene.features, start)
    assert (np.diff(encoded.starts) == 1).any()  # groups of one member, which halving leaves whole
    parents = np.repeat(np.arange(len(encoded)), 2)
    actual = decode(encoded, scene.members, plain, networks=start)
    np.testing.assert_allclose(actual.means, feature_to_gaussians(encoded).means[parents], rtol=1.3e-6, atol=1e-5)
    assert (actual.scales == actual.scales[:, :1]).all()
    assert (actual.opacities == 0.5).all()
    np.testing.assert_allclose(actual.sh0, encoded.sh0[parents], rtol=1.3e-6, atol=1e-5)
    moved = decode(encoded, scene.members, plain, networks=scene.networks(noisy(PAPER)))
    assert not np.array_equal(moved.means[::2], moved.means[1::2])  # slots tell siblings apart
    assert float(moved.scales.max() / actual.scales.max()) < np.exp(6.1)


def test_geometry_of_the_first_head_is_carried_on(scene: Made) -> None:
    """Scales and rotations are those of the K = 1 head from the encoder on; the means stay the encoder's."""
    context, moments = (scene.networks(noisy(replace(PAPER, geometry=name))) for name in ("carried", "analytic"))
    encoded, carried = moments.encode(scene.features), context.encode(scene.features)
    ones = decode(encoded, scene.members, DecodeOptions(min_opacity=0.0), networks=context)
    np.testing.assert_allclose(carried.covars, covariances(ones.quats, ones.scales), rtol=1e-4, atol=1e-9)
    assert not np.allclose(carried.covars, encoded.covars, rtol=0.1)
    assert_close(replace(carried, covars=encoded.covars), encoded)
    for stage in (lambda f, c: merge(f, pairs(f), c), lambda f, c: c.refine(f)):
        assert not np.array_equal(stage(carried, context).latents, stage(encoded, context).latents)
    assert not np.allclose(
        context.describe(carried).sizes, context.describe(encoded).sizes, rtol=1e-3
    )  # what heads read


def test_heads_of_the_paper_read_latent_mass_and_base_colour_alone(scene: Made) -> None:
    context = scene.networks(noisy(PAPER))
    features = context.encode(scene.features)
    described = context.describe(features)
    parents, changed = np.arange(len(features)), described.group.copy()
    changed[:, [i for i in range(GROUP_COLUMNS) if i not in PAPER_NUMBERS]] += 1
    before, after = (
        decode_gaussians(described.base, parents, replace(described, group=group), context)
        for group in (described.group, changed)
    )
    assert_close(before, after)
    for column in PAPER_NUMBERS:
        changed = described.group.copy()
        changed[:, column] += 1
        other = decode_gaussians(described.base, parents, replace(described, group=changed), context)
        assert not np.array_equal(other.scales, before.scales)


@pytest.mark.parametrize("name", ["encoder", "merger", "refiner"])
def test_network_that_is_left_out_has_no_weights_and_no_effect(scene: Made, name: str) -> None:
    """As the whole with this network silent: its stage is the analytic one."""
    whole, options = noisy(), replace(SMALL, **{name: False})
    left = {key: array for key, array in whole.arrays.items() if not key.startswith(name)}
    assert left.keys() == noisy(options).arrays.keys() < whole.arrays.keys()
    last = tuple(f"{name}.{layer}." for layer in ("latent", "shift", "out"))
    silent = {key: array * (not key.startswith(last)) for key, array in whole.arrays.items()}
    whole, without = replace(whole, arrays=silent), NetworkWeights(options, left)
    results = []
    for networks in (whole, without):
        context = scene.networks(networks)
        encoded = encode_features(scene.features, context)
        refined = context.refine(merge(encoded, pairs(encoded), context))
        results.append((refined, decode(refined, scene.members, DecodeOptions(k=2), networks=context)))
    assert_close(results[0][0], results[1][0])
    assert_close(results[0][1], results[1][1])


def test_without_an_encoder_colours_are_compared(scene: Made) -> None:
    """Latents that are all zero say nothing, so they keep nothing apart."""
    features, options = scene.features, MatchOptions(match="aabb", iou=0.05)
    encoded = encode_features(features, scene.networks(noisy(replace(SMALL, encoder=False))))
    assert np.array_equal(match(encoded, options).clusters, match(features, options).clusters)
    assert match(encoded, options).count < len(features)
