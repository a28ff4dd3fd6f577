"""Steps of the full fit give the bits of a slow twin with any number of threads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
import scenes
from slow_steps import step_slowly

from gsmerge import Gaussians
from gsmerge.method.fit import FitJob, FitOptions
from gsmerge.method.fit.fit_state import FitState, start_state
from gsmerge.method.fit.schedule import FitRun, Schedule, Step, prepare_fit
from gsmerge.method.fit.steps import Optimiser, make_optimiser
from gsmerge.method.geometry.transforms import motion_matrices
from gsmerge.method.raster import tiled_view
from gsmerge.method.raster.photos import Photos
from gsmerge.runtime.threads import use_threads

Pair = tuple[Photos, Photos]
TakeStep = Callable[[Optimiser, FitState, Step], float]
STEPS = 12


@dataclass(frozen=True)
class Case:
    """A fit whose steps are compared; half of them draw samples of the photos."""

    degree: int = 0
    num_fixed: int = 0
    options: dict[str, Any] = field(default_factory=dict)
    is_crowded: bool = False  # whether lists are cut

    def run(self) -> FitRun:
        photos = scenes.pair_of(scenes.self_made(self.degree)[0])
        motions = np.random.default_rng(0).normal(size=(len(photos[0]), 6)) * 0.01
        viewmats = photos[0].viewmats @ motion_matrices(motions)
        photos = tuple(replace(level, viewmats=viewmats) for level in photos)
        usual = {"fit_steps": STEPS, "holdout": 0.2, "half_res_share": 0.5, "dropout": 0.0}
        return prepare_fit(FitJob(photos, FitOptions(**usual | self.options)))

    def state(self) -> FitState:
        truth = scenes.spoil(scenes.self_made(self.degree)[1])
        state = start_state(replace(truth, shN=truth.shN + np.float32(0.1)))
        state.fixed[: self.num_fixed] = True
        return state


CASES = {
    "plain": Case(),
    "dropout": Case(options={"dropout": 0.2}),
    "moved poses": Case(options={"move_cameras": True}),
    "fixed rows": Case(num_fixed=50),
    **{f"harmonics of degree {degree}": Case(degree) for degree in (1, 2, 3)},
    "cut lists": Case(is_crowded=True),
    "all at once": Case(2, 50, {"move_cameras": True, "dropout": 0.2}, is_crowded=True),
}


def take_steps(case: Case, take_step: TakeStep, threads: int = 2) -> tuple[FitState, list[float], Optimiser]:
    """Return the state, the errors and the optimiser after the steps of a case."""
    run, state = case.run(), case.state()
    optimiser, schedule = make_optimiser(run), Schedule(run)
    with use_threads(threads):
        steps = [schedule.draw(number + 1, number / STEPS, len(state.x)) for number in range(STEPS)]
        return state, [take_step(optimiser, state, step) for step in steps], optimiser


def assert_same(first: FitState, second: FitState) -> None:
    for name in ("x", "m", "v", "colors"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)
    for name, array in vars(first.splats).items():
        np.testing.assert_array_equal(array, getattr(second.splats, name), err_msg=name)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_steps_give_the_bits_of_a_slow_twin(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    if case.is_crowded:
        monkeypatch.setattr(tiled_view, "CROWDED", 0)
        monkeypatch.setattr(tiled_view, "CROWDED_EACH", 0)
    expected, errors, twin = take_steps(case, step_slowly)
    assert not np.array_equal(expected.x, case.state().x)
    for threads in (1, 2, 5):
        actual, own_errors, optimiser = take_steps(case, Optimiser.step, threads)
        assert own_errors == errors
        assert_same(actual, expected)
        if twin.poses is None:
            assert optimiser.viewmats is None
        else:
            np.testing.assert_array_equal(optimiser.viewmats, twin.viewmats)
            assert np.abs(twin.poses.x).min() > 0


def test_a_step_with_cut_lists_gives_the_same_state(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five opaque curtains near the cameras, which are about the origin, hide what is behind them."""
    truth, lengths, states = scenes.self_made(0)[1], [], []
    near, wide = np.tile(0.2 * truth.means.mean(0), (5, 1)), np.full((5, 3), 5 * np.ptp(truth.means), np.float32)
    curtains = replace(truth[:5], means=near, scales=wide, opacities=np.full(5, 0.999, np.float32))
    run, hidden = Case().run(), Gaussians.concat([truth, curtains])
    monkeypatch.setattr(tiled_view, "CROWDED_EACH", 0)
    for many in (tiled_view.CROWDED, 0):
        monkeypatch.setattr(tiled_view, "CROWDED", many)
        optimiser, state = make_optimiser(run), start_state(hidden)
        optimiser.step(state, Schedule(run).draw(1, 0.0, len(hidden)))
        ((table, _),) = optimiser.buffers.tables.values()
        lengths.append(table["num_intersections"])
        states.append(state)
    assert lengths[1] < 0.1 * lengths[0]
    assert_same(*states)


def test_steps_of_all_draw_modes_give_the_bits_of_a_slow_twin(truth: Gaussians, photos: Pair) -> None:
    """Sampled and whole photos of both sizes, with and without antialiasing."""
    states = []
    for take_step in (step_slowly, Optimiser.step):
        run = prepare_fit(FitJob(photos, FitOptions(fit_steps=320, half_res_share=0.4, holdout=0.2)))
        optimiser, schedule, state = make_optimiser(run), Schedule(run), start_state(scenes.spoil(truth))
        steps = [schedule.draw(number, 0.1 + 0.4 * (number > 8), len(state.x)) for number in range(1, 25)]
        for step in steps:
            take_step(optimiser, state, step)
        states.append(state)
        modes = {(step.mode.size, step.mode.antialiased, step.mode.stride) for step in steps}
        assert modes == {(0, False, 2), (0, False, 1), (0, True, 1), (1, False, 1)}
    assert_same(*states)


def test_a_state_without_gaussians_takes_steps(photos: Pair, truth: Gaussians) -> None:
    run = prepare_fit(FitJob(photos, FitOptions(fit_steps=STEPS, move_cameras=True)))
    step = Schedule(run).draw(1, 0.9, 0)
    errors = [take(make_optimiser(run), start_state(truth[:0]), step) for take in (Optimiser.step, step_slowly)]
    assert errors[0] == errors[1] > 0


def test_buffers_are_made_again_for_other_threads_or_rows() -> None:
    state, _, optimiser = take_steps(Case(), Optimiser.step)
    buffers = optimiser.buffers
    step = Schedule(optimiser.run).draw(1, 0.9, len(state.x))
    with use_threads(2):
        optimiser.step(state, step)
    assert optimiser.buffers is buffers
    with use_threads(3):
        optimiser.step(state, step)
    assert optimiser.buffers is not buffers
    half = state[np.arange(len(state.x)) % 2 == 0]
    optimiser.step(half, step)
    assert optimiser.buffers.state is half
