"""Batches of views, one after the other: what each does to the state, and what is decoded afterwards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
from messages import noted, refuses
from unaligned_scenes import NO_CAMERAS, far_behind, without_order
from view_batches import FAST, counts, fed, parts_of, room, same_groups, same_state, state_of

from gsmerge import Compactor, Gaussians, Scene
from gsmerge.errors import UsageError
from gsmerge.fit import FitOptions, FitReport
from gsmerge.settings.compact import CompactOptions
from gsmerge.states.decode import decode_state
from gsmerge.states.extend import extend
from gsmerge.states.groups import select_groups, share
from gsmerge.states.state import State
from gsmerge.types import grid_ids


@pytest.fixture(scope="module")
def scene() -> Scene:
    return room()


@pytest.fixture(scope="module")
def pairs(scene: Scene) -> list[Scene]:
    return parts_of(scene, 2)


@pytest.fixture(scope="module")
def first(pairs: list[Scene]) -> State:
    """Of the first pair alone."""
    return state_of(fed(pairs[:1]))


@pytest.fixture(scope="module")
def walked(pairs: list[Scene]) -> Compactor:
    """After all pairs; read only."""
    return fed(pairs)


def options(**settings: Any) -> CompactOptions:
    return CompactOptions().with_settings({**FAST, "fit": "none", **settings})


# the first batch


def test_a_first_batch_keeps_its_frame_and_views(scene: Scene) -> None:
    state = state_of(fed([scene]))
    assert (len(state.cameras), state.cameras.width, state.cameras.height) == (6, 36, 24)
    assert state.settings.num_input == scene.num_gaussians
    assert state.replay.views.tolist() == list(range(6))
    np.testing.assert_allclose(state.replay.images / 255, scene.images, atol=0.5 / 255 + 1e-6)


def test_a_colour_fit_helps(scene: Scene, pairs: list[Scene], walked: Compactor) -> None:
    fitted, plain = (one.decode(fit="none") for one in (walked, fed(pairs, fit_colors=False)))
    assert scenes.psnr_of(fitted, scene) > scenes.psnr_of(plain, scene)


# further batches


def test_reports_add_up(pairs: list[Scene]) -> None:
    compactor = Compactor(**FAST)
    reports = [compactor.extend(batch) for batch in pairs]
    assert counts(reports, "num_views") == [2, 2, 2]
    assert counts(reports, "num_input") == [2 * 36 * 24] * 3
    groups = 0
    for report in reports:
        gone = report.num_covered + report.num_joined + report.num_hidden
        groups += report.num_new - gone
        assert report.num_groups == groups
        assert all(seconds >= 0 for seconds in report.seconds.values())
        assert report.options["superpixels"] == FAST["superpixels"]
    assert groups == len(compactor) == len(state_of(compactor))
    assert reports[0].num_covered == reports[0].num_joined == reports[0].num_hidden == 0
    assert min(report.num_covered for report in reports[1:]) > 0
    assert min(report.num_joined for report in reports[1:]) > 0
    assert [batch["num_groups"] for batch in compactor.batches] == counts(reports, "num_groups")
    assert state_of(compactor).settings.num_input == 6 * 36 * 24
    assert len(state_of(compactor).cameras) == 6


def test_the_old_state_is_left_as_it_is(pairs: list[Scene], first: State) -> None:
    before = state_of(fed(pairs[:1]))
    after, _ = extend(first, pairs[1], options())
    assert after is not first
    assert len(after) > len(first)
    same_state(first, before)


def test_views_that_come_again_count_once(pairs: list[Scene], first: State) -> None:
    state, report = extend(first, pairs[0], options())
    assert state.settings.num_input == first.settings.num_input
    assert len(state.cameras) == len(first.cameras)
    assert noted(report.notes, "count once", "2 of 2")
    _, report = extend(first, pairs[1], options())
    assert not noted(report.notes, "count once")


def test_the_threads_do_not_matter(pairs: list[Scene]) -> None:
    """With the networks of the package, which correct every batch."""
    states, actual = [], []
    for threads in (1, 3):
        compactor = Compactor(superpixels="10%", threads=threads)
        for pair in pairs[:2]:
            assert compactor.extend(pair).choices["networks"]["checkpoint"] == "shipped"
        states.append(replace(state_of(compactor), about={}))
        actual.append(compactor.decode(fit="full", fit_steps=2, effort="fast"))
    same_state(*states)
    assert scenes.identical(*actual)


# what batches may be


def test_pictures_of_another_size(scene: Scene, first: State, floor: Callable[..., None]) -> None:
    large = room(6, 54, 36)
    state, report = extend(first, scenes.take_views(large, [2, 3]), options())
    assert report.num_input == 2 * 54 * 36
    assert (state.cameras.width, state.cameras.height) == (36, 24)
    assert state.replay.images.shape == (4, 24, 36, 3)
    assert report.num_covered + report.num_joined > 0.3 * report.num_new
    gaussians = decode_state(state, options=options().fit).gaussians
    floor(scenes.psnr_of(gaussians, scenes.take_views(scene, [2, 3])))
    single, _ = extend(first, scenes.take_views(scene, [2, 3]), options())
    np.testing.assert_allclose(state.cameras.Ks, single.cameras.Ks, rtol=1e-9)


def test_without_photos(pairs: list[Scene]) -> None:
    """The colours of the pixels stand in for them: they are fitted to, and kept."""
    bare = [replace(pair, images=None) for pair in pairs[:2]]
    compactor = fed(bare)
    state = state_of(compactor)
    assert len(state.replay) == 4
    assert state.groups.colors.precision.any()
    assert len(compactor) < sum(len(fed([pair])) for pair in bare)
    both = scenes.take_views(room(), range(4))
    plain, fitted = (compactor.decode(**wish) for wish in ({"fit": "none"}, {"fit": "full", "fit_steps": 20}))
    assert scenes.psnr_of(fitted, both) > scenes.psnr_of(plain, both) + 1


@pytest.mark.parametrize("bare", [0, 1])
def test_photos_of_some_batches(bare: int, pairs: list[Scene]) -> None:
    batches = list(pairs[:2])
    batches[bare] = replace(batches[bare], images=None)
    compactor = fed(batches)
    assert state_of(compactor).replay.views.tolist() == [0, 1, 2, 3]
    assert len(state_of(compactor).cameras) == 4
    assert len(compactor.decode(fit="full", fit_steps=1)) > 50


@pytest.mark.parametrize("place", [0, 1])
def test_gaussians_in_no_order(place: int, pairs: list[Scene], floor: Callable[..., None]) -> None:
    batches = list(pairs[:2])
    batches[place] = without_order(batches[place])
    compactor = fed(batches)
    assert compactor.batches[1]["num_covered"] + compactor.batches[1]["num_joined"] > 0
    floor(scenes.psnr_of(compactor.decode(fit="none"), scenes.take_views(room(), range(4))))


def test_gaussians_without_photos_in_no_order(pairs: list[Scene]) -> None:
    """Pictures are rendered of the Gaussians, and count for as long as it takes to make room for them."""
    bare = [replace(without_order(pair), images=None) for pair in pairs[:2]]
    compactor = fed(bare)
    assert len(state_of(compactor).replay) == 0
    assert len(compactor.decode()) > 50
    with refuses(UsageError, "fit full", "photos", "none"):
        compactor.decode(fit="full")


@pytest.mark.parametrize("first", [True, False])
def test_gaussians_without_cameras(first: bool, pairs: list[Scene], floor: Callable[..., None]) -> None:
    """Views are placed for them."""
    bare = Scene(pairs[0].gaussians, NO_CAMERAS, None, None, ())
    compactor = fed([bare, pairs[1]] if first else [pairs[1], bare])
    assert compactor.batches[1]["num_covered"] > 0
    assert len(state_of(compactor).replay) == 2
    floor(scenes.psnr_of(compactor.decode(fit="none"), pairs[1]))


def test_what_no_view_sees_is_kept(pairs: list[Scene]) -> None:
    batches = []
    for pair in pairs[:2]:
        unaligned = without_order(pair)
        hidden = far_behind(unaligned.gaussians, 300)
        batches.append(replace(unaligned, gaussians=Gaussians.concat([unaligned.gaussians, hidden])))
    compactor = fed(batches, unseen="keep")
    kept = state_of(compactor).kept
    num = len(kept)
    expected = len(compactor) + num + 60
    for wish in ({"fit": "none"}, {"fit": "full", "fit_steps": 2}):
        actual = compactor.decode(**wish, budget=expected)
        assert int((actual.means[:, 2] < -10).sum()) == num, wish
        assert len(actual) == pytest.approx(expected, abs=2), wish


def test_views_that_see_nothing_of_the_state(first: State) -> None:
    """A room far away: all is new, and what was there stays as it was."""
    away = scenes.move(room(2), np.eye(3), 1.0, np.array([100.0, 0.0, 0.0]))
    state, report = extend(first, away, options())
    assert (report.num_covered, report.num_joined) == (0, 0)
    assert len(state) == len(first) + report.num_new - report.num_hidden
    rows = np.arange(len(first))
    same_groups(select_groups(state.groups, rows), select_groups(share(first).groups, rows))


def test_a_batch_without_a_valid_gaussian(pairs: list[Scene], first: State) -> None:
    """Its photos count all the same."""
    nothing = replace(pairs[1], pixel_ids=grid_ids(np.zeros_like(pairs[1].valid)))
    state, report = extend(first, nothing, options())
    assert (report.num_new, len(state)) == (0, len(first))
    assert len(state.replay) == 4
    assert scenes.identical(state.groups.children, share(first).groups.children)
    with refuses(ValueError, "", "valid", "none"):
        Compactor(**FAST).extend(nothing)


def test_everything_counts_without_a_tolerance(pairs: list[Scene], walked: Compactor) -> None:
    compactor = fed(pairs, tolerance=0)
    assert [batch["num_covered"] for batch in compactor.batches] == [0, 0, 0]
    assert len(compactor) > len(walked)


# decoding


@pytest.mark.parametrize("fit", ["none", "full"])
def test_a_budget_is_met(fit: str, walked: Compactor) -> None:
    expected = len(walked) + 60
    steps = {"fit_steps": 1} if fit == "full" else {}
    assert expected - 3 <= len(walked.decode(budget=expected, fit=fit, **steps)) <= expected
    with refuses(UsageError, "budget", "group", 10):
        walked.decode(budget=10, fit=fit)


def test_every_k_up_to_the_most(scene: Scene, pairs: list[Scene]) -> None:
    """More children show more, in the exports' colours: fitted ones are those of the group."""
    compactor = fed(pairs, max_k=2, fit_colors=False)
    one, two = (compactor.decode(k=k, fit="none") for k in (1, 2))
    assert len(compactor) >= len(one)
    assert len(one) < len(two) <= 2 * len(compactor)
    assert scenes.psnr_of(two, scene) > scenes.psnr_of(one, scene)
    with refuses(UsageError, "k", "1 to 2", 3):
        compactor.decode(k=3)
    with refuses(UsageError, "", "k", "budget", "both"):
        compactor.decode(k=1, budget=500)


