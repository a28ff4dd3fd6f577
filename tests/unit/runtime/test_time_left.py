"""Seconds left, by a clock that the tests move."""

from __future__ import annotations

import pytest

from gsmerge.runtime.time_left import AFTER, AFTER_FEW, MANY, TimeLeft


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.mark.parametrize(("steps", "after"), [(MANY, AFTER), (MANY - 1, AFTER_FEW)])
def test_steps_of_a_fit_say_what_is_left(steps: int, after: int) -> None:
    """What comes before it says nothing; what comes after it takes as long as some steps."""
    clock = Clock()
    times = TimeLeft(clock)
    assert times.move("segment", 2, 16) is None
    clock.now += 7
    assert times.move("fit", 12, 16) is None
    clock.now += 1  # which is no step
    assert times.move("fit: photos 20.0 dB", 1, steps) is None
    clock.now += 6
    assert times.move("fit: photos 21.0 dB", 4, steps) == pytest.approx(2 * (steps - 4 + after))
    clock.now += 2 * (steps - 4)
    assert times.move("score", 14, 16) == pytest.approx(2 * after)
    assert times.seconds == pytest.approx(14 + 2 * (steps - 4))
    clock.now += 3 * after
    assert times.move("input", 15, 16) == 0
    assert times.move("done", 16, 16) == 0


def test_other_stages_count_their_own_steps() -> None:
    clock = Clock()
    times = TimeLeft(clock)
    assert times.move("read", 0, 0) is None
    assert times.move("render", 0, 10) is None
    clock.now += 4
    assert times.move("render", 2, 10) == pytest.approx(16)
    assert times.move("views from outside", 0, 3) is None
