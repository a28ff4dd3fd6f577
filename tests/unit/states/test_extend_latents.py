"""States whose groups keep their latents: one batch, several, the same again, other networks, and the file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
from hostile.gsm_files import (
    Spoil,
    assert_refused_in_one_line,
    filled,
    header,
    of_arrays,
    with_array,
    with_header,
)
from messages import noted, refuses
from network_fixtures import SMALL, Made, made, noisy, scaled, written
from safetensors.numpy import load_file
from unaligned_scenes import voxels, without_order
from view_batches import FAST, fed, parts_of, room, same_state, state_of

from gsmerge import Compactor, Scene, compact
from gsmerge.errors import SceneError, UsageError
from gsmerge.networks.apply import encode_features, refine_features
from gsmerge.networks.tokens import compute_group_features
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.stages import MatchOptions
from gsmerge.stages.match import match
from gsmerge.stages.merge import merge, take
from gsmerge.states import extend_latents
from gsmerge.states.extend import extend
from gsmerge.states.extend_latents import StateContext, sample_views
from gsmerge.states.state import GroupSet, State
from gsmerge.states.state_file import load_state, save_state

OUTPUTS = ("absolute", "residual")
PLAIN = {"match": "aabb", "superpixels": "10%", "tolerance": 0}


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Networks with an encoder, by the kind of their heads' output."""
    folder = tmp_path_factory.mktemp("networks")
    options = {name: replace(SMALL, outputs=name) for name in OUTPUTS}
    networks = {name: noisy(options[name], 0.05, seed=2) for name in OUTPUTS}  # whose heads leave most children visible
    return {name: str(written(folder / f"{name}.safetensors", networks[name])) for name in OUTPUTS}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return room(4)


@pytest.fixture(scope="module")
def absolute(checkpoints: dict[str, str]) -> dict[str, Any]:
    """Settings of the networks with absolute outputs."""
    return PLAIN | {"checkpoint": checkpoints["absolute"]}


@pytest.fixture(scope="module")
def whole(scene: Scene, absolute: dict[str, Any]) -> Compactor:
    """All views in one batch."""
    return fed([scene], **absolute)


@pytest.fixture(scope="module")
def pairs(scene: Scene, absolute: dict[str, Any]) -> Compactor:
    """The same views in batches of two."""
    return fed(parts_of(scene, 2), **absolute)


def groups_of(state: State) -> GroupSet:
    assert isinstance(state.groups, GroupSet)
    return state.groups


# one batch


@pytest.mark.parametrize("outputs", OUTPUTS)
def test_one_batch_is_a_scene(outputs: str, scene: Scene, checkpoints: dict[str, str]) -> None:
    """Bit for bit."""
    settings = PLAIN | {"checkpoint": checkpoints[outputs]}
    settings.pop("tolerance")
    actual = fed([scene], **settings)
    for k in (1, 3, "mixed"):
        expected = compact(scene, fit="none", poses="fixed", exposure="fixed", k=k, **settings).gaussians
        assert scenes.identical(actual.decode(k=k, fit="none"), expected), k


def test_one_batch_in_no_order_is_a_scene(scene: Scene, tmp_path: Path) -> None:
    """Bit for bit, where the recipe gives each Gaussian to the superpixel that shows most of it."""
    options = replace(SMALL, outputs="absolute", geometry="carried", merger_start="first", group_numbers=False)
    checkpoint = str(written(tmp_path / "networks.safetensors", noisy(options, 0.05)))
    settings = {"recipe": "paper", "superpixels": "10%", "checkpoint": checkpoint}
    unaligned = voxels(scene, 0.05)
    compactor = fed([unaligned], **settings)
    assert state_of(compactor).settings.num_slots is None
    for k in (2, "mixed"):
        actual = compactor.decode(k=k, fit="none")
        assert scenes.identical(actual, compact(unaligned, k=k, **settings).gaussians), k
        assert k == "mixed" or 1.8 * len(compactor) < len(actual) <= 2 * len(compactor)


