"""Forecast the seconds until a run ends, from the parts that it expects and the progress that it reports."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

STAGES = (
    "partition", "prepare", "segment", "curve", "reduce", "members", "encode", "match", "refine",
    "cover", "decode", "join", "fit", "prune", "fill", "score", "input",
)  # fmt: skip
FIT = "fit"


@dataclass(frozen=True)
class Part:
    """Cost of a part of a run: before its fits, of all its fits, and after them.

    Costs may have any unit, since only their ratios matter; the time that a cost takes is measured during the run.
    """

    before: float = 0.0
    fit: float = 0.0  # cost of all its fits together
    after: float = 0.0
    num_fits: int = 1


@dataclass
class Forecast:
    """Forecast of the seconds left in a run. The costs of its parts are given, and the time per cost is measured.

    Fits and all other stages are measured separately, since their costs are unrelated. There is no forecast before the
    first steps of a fit. Work without parts, such as drawing pictures, is forecast by the steps that it counts.
    """

    clock: Callable[[], float] = time.monotonic
    start: float = field(init=False)
    _parts: list[Part] = field(init=False, default_factory=list)  # the parts after the present one
    _part: Part | None = field(init=False, default=None)  # the present part
    _begun: float = field(init=False, default=0.0)  # time when the part, or its stages after the fits, began
    _share: float = field(init=False, default=0.0)  # share of the part's fits that is done
    _step: int | None = field(init=False, default=None)  # last step of the fit that runs now; None: no fit runs
    _fit: int = field(init=False, default=-1)  # number of the fit within the part, from 0
    _last: float = field(init=False)  # time of the last report
    _seconds: dict[bool, float] = field(init=False)  # measured for fits (True) and for all other stages (False)
    _costs: dict[bool, float] = field(init=False)  # costs that these seconds paid for
    # Stage without parts whose steps are counted, with time and number of its first step
    _counted: tuple[str, float, int] | None = field(init=False, default=None)
    _end: float | None = field(init=False, default=None)  # expected end of work without parts

    def __post_init__(self) -> None:
        self.start = self._last = self.clock()
        self._seconds, self._costs = {True: 0.0, False: 0.0}, {True: 0.0, False: 0.0}

    @property
    def seconds(self) -> float:
        """Seconds since the run began."""
        return self.clock() - self.start

    def expect(self, parts: Iterable[Part]) -> None:
        """Set the parts that follow the present one, replacing earlier expectations."""
        self._parts = list(parts)

    def begin(self) -> None:
        """Begin the next expected part."""
        if self._part is None:  # the work so far has no cost
            self._last = self.clock()
        else:
            self._spend(is_fit=False)
            self._costs[False] += self._part.after + (0.0 if self._share else self._part.before)
        self._part, self._share, self._step = self._parts.pop(0) if self._parts else None, 0.0, None
        self._fit = -1
        self._begun = self.clock()

    def move(self, text: str, done: int, total: int) -> None:
        """Take a report of the run: a stage, or a step as ``"stage: detail"``."""
        stage, _, detail = text.partition(": ")
        if stage == "done":
            self._parts, self._part, self._end = [], Part(), self.clock()
        elif self._part is not None and self._part.fit and stage == FIT and detail:
            self._take_step(self._part, done, total)
        else:
            if self._step is not None:  # the fits have ended
                self._begun, self._step = self.clock(), None
            self._spend(is_fit=False)
            self._count(stage, done, total, is_step=bool(detail) or (stage not in STAGES and total > 0))

    def _take_step(self, part: Part, done: int, total: int) -> None:
        """Take a step of a fit; a lower number than the last one means that the next fit has begun."""
        is_next = self._step is not None and done >= self._step
        if self._fit < 0:
            self._costs[False] += part.before
        self._spend(is_fit=is_next)
        self._fit += not is_next
        share = min(1.0, (self._fit + done / max(total, 1)) / part.num_fits)
        if is_next:
            self._costs[True] += max(0.0, share - self._share) * part.fit
        self._share, self._step = max(share, self._share), done

    def _spend(self, *, is_fit: bool) -> None:
        """Add the time since the last report to the seconds of fits or of other stages."""
        now = self.clock()
        self._seconds[is_fit] += now - self._last
        self._last = now

    def _count(self, stage: str, done: int, total: int, *, is_step: bool) -> None:
        """Forecast the end of work without parts by the mean time per step since the first step of its stage."""
        now = self.clock()
        if self._counted is None or self._counted[0] != stage:
            self._end, self._counted = None, (stage, now, done) if is_step else None
        elif is_step and done > self._counted[2]:
            _, time_before, done_before = self._counted
            self._end = now + (now - time_before) / (done - done_before) * max(0, total - done)

    def _seconds_per_cost(self, *, is_fit: bool) -> float:
        """Return the seconds that a unit of cost has taken so far, in fits or in other stages; 0 if not known."""
        cost = self._costs[is_fit]
        return self._seconds[is_fit] / cost if cost else 0.0

    @property
    def seconds_left(self) -> float | None:
        """Seconds until the run ends; None if they are not known yet."""
        if self._part is None:
            return None if self._end is None else max(0.0, self._end - self.clock())
        part, later = self._part, self._parts
        fit_cost = part.fit * (1 - self._share) + sum(later_part.fit for later_part in later)
        fit_rate = self._seconds_per_cost(is_fit=True)
        stage_rate = self._seconds_per_cost(is_fit=False) or fit_rate
        part_cost = part.after if self._share else part.before + part.after
        later_cost = sum(later_part.before + later_part.after for later_part in later)
        if (fit_cost and not fit_rate) or (part_cost + later_cost > 0 and not stage_rate):
            return None  # not measured yet
        spent = self.clock() - self._begun if self._step is None else 0.0
        return fit_rate * fit_cost + max(0.0, stage_rate * part_cost - spent) + stage_rate * later_cost