def test_a_full_fit_shows_more_and_leaves_the_state_as_it_is(
    scene: Scene, pairs: list[Scene], walked: Compactor
) -> None:
    colors, full = walked.decode(fit="none"), walked.decode(fit="full", fit_steps=20)
    assert scenes.psnr_of(full, scene) > scenes.psnr_of(colors, scene) + 0.5
    same_state(state_of(walked), state_of(fed(pairs)))


def test_a_fit_in_vain_leaves_the_solved_colours(walked: Compactor, monkeypatch: pytest.MonkeyPatch) -> None:
    from gsmerge.states import decode as decode_module

    def refused(gaussians: Gaussians, *_: object, **__: object) -> tuple[Gaussians, FitReport]:
        return gaussians, FitReport("none", False, 1, 20.0, 19.0, "in vain")

    monkeypatch.setattr(decode_module, "fit", refused)
    actual = decode_state(state_of(walked), k=1, options=FitOptions(fit_steps=4))
    assert not actual.fit.accepted
    assert noted(actual.notes, "fit", "accepted")
    assert scenes.identical(actual.gaussians, walked.decode(k=1, fit="none"))


def test_results_are_in_the_world(scene: Scene, floor: Callable[..., None]) -> None:
    turn, shift = scenes.random_rotation(0), np.array([30.0, -20.0, 10.0])
    moved = scenes.move(scene, turn, 4.0, shift)
    floor(scenes.psnr_of(fed(parts_of(moved, 3)).decode(fit="none"), moved))