@pytest.mark.parametrize("size", [2, 4])
def test_children_are_those_of_the_heads(size: int, scene: Scene, absolute: dict[str, Any]) -> None:
    """Nothing is stored of them, and each group gives as many as are asked for, however few its members are."""
    settings = {"superpixels": "60%", "min_contribution": 0.0, "min_opacity": 0.0}
    whole = fed(parts_of(scene, size), **absolute | settings)
    groups = state_of(whole).groups
    assert len(groups.children if size == 2 else groups.division.children) == 0
    assert int(groups.learned.num_members.min()) < 3
    assert [len(whole.decode(k=k, fit="none")) for k in (1, 2, 3, 4)] == [k * len(whole) for k in (1, 2, 3, 4)]
    with refuses(UsageError, "k", "1 to 4", 5):
        whole.decode(k=5)
    if size == 2:
        with refuses(UsageError, "k_rule distortion", "one batch"):
            whole.decode(k="mixed", k_rule="distortion", fit="none")


def test_a_fit_begins_with_the_heads(whole: Compactor, scene: Scene) -> None:
    assert len(state_of(whole).replay) == 4
    plain, fitted = whole.decode(fit="none"), whole.decode(fit="full", fit_steps=10)
    assert scenes.psnr_of(fitted, scene) > scenes.psnr_of(plain, scene) + 0.5
    expected = len(whole) + 60
    assert expected - 3 <= len(whole.decode(budget=expected, fit="none")) <= expected


# further batches


def test_reports_of_further_batches(pairs: Compactor) -> None:
    first, second = pairs.batches
    assert first["num_joined"] == second["num_covered"] == 0
    assert 0 < second["num_joined"] < second["num_new"]
    assert second["num_groups"] < first["num_groups"] + second["num_new"]
    assert len(state_of(pairs).cameras) == len(state_of(pairs).networks.samples.means) == 4


def test_members_add_up(pairs: Compactor, whole: Compactor, scene: Scene) -> None:
    """Each Gaussian of every batch is in one group, and so is the saliency of its pixel."""
    groups = [state_of(compactor).groups for compactor in (pairs, whole)]
    assert [int(one.learned.num_members.sum()) for one in groups] == [scene.num_gaussians] * 2
    sums = [float(np.sum(one.saliency * one.learned.num_members)) for one in groups]
    assert sums[0] == pytest.approx(sums[1], rel=1e-6)
    counts = [len(pairs.decode(k=k, fit="none")) for k in (1, "mixed", 2)]
    assert counts == sorted(set(counts))


@pytest.mark.parametrize(("outputs", "tolerance"), [("absolute", 0.06), ("residual", 0)])
def test_the_same_batch_again(tolerance: float, outputs: str, scene: Scene, checkpoints: dict[str, str]) -> None:
    settings = PLAIN | {"checkpoint": checkpoints[outputs], "tolerance": tolerance}
    one, two = (fed([scene] * times, **settings) for times in (1, 2))
    assert len(two) <= 1.02 * len(one)
    assert (two.batches[1]["num_covered"] > 0) == (tolerance > 0)
    assert len(state_of(two).cameras) == len(state_of(two).networks.samples.means) == 4


def test_the_threads_do_not_matter(scene: Scene, absolute: dict[str, Any], pairs: Compactor) -> None:
    other = fed(parts_of(scene, 2), **absolute, threads=1)
    same_state(state_of(other), state_of(pairs))


@pytest.mark.parametrize("kind", ["in no order", "without photos", "of another size"])
def test_odd_batches(kind: str, scene: Scene, absolute: dict[str, Any]) -> None:
    batches = parts_of(scene, 2)
    if kind == "in no order":
        batches[1] = without_order(batches[1])
    elif kind == "without photos":
        batches[0] = replace(batches[0], images=None)
    else:
        batches[1] = scenes.take_views(room(4, 54, 36), [0, 1])
    assert len(fed(batches, **absolute).decode(k=2, fit="none")) > 50


# groups of a state and of a batch


@pytest.fixture(scope="module")
def some() -> Made:
    return made(3)


def context_of(some: Made, networks: Any) -> StateContext:
    """The networks with samples of every pixel, and Gaussians as the parts."""
    cameras, num_pixels = some.scene.cameras, some.scene.pixels_per_view
    return StateContext(
        networks=networks,
        members=some.members,
        cameras=cameras,
        samples=sample_views(some.members, cameras, (cameras.height, cameras.width)),
        part_views=np.arange(len(some.members.means)) // num_pixels,
        part_members=np.ones(len(some.members.means), np.int64),
        part_weights=some.members.opacities,
    )


