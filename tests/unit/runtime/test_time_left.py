"""Seconds left, by a clock that the tests move."""

from __future__ import annotations

import pytest

from gsmerge.runtime.time_left import Forecast, Part


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def take_steps(forecast: Forecast, clock: Clock, seconds: float, first: int, last: int, total: int) -> None:
    for step in range(first, last + 1):
        clock.now += seconds
        forecast.move("fit: photos 20.0 dB", step, total)


def test_costs_say_what_is_left(clock: Clock) -> None:
    """Fits and stages have rates of their own; what came before the first part has no cost."""
    forecast = Forecast(clock)
    forecast.move("prepare", 1, 17)
    clock.now += 50
    forecast.expect([Part(before=10, fit=100, after=5), Part(before=10, fit=50, after=5), Part(before=20)])
    forecast.begin()
    forecast.move("segment", 2, 17)
    clock.now += 4
    forecast.move("fit", 12, 17)
    assert forecast.seconds_left is None  # no step yet
    clock.now += 6  # a cost of 10 in ten seconds
    forecast.move("fit: photos 20.0 dB", 1, 100)
    take_steps(forecast, clock, 3, 2, 51, 100)  # 50 in 150 seconds
    assert forecast.seconds_left == pytest.approx(3 * (49 + 50) + 1 * (5 + 10 + 5 + 20))
    take_steps(forecast, clock, 3, 52, 100, 100)
    forecast.move("score", 15, 17)
    clock.now += 2
    assert forecast.seconds_left == pytest.approx(3 * 50 + 5 - 2 + 10 + 5 + 20)


def test_every_fit_of_a_run_counts(clock: Clock) -> None:
    """Each part has as many as it says, and the next part begins where the last one ended."""
    forecast = Forecast(clock)
    forecast.expect([Part(fit=200, num_fits=2), Part(fit=100)])
    forecast.begin()
    left = []
    for num_fits, part in ((2, 0), (1, 1)):
        if part:
            forecast.begin()
        for _ in range(num_fits):
            forecast.move("fit", 12, 17)
            for step in range(1, 101):
                clock.now += 1
                forecast.move("fit: photos 20.0 dB", step, 100)
                left.append(forecast.seconds_left)
    known = [seconds for seconds in left if seconds is not None]
    assert known[0] == pytest.approx(298, abs=2)
    assert known == sorted(known, reverse=True)
    assert known[-1] == pytest.approx(0, abs=2)
    forecast.move("done", 17, 17)
    assert forecast.seconds_left == 0


def test_other_parts_are_expected_in_place_of_those_before(clock: Clock) -> None:
    forecast = Forecast(clock)
    forecast.expect([Part(fit=100)] * 4)
    forecast.begin()
    take_steps(forecast, clock, 2, 1, 50, 100)
    assert forecast.seconds_left == pytest.approx(2 * 350, rel=0.03)
    forecast.expect([Part(fit=10)])
    assert forecast.seconds_left == pytest.approx(2 * 60, rel=0.03)


def test_what_has_no_parts_counts_its_own_steps(clock: Clock) -> None:
    forecast = Forecast(clock)
    forecast.move("read", 0, 0)
    assert forecast.seconds_left is None
    forecast.move("render", 0, 10)
    assert forecast.seconds_left is None
    clock.now += 4
    forecast.move("render", 2, 10)
    assert forecast.seconds_left == pytest.approx(16)
    clock.now += 1
    assert forecast.seconds_left == pytest.approx(15)
    forecast.move("views from outside", 0, 3)
    assert forecast.seconds_left is None
    assert forecast.seconds == pytest.approx(5)
