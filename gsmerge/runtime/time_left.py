"""Seconds that a run still takes, by the progress that it reports."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from gsmerge.runtime.record import STAGES

# Steps of a fit that take as long as all that follows it: scores, and in a run of many steps the trial on left-out
# views, whose own steps are always as many
AFTER, AFTER_FEW, MANY = 70, 5, 160


@dataclass
class TimeLeft:
    """The seconds left of one run: known once steps of its fit, or of a stage that counts them, were seen to take time.

    Searches and blocks run several fits, of which only the one that runs is counted.
    """

    clock: Callable[[], float] = time.monotonic
    start: float = field(init=False)
    end: float | None = field(init=False, default=None)  # when the run is expected to end
    _stage: str = field(init=False, default="")
    _first: tuple[float, int] | None = field(init=False, default=None)  # time and number of the stage's first step

    def __post_init__(self) -> None:
        self.start = self.clock()

    @property
    def seconds(self) -> float:
        """Seconds since the run began."""
        return self.clock() - self.start

    def move(self, text: str, done: int, total: int) -> float | None:
        """Take what a run reports, and return its seconds left; None where they are not known yet."""
        stage, _, detail = text.partition(": ")
        now = self.clock()
        if stage != self._stage:
            self._stage, self._first = stage, None
            self.end = now if stage == "done" else self.end if stage in STAGES else None
        if detail or (stage not in STAGES and total > 0):
            self._count(now, done, total)
        return None if self.end is None else max(0.0, self.end - now)

    def _count(self, now: float, done: int, total: int) -> None:
        """Expect the end by the time that each step took since the stage's first one."""
        time_before, done_before = self._first = self._first or (now, done)
        if done > done_before:
            after = 0 if self._stage != "fit" else AFTER if total >= MANY else AFTER_FEW
            step = (now - time_before) / (done - done_before)
            self.end = now + step * (max(0, total - done) + after)