def test_parts_tell_what_members_tell(some: Made) -> None:
    """Before and after merging, with a sample for each pixel."""
    networks = noisy()
    plain, context = some.networks(networks), context_of(some, networks)
    features = encode_features(some.features, plain)
    merged = merge(features, match(features, MatchOptions(match="aabb", iou=0.05)))
    assert len(merged) < len(features)
    for each in (features, merged):
        expected = compute_group_features(each, some.members, some.scene.cameras)
        actual = context.describe(each)
        np.testing.assert_array_equal(actual.views, expected.views)
        np.testing.assert_array_equal(actual.group, expected.group)


def test_only_what_is_touched_is_refined(some: Made) -> None:
    """As if all were refined from what the merger left; the others keep what they had."""
    networks = noisy()
    features = encode_features(some.features, some.networks(networks))
    count = len(features)
    parts = replace(features, starts=np.arange(count + 1), members=np.arange(count, dtype=np.int32))
    plain = some.networks(networks)
    described = compute_group_features(features, some.members, some.scene.cameras)
    context = replace(
        context_of(some, networks),
        part_views=described.views,
        part_members=np.diff(features.starts),
        part_weights=features.weights,
    )
    every = refine_features(features, plain)
    before = take(replace(parts, means=parts.means + 7), np.arange(count - 3))  # the last three are new
    actual = extend_latents._refine_near(parts, before, context)
    moved = np.flatnonzero(np.abs(actual.means - parts.means).max(1) < 5)
    assert set(range(count - 3, count)) < set(moved.tolist())
    assert len(moved) < count
    for name in ("means", "covars", "latents"):
        np.testing.assert_array_equal(getattr(actual, name)[moved], getattr(every, name)[moved], name)
    kept = np.setdiff1d(np.arange(count), moved)
    np.testing.assert_array_equal(actual.means[kept], before.means[kept])


def test_samples_of_a_grid(some: Made) -> None:
    members, cameras = some.members, some.scene.cameras
    actual = sample_views(members, cameras, (3, 4))
    means = members.means.reshape(3, 18, 24, 3)
    np.testing.assert_array_equal(actual.means, means[:, 3::6, 3::6])
    assert actual.opacities.shape == (3, 3, 4)
    fronts = np.arange(len(members.means), dtype=np.int32)[::-1].reshape(3, 18, 24).copy()
    fronts[1] = -1
    turned = sample_views(replace(members, pixels=np.arange(fronts.size), fronts=fronts), cameras, (3, 4))
    np.testing.assert_array_equal(turned.means[::2], means[::-1, ::-1, ::-1][::2, 3::6, 3::6])
    assert not turned.opacities[1].any()
    nothing = sample_views(replace(members, means=np.full_like(members.means, np.nan)), cameras, (3, 4))
    assert not nothing.opacities.any()
    assert np.isfinite(nothing.means).all()


# networks


def options_of(settings: dict[str, Any]) -> CompactOptions:
    return CompactOptions().with_settings({k: v for k, v in settings.items() if k != "tolerance"} | {"fit": "none"})


def test_other_networks_are_refused(
    pairs: Compactor, scene: Scene, absolute: dict[str, Any], checkpoints: dict[str, str]
) -> None:
    for name in ("none", "auto", checkpoints["residual"]):
        with refuses(UsageError, f"checkpoint {name}", "state", absolute["checkpoint"]):
            extend(state_of(pairs), scene, options_of(absolute | {"checkpoint": name}))


def test_networks_of_another_name_may_be_the_same(
    pairs: Compactor, scene: Scene, absolute: dict[str, Any], tmp_path: Path
) -> None:
    copy = tmp_path / "copy.safetensors"
    copy.write_bytes(Path(absolute["checkpoint"]).read_bytes())
    _, report = extend(state_of(pairs), scenes.take_views(scene, [0]), options_of(absolute | {"checkpoint": str(copy)}))
    assert not noted(report.notes, "networks")
    with refuses(SceneError, "missing.safetensors", "checkpoint"):
        extend(state_of(pairs), scene, options_of(absolute | {"checkpoint": str(tmp_path / "missing.safetensors")}))


