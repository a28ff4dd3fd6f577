"""Steps in few calls: the same bits as by single calls of the kernels, whatever the threads."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes

from gsmerge import Gaussians
from gsmerge.fit import FitJob, FitOptions, prepared_step, steps
from gsmerge.fit.fit_state import FitState, start_state
from gsmerge.fit.schedule import Schedule, prepare_fit
from gsmerge.fit.steps import Optimiser, make_optimiser
from gsmerge.raster.photos import Photos
from gsmerge.runtime.threads import use_threads

Pair = tuple[Photos, Photos]
STEPS = 12  # half of them on half-size photos


def take_steps(
    truth: Gaussians, photos: Pair, *, threads: int = 2, dropout: float = 0.0, fixed: bool = False
) -> tuple[FitState, list[float], Optimiser]:
    """The state, the errors and the optimiser after steps from a spoiled start."""
    options = FitOptions(fit_steps=STEPS, holdout=0.2, dropout=dropout, half_res_share=0.5)
    run = prepare_fit(FitJob(photos, options))
    optimiser, schedule, state = make_optimiser(run), Schedule(run), start_state(scenes.spoil(truth))
    state.fixed[0] = fixed
    with use_threads(threads):
        draws = [schedule.draw(number + 1, number / STEPS, len(state.x)) for number in range(STEPS)]
        return state, [optimiser.step(state, draw) for draw in draws], optimiser


def same(first: FitState, second: FitState) -> bool:
    names = ("x", "m", "v", "colors")
    equal = [np.array_equal(getattr(first, name), getattr(second, name)) for name in names]
    return all(equal) and all(
        np.array_equal(a, b) for a, b in zip(*(vars(s.splats).values() for s in (first, second)), strict=True)
    )


@pytest.fixture
def single(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Steps are taken by single calls of the kernels."""
    monkeypatch.setattr(steps, "is_prepared", lambda state: False)
    return monkeypatch


@pytest.mark.parametrize("dropout", [0.0, 0.2])
def test_bits_are_those_of_single_calls(truth: Gaussians, photos: Pair, dropout: float, single: Any) -> None:
    expected, errors, optimiser = take_steps(truth, photos, dropout=dropout)
    assert optimiser.tables is None
    single.undo()
    for threads in (1, 2, 5):
        actual, other, optimiser = take_steps(truth, photos, dropout=dropout, threads=threads)
        assert optimiser.tables is not None
        assert other == errors
        assert same(actual, expected)


def test_all_low_passes_draw_the_same(truth: Gaussians, photos: Pair, single: Any) -> None:
    states = []
    for _ in range(2):
        run = prepare_fit(FitJob(photos, FitOptions(fit_steps=320, half_res_share=0.0, holdout=0.2)))
        optimiser, schedule, state = make_optimiser(run), Schedule(run), start_state(scenes.spoil(truth))
        draws = [schedule.draw(number, 0.5, len(state.x)) for number in range(1, 17)]
        for draw in draws:
            optimiser.step(state, draw)
        states.append(state)
        assert {(draw.mode.size, draw.mode.antialiased) for draw in draws} == {(0, False), (0, True), (1, False)}
        single.undo()
    assert same(*states)


def test_views_with_too_many_intersections_are_drawn_by_single_calls(
    truth: Gaussians, photos: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected, errors, _ = take_steps(truth, photos)
    monkeypatch.setattr(prepared_step, "MANY", 0)
    monkeypatch.setattr(prepared_step, "MANY_EACH", 0)
    actual, other, optimiser = take_steps(truth, photos)
    assert len(optimiser.tables.room["flatten_ids"]) == 1  # no lists were made
    assert other == errors
    assert same(actual, expected)


def test_fixed_gaussians_and_harmonics_are_left_to_single_calls(truth: Gaussians, photos: Pair) -> None:
    state, _, optimiser = take_steps(truth, photos, fixed=True)
    assert optimiser.tables is None
    assert np.array_equal(state.x[0], start_state(scenes.spoil(truth)).x[0])
    harmonics = start_state(replace(truth, shN=np.zeros((len(truth), 3, 3), np.float32)))
    assert not prepared_step.is_prepared(harmonics)


def test_buffers_follow_the_state_and_the_threads(truth: Gaussians, photos: Pair) -> None:
    state, _, optimiser = take_steps(truth, photos)
    tables = optimiser.tables
    draw = Schedule(optimiser.run).draw(1, 0.9, len(state.x))
    with use_threads(2):
        optimiser.step(state, draw)
    assert optimiser.tables is tables
    with use_threads(3):
        optimiser.step(state, draw)
    assert optimiser.tables is not tables
    other = state[np.arange(len(state.x)) % 2 == 0]
    optimiser.step(other, draw)
    assert optimiser.tables.state is other
