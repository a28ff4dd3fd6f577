"""Encoding and decoding is compacting without a fit, to the last bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import motions
import pytest
import scenes
from messages import names, refuses
from network_fixtures import noisy, written
from unaligned_scenes import far_behind, shuffled, voxels

import gsmerge
from gsmerge import Encoded, Gaussians, Scene, compact, decode_scene, encode_scene
from gsmerge.encoded.to_gaussians import plan_decode
from gsmerge.errors import UsageError

SHARE = "10%"


@pytest.fixture(scope="module")
def pixels() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(4))


@pytest.fixture(scope="module")
def bare(pixels: Scene) -> Scene:
    return replace(pixels, images=None)


@pytest.fixture(scope="module")
def encoded(pixels: Scene) -> Encoded:
    return encode_scene(pixels, superpixels=SHARE)


@pytest.fixture(scope="module")
def encoded_bare(bare: Scene) -> Encoded:
    return encode_scene(bare, superpixels=SHARE)


def unfitted(scene: Scene, **settings: Any) -> Gaussians:
    return compact(scene, **{"superpixels": SHARE, "fit": "none", **settings}).gaussians


def test_views_that_disagree_stay_where_batches_will_be() -> None:
    wrong = motions.disagreeing(scenes.make_scene(scenes.room(), scenes.arc(5, 160, 120)))
    found = decode_scene(encode_scene(wrong, superpixels="2%"))
    assert scenes.identical(found, unfitted(wrong, superpixels="2%", poses="fixed"))
    assert not scenes.identical(found, unfitted(wrong, superpixels="2%"))


def assert_equal_to_compact(scene: Scene, **settings: Any) -> Gaussians:
    """What is decoded as it was encoded."""
    actual = decode_scene(encode_scene(scene, **{"superpixels": SHARE, **settings}))
    assert scenes.identical(actual, unfitted(scene, **settings))
    assert len(actual) > 10
    return actual


@pytest.mark.parametrize("k", [1, 2, 3, 4])
def test_one_encoding_gives_every_k(k: int, pixels: Scene, encoded: Encoded) -> None:
    assert scenes.identical(decode_scene(encoded, k=k), unfitted(pixels, k=k))


def test_tensors_too(pixels: Scene, encoded: Encoded, torch: Any) -> None:
    given = replace(pixels, gaussians=pixels.gaussians.to("cpu"), cameras=pixels.cameras.to("cpu"))
    actual = encode_scene(given, superpixels=SHARE)
    assert scenes.identical(decode_scene(actual), decode_scene(encoded))


@pytest.mark.parametrize("k", [1, 2, 4])
def test_one_encoding_gives_every_k_without_photos(k: int, bare: Scene, encoded_bare: Encoded) -> None:
    assert scenes.identical(decode_scene(encoded_bare, k=k), unfitted(bare, k=k))


def test_pruning_by_what_the_views_see_is_done_without_photos(pixels: Scene) -> None:
    encoded = encode_scene(pixels, superpixels=SHARE, min_contribution=0.2)
    actual = decode_scene(encoded, k=4)
    everything = replace(encoded, settings=replace(encoded.settings, min_contribution=0.0))
    assert len(actual) < len(decode_scene(everything, k=4))


@pytest.mark.parametrize(
    "settings",
    [
        {"budget": "5%"},
        {"budget": 300, "k": 2},
        {"budget": "20KB"},
        {"k": 5},
        {"k": 8},
        {"budget": 500, "k": 7},
        {"budget": "auto"},
        {"effort": "draft", "k": 2},
        {"match": "aabb", "k": 2},
        {"min_opacity": 0.3, "k": 2},
        {"min_contribution": 0.2},
    ],
    ids=str,
)
def test_the_same_settings_give_the_same_gaussians(settings: dict[str, Any], pixels: Scene) -> None:
    assert_equal_to_compact(pixels, **settings)


@pytest.mark.parametrize("settings", [{"budget": "6%"}, {"budget": "auto"}, {"budget": "quest3", "k": 2}], ids=str)
def test_the_same_without_photos(settings: dict[str, Any], bare: Scene) -> None:
    assert_equal_to_compact(bare, **settings)


@pytest.mark.parametrize("settings", [{"k": 1}, {"k": 2}, {"k": 4}, {"budget": "7%"}], ids=str)
def test_networks_are_kept_with_the_scene(settings: dict[str, Any], pixels: Scene, tmp_path: Path) -> None:
    checkpoint = written(tmp_path / "networks.safetensors", noisy())
    actual = assert_equal_to_compact(pixels, checkpoint=str(checkpoint), **settings)
    assert not scenes.identical(actual, unfitted(pixels, **settings))
    kept = encode_scene(pixels, superpixels=SHARE, checkpoint=str(checkpoint), **settings)
    checkpoint.unlink()
    gsmerge.save_encoded(tmp_path / "scene.gsm", kept)
    assert scenes.identical(decode_scene(gsmerge.load_encoded(tmp_path / "scene.gsm")), actual)


@pytest.mark.parametrize("k", [1, 2, 4])
def test_scenes_in_no_order(k: int, pixels: Scene) -> None:
    unaligned = voxels(pixels, 0.05)
    actual = encode_scene(unaligned, superpixels="20%")
    assert actual.settings.num_slots is not None
    assert actual.settings.max_k == 8
    assert scenes.identical(decode_scene(actual, k=k), unfitted(unaligned, k=k, superpixels="20%"))


def test_shuffled_rows_and_a_budget(pixels: Scene) -> None:
    assert_equal_to_compact(shuffled(pixels), budget="4%")


@pytest.mark.parametrize("settings", [{"k": 1}, {"k": 2}, {"budget": "5%"}], ids=str)
def test_what_no_view_sees_is_kept(settings: dict[str, Any], pixels: Scene) -> None:
    unaligned = shuffled(pixels)
    hidden = far_behind(unaligned.gaussians, 200)
    both = replace(unaligned, gaussians=Gaussians.concat([unaligned.gaussians, hidden]))
    actual = encode_scene(both, superpixels=SHARE, unseen="keep", **settings)
    assert actual.num_kept > 0
    assert scenes.identical(decode_scene(actual), unfitted(both, unseen="keep", **settings))


def test_a_budget_of_the_decoder_is_met_and_dealt_where_it_helps(encoded: Encoded) -> None:
    groups = len(encoded)
    counts = plan_decode(encoded, budget=groups + 50).counts
    assert counts.sum() == groups + 50
    more = plan_decode(encoded, budget=groups + 80).counts
    assert (more >= counts).all()
    share = plan_decode(encoded, budget="10%").counts.sum()
    assert share == encoded.settings.num_input // 10


def test_more_than_there_is_to_divide_is_told(encoded: Encoded) -> None:
    plan = plan_decode(encoded, budget=encoded.settings.num_input)
    assert plan.counts.sum() == encoded.max_gaussians - encoded.num_kept
    assert len(plan.notes) == 1
    assert names(plan.notes[0], encoded.max_gaussians)
    assert len(decode_scene(encoded, budget=encoded.settings.num_input)) <= encoded.max_gaussians


def test_auto_takes_what_compact_would_without_photos(bare: Scene, encoded_bare: Encoded) -> None:
    expected = len(unfitted(bare, budget="auto"))
    assert encoded_bare.settings.knee_count == expected
    plan = plan_decode(encoded_bare, budget="auto")
    assert plan.counts.sum() == max(expected, len(encoded_bare))
    fewer = replace(encoded_bare, settings=replace(encoded_bare.settings, knee_count=len(encoded_bare) - 1))
    plan = plan_decode(fewer, budget="auto")
    assert plan.counts.tolist() == [1] * len(encoded_bare)
    assert names(plan.notes[0], "fewer", "groups")


def test_the_result_does_not_depend_on_the_threads(pixels: Scene, encoded: Encoded) -> None:
    one = decode_scene(encode_scene(pixels, superpixels=SHARE, threads=1), k=2, threads=1)
    assert scenes.identical(one, decode_scene(encoded, k=2, threads=2))


@pytest.mark.parametrize(
    ("name", "value", "found"),
    [("k", 0, "1 to 4"), ("k", "many", "1 to 4"), ("budget", 10, "encode"), ("budget", "0%", "one Gaussian")],
)
def test_wishes_that_cannot_be_met(name: str, value: Any, found: str, encoded: Encoded) -> None:
    with refuses(UsageError, name, found, value):
        decode_scene(encoded, **{name: value})


@pytest.mark.parametrize(
    ("settings", "place", "found"),
    [
        ({"fit": "full"}, "fit full", ["encoded"]), ({"method": "voxel"}, "method voxel", ["encoded"]),
        ({"levels": 2}, "levels", ["encoded"]), ({"quality": "-0.1dB"}, "quality -0.1dB", ["encoded"]),
        ({"quality": "20dB"}, "quality 20dB", ["encoded"]), ({"max_k": 9}, "max_k", ["1 to 8", 9]),
        ({"max_k": 2, "k": 3}, "max_k", [3, 2]),
    ],
)  # fmt: skip
def test_what_cannot_be_encoded(settings: dict[str, Any], place: str, found: list[object], pixels: Scene) -> None:
    with refuses(UsageError, place, *found):
        encode_scene(pixels, **settings)


def test_a_budget_that_keeps_everything_needs_no_encoding(pixels: Scene) -> None:
    with refuses(UsageError, "budget", 6912):
        encode_scene(shuffled(pixels), budget="100%")


def test_fewer_children_take_less_space(pixels: Scene, encoded: Encoded) -> None:
    small = encode_scene(pixels, superpixels=SHARE, max_k=1)
    assert len(small.division.children) == 0
    assert scenes.identical(decode_scene(small), decode_scene(encoded, k=1))
    with refuses(UsageError, "k", "1 to 1", 2):
        decode_scene(small, k=2)