def test_a_state_has_its_own_networks(scene: Scene, tmp_path: Path) -> None:
    """Whether the file that it began with has changed or is gone: nothing opens a path that a state names."""
    networks = noisy(replace(SMALL, outputs="absolute"), 0.05)
    path = written(tmp_path / "a.safetensors", networks)
    batches, settings = parts_of(scene, 2), PLAIN | {"checkpoint": str(path)}
    compactor = fed(batches[:1], **settings)
    compactor.save(tmp_path / "a.gsm")
    compactor.extend(batches[1])
    for change in (lambda: written(path, scaled(networks, 1.1)), path.unlink):
        change()
        again = Compactor.load(tmp_path / "a.gsm")
        report = again.extend(batches[1])
        assert not noted(report.notes, "networks")
        same_state(state_of(again), state_of(compactor))


def test_a_state_without_latents_goes_on_without(scene: Scene, absolute: dict[str, Any]) -> None:
    batches = parts_of(scene, 2)
    first = state_of(fed(batches[:1], **FAST))
    state, report = extend(first, batches[1], options_of(absolute))
    assert state.networks is None
    assert noted(report.notes, "state", "latents")


# the file


ARRAYS = ("refined.means", "refined.latents", "heads.views", "heads.num_members", "samples.opacities", "samples.sh0")
FLOATS = [name for name in ARRAYS if not name.startswith("heads.")]
DAMAGED: dict[str, Spoil] = {
    "networks in a list": with_header(networks=[1]),
    "networks of another size": with_header(networks={"width": 8}),
    "children of groups": with_array("children.counts", lambda a: a + 5),
    "views beyond": with_array("heads.views", lambda a: a + 4),
    "a group of nothing": with_array("heads.num_members", filled(0)),
    "samples of fewer views": with_array("samples.opacities", lambda a: a[1:]),
    "samples without pixels": with_array("samples.opacities", lambda a: a[:, :0]),
    **of_arrays(ARRAYS, FLOATS),
}


def test_saved_between_batches_is_kept_in_memory(
    scene: Scene, absolute: dict[str, Any], pairs: Compactor, tmp_path: Path
) -> None:
    """Before and after latents are shared; what is loaded is written as the same bytes."""
    first, second = parts_of(scene, 2)
    fed([first], **absolute).save(tmp_path / "a.gsm")
    stored = Compactor.load(tmp_path / "a.gsm")
    stored.extend(second)
    same_state(state_of(stored), state_of(pairs))
    stored.save(tmp_path / "b.gsm")
    save_state(tmp_path / "again.gsm", load_state(tmp_path / "b.gsm"))
    assert (tmp_path / "again.gsm").read_bytes() == (tmp_path / "b.gsm").read_bytes()


def test_parts_that_are_not_there_are_not_written(scene: Scene, tmp_path: Path) -> None:
    save_state(tmp_path / "a.gsm", state_of(fed([scene], fit_colors=False, replay=0)))
    assert "networks" not in header(tmp_path / "a.gsm")
    parts = {name.partition(".")[0] for name in load_file(tmp_path / "a.gsm")}
    assert parts == {"features", "division", "kept", "cameras", "frame"}
    save_state(tmp_path / "b.gsm", state_of(fed([scene])))
    assert {name.partition(".")[0] for name in load_file(tmp_path / "b.gsm")} == parts | {"replay"}


@pytest.mark.parametrize("damage", sorted(DAMAGED))
def test_damage_is_told_in_one_line(damage: str, pairs: Compactor, tmp_path: Path) -> None:
    path = tmp_path / "state.gsm"
    pairs.save(path)
    DAMAGED[damage](path)
    assert_refused_in_one_line(load_state, path)


def test_damaged_numbers_of_children_that_heads_make(whole: Compactor, tmp_path: Path) -> None:
    for damage in (
        with_array("division.uniform", lambda _: np.full(1, 10_000_000, np.int32)),
        with_array("division.splits", lambda a: a + 8),
        with_array("division.splits", lambda a: a[1:]),
        with_array("division.growth_order", filled(10_000_000)),
    ):
        path = tmp_path / "state.gsm"
        save_state(path, state_of(whole), overwrite=True)
        assert len(load_file(path)["division.means"]) == 0
        damage(path)
        assert_refused_in_one_line(load_state, path)