# what is refused


def test_what_a_state_cannot_have(pairs: list[Scene]) -> None:
    wishes = (
        ({"fit": "full"}, "fit full", "photos"), ({"method": "voxel"}, "method voxel", "views"),
        ({"levels": 2}, "levels", "views"), ({"quality": "-0.1dB"}, "quality -0.1dB", "views"),
    )  # fmt: skip
    for settings, place, found in wishes:
        compactor = Compactor(**FAST | settings)
        with refuses(UsageError, place, found):
            compactor.extend(pairs[0])
        assert compactor.state is None


def test_more_gaussians_of_a_group_than_are_kept(pairs: list[Scene], first: State) -> None:
    with refuses(UsageError, "max_k", 3, 2):
        Compactor(**FAST, k=3, max_k=2).extend(pairs[0])
    with refuses(UsageError, "max_k", 5, 4):
        extend(first, pairs[1], options(k=5))


def test_a_budget_that_keeps_everything(pairs: list[Scene]) -> None:
    with refuses(UsageError, "budget", 1728):
        Compactor(**FAST, budget="100%").extend(without_order(pairs[0]))


def test_nothing_before_the_first_batch(tmp_path: Any) -> None:
    compactor = Compactor()
    assert (len(compactor), compactor.state, list(compactor.batches)) == (0, None, [])
    with refuses(ValueError, "", "decoding", "none"):
        compactor.decode()
    with refuses(ValueError, "", "saving", "none"):
        compactor.save(tmp_path / "a.gsm")
    assert list(tmp_path.iterdir()) == []


def test_a_batch_that_fails_changes_nothing(pairs: list[Scene]) -> None:
    compactor = fed(pairs[:1])
    before = compactor.state
    with pytest.raises(UsageError):
        compactor.extend(room(2, degree=1))
    assert compactor.state is before
