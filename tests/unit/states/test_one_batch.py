"""A state of one batch is what compacting gives without a fit, to the last bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import motions
import numpy as np
import pytest
import scenes
from messages import names, refuses
from network_fixtures import noisy, written
from unaligned_scenes import far_behind, shuffled, voxels
from view_batches import decoded, one_batch

from gsmerge import Gaussians, Scene, compact
from gsmerge.errors import UsageError
from gsmerge.fit import peak_weights
from gsmerge.raster.photos import blank_photos
from gsmerge.states.decode import DecodeCounts, count_children
from gsmerge.states.groups import children_of
from gsmerge.states.state import DividedGroups, State
from gsmerge.states.state_file import load_state, save_state

SHARE = "10%"


@pytest.fixture(scope="module")
def pixels() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24))


@pytest.fixture(scope="module")
def bare(pixels: Scene) -> Scene:
    return replace(pixels, images=None)


@pytest.fixture(scope="module")
def state(pixels: Scene) -> State:
    return one_batch(pixels, superpixels=SHARE)


@pytest.fixture(scope="module")
def bare_state(bare: Scene) -> State:
    return one_batch(bare, superpixels=SHARE)


def counts_of(state: State, **wish: Any) -> DecodeCounts:
    return count_children(state, groups_of(state), **wish)


def groups_of(state: State) -> DividedGroups:
    assert isinstance(state.groups, DividedGroups)
    return state.groups


def most_of(state: State) -> int:
    """The largest number of Gaussians that a state is decoded to."""
    return len(state) + groups_of(state).division.num_splits + len(state.kept)


def unfitted(scene: Scene, **settings: Any) -> Gaussians:
    return compact(scene, **{"superpixels": SHARE, "fit": "none", **settings}).gaussians


def test_views_that_disagree_stay_where_batches_will_be() -> None:
    wrong = motions.disagreeing(scenes.make_scene(scenes.room(), scenes.arc(4, 64, 48)))
    found = decoded(one_batch(wrong, superpixels="2%"))
    assert scenes.identical(found, unfitted(wrong, superpixels="2%", poses="fixed"))
    assert not scenes.identical(found, unfitted(wrong, superpixels="2%"))


def assert_equal_to_compact(scene: Scene, **settings: Any) -> Gaussians:
    """What is decoded by default."""
    actual = decoded(one_batch(scene, **{"superpixels": SHARE, **settings}))
    assert scenes.identical(actual, unfitted(scene, **settings))
    assert len(actual) > 10
    return actual


@pytest.mark.parametrize("photos", [True, False])
def test_one_state_gives_every_k(photos: bool, pixels: Scene, bare: Scene, state: State, bare_state: State) -> None:
    for k in (1, 3, "mixed"):
        actual = decoded(state if photos else bare_state, k=k)
        assert scenes.identical(actual, unfitted(pixels if photos else bare, k=k)), k


@pytest.mark.parametrize(
    "settings",
    [
        {"k": "mixed", "budget": 300},
        pytest.param({"k": 8}, marks=pytest.mark.slow),
        pytest.param({"budget": "auto"}, marks=pytest.mark.slow),
        {"effort": "draft", "match": "aabb", "min_opacity": 0.3, "k": 2},
    ],
    ids=str,
)
def test_the_same_settings_give_the_same_gaussians(settings: dict[str, Any], pixels: Scene) -> None:
    assert_equal_to_compact(pixels, **settings)


def test_networks_are_kept_with_the_scene(pixels: Scene, tmp_path: Path) -> None:
    settings = {"budget": "12%"}
    checkpoint = written(tmp_path / "networks.safetensors", noisy())
    actual = assert_equal_to_compact(pixels, checkpoint=str(checkpoint), **settings)
    assert not scenes.identical(actual, unfitted(pixels, **settings))
    kept = one_batch(pixels, superpixels=SHARE, checkpoint=str(checkpoint), **settings)
    checkpoint.unlink()
    save_state(tmp_path / "scene.gsm", kept)
    assert scenes.identical(decoded(load_state(tmp_path / "scene.gsm")), actual)


def test_scenes_in_no_order(pixels: Scene) -> None:
    unaligned = voxels(pixels, 0.05)
    actual = one_batch(unaligned, superpixels="20%", k="mixed")
    assert actual.settings.num_slots is not None
    assert actual.settings.max_k == 8
    for k in (1, "mixed"):
        assert scenes.identical(decoded(actual, k=k), unfitted(unaligned, k=k, superpixels="20%")), k


def test_what_no_view_sees_is_kept(pixels: Scene) -> None:
    unaligned = shuffled(pixels)
    hidden = far_behind(unaligned.gaussians, 200)
    both = replace(unaligned, gaussians=Gaussians.concat([unaligned.gaussians, hidden]))
    actual = one_batch(both, superpixels=SHARE, unseen="keep", budget="12%")
    assert len(actual.kept) > 0
    assert scenes.identical(decoded(actual), unfitted(both, unseen="keep", budget="12%"))


def test_a_budget_of_the_decoder_is_met_and_dealt_where_it_helps(state: State) -> None:
    groups = len(state)
    counts = counts_of(state, budget=groups + 50).per_group
    assert counts.sum() == groups + 50
    more = counts_of(state, budget=groups + 80).per_group
    assert (more >= counts).all()
    share = counts_of(state, budget="10%").per_group.sum()
    assert share == state.settings.num_input // 10


def test_more_than_there_is_to_divide_is_told(state: State) -> None:
    counts = counts_of(state, budget=state.settings.num_input)
    assert counts.per_group.sum() == most_of(state) - len(state.kept)
    assert len(counts.notes) == 1
    assert names(counts.notes[0], most_of(state))
    assert len(decoded(state, budget=state.settings.num_input)) <= most_of(state)


def test_auto_takes_what_compact_would_without_photos(bare: Scene, bare_state: State) -> None:
    expected = len(unfitted(bare, budget="auto"))
    assert bare_state.settings.knee_count == expected
    counts = counts_of(bare_state, budget="auto")
    assert counts.per_group.sum() == max(expected, len(bare_state))
    fewer = replace(bare_state, settings=replace(bare_state.settings, knee_count=len(bare_state) - 1))
    counts = counts_of(fewer, budget="auto")
    assert counts.per_group.tolist() == [1] * len(bare_state)
    assert names(counts.notes[0], "fewer", "groups")


def test_wishes_that_cannot_be_met(state: State) -> None:
    for name, value, found in (("k", 0, "mixed or 1 to 4"), ("budget", 10, "begin"), ("budget", "0%", "one Gaussian")):
        with refuses(UsageError, name, found, value):
            decoded(state, **{name: value})


@pytest.mark.parametrize("mixed", [{"k_low": 10, "k_high": 40}, {"k_rule": "distortion"}], ids=str)
def test_how_k_is_mixed_may_be_said_later(mixed: dict[str, Any], pixels: Scene, state: State) -> None:
    actual = decoded(state, k="mixed", mixed=mixed)
    assert scenes.identical(actual, unfitted(pixels, k="mixed", **mixed))
    assert not scenes.identical(actual, decoded(state, k="mixed"))


def test_mixtures_that_cannot_be_had(pixels: Scene, state: State) -> None:
    with refuses(UsageError, "k mixed", "4", 2):
        decoded(one_batch(pixels, superpixels=SHARE, max_k=2), k="mixed")
    with refuses(UsageError, "max_k", 4, "mixed", 2):
        one_batch(pixels, superpixels=SHARE, k="mixed", max_k=2)
    with refuses(UsageError, "k_rule distortion", "max_k 4", 8):
        decoded(one_batch(pixels, superpixels=SHARE, max_k=8), k="mixed", mixed={"k_rule": "distortion"})
    with refuses(UsageError, "k_high", 90):
        decoded(state, k="mixed", mixed={"k_low": 90})
    old = replace(state, groups=replace(groups_of(state), saliency=None))
    with refuses(UsageError, "k mixed", "saliency", "0.1"):
        decoded(old, k="mixed")


def test_gaussians_that_are_seen_just_enough(pixels: Scene, state: State) -> None:
    """Rounding decides about these, so both ways have to weigh in the same way."""
    ones, _ = children_of(groups_of(state), np.ones(len(state), int), state.cameras)
    peaks, _ = peak_weights(ones, blank_photos(state.cameras, 2))
    for least in map(float, np.sort(peaks)[len(peaks) // 6 :: len(peaks) // 3]):
        actual = decoded(replace(state, settings=replace(state.settings, min_contribution=least)), k=1)
        assert scenes.identical(actual, unfitted(pixels, k=1, min_contribution=least))


def test_fewer_children_take_less_space(pixels: Scene, state: State) -> None:
    small = one_batch(pixels, superpixels=SHARE, max_k=1)
    assert len(groups_of(small).division.children) == 0
    assert scenes.identical(decoded(small), decoded(state, k=1))
    with refuses(UsageError, "k", "1 to 1", 2):
        decoded(small, k=2)
