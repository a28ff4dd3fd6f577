"""Record what a run does: the seconds of each stage, choices, notes for the user, and progress.

A run begins a record with :func:`record_run`. Code within the run, on the same thread, writes to this record with
:func:`stage`, :func:`note` and :func:`record_choices`, so the record is no argument of any function. Outside a run,
calls of :func:`stage`, :func:`note` and :func:`record_choices` write nothing.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from gsmerge.runtime.memory import release_memory

Progress = Callable[[str, int, int], None]  # takes the name of the stage, the number of steps done, and of all steps
STAGES = (
    "partition", "prepare", "segment", "curve", "reduce", "members", "encode", "match", "refine",
    "decode", "join", "fit", "prune", "fill", "score", "input",
)  # fmt: skip
FIT_STEP = "fit: "  # texts that report steps of a fit begin with this text
BEFORE_FIT = 0.8  # share of the work of the stages without fits that is done before the fits
# After these stages memory is released, because their threads have freed much memory that other threads cannot use
RELEASED = ("prepare", "segment", "encode", "match", "refine", "fit")


class RunPart(NamedTuple):
    """A part of a run, with its expected work in steps of a fit; only the ratios between all parts matter."""

    name: str
    stages: float  # Work of the stages without the fit
    steps: float = 0.0  # Steps of the fit

    @property
    def work(self) -> float:
        """Expected work of the whole part."""
        return self.stages + self.steps


@dataclass
class Forecast:
    """Estimates the share of a run that is done, by the expected work of its parts and the steps of its fits."""

    parts: list[RunPart] = field(default_factory=list)  # The parts that are expected after the present one
    part: RunPart | None = None  # The present part
    done: float = 0.0  # Expected work of the parts that have ended
    done_of_part: float = 0.0  # Expected work of the finished share of the present part

    def begin(self, name: str) -> None:
        """End the present part, and begin the next part of this name, without the parts before it."""
        if self.part is not None:
            self.done += self.part.work
        names = [part.name for part in self.parts]
        # of more parts than were expected
        self.part = RunPart(name, 0.0)
        self.done_of_part = 0.0
        if name in names:
            self.part = self.parts[names.index(name)]
            del self.parts[: names.index(name) + 1]

    def take_step(self, step: int, num_steps: int) -> None:
        """Update the estimate of the finished share when a fit has reached step ``step`` of ``num_steps``."""
        if self.part is not None:
            done = BEFORE_FIT * self.part.stages + step / max(num_steps, 1) * self.part.steps
            self.done_of_part = max(self.done_of_part, done)  # a part may have more fits than were expected

    @property
    def share(self) -> float | None:
        """Share of the run that is done; None if no part is expected."""
        total = self.done + sum(part.work for part in self.parts) + (0.0 if self.part is None else self.part.work)
        return (self.done + self.done_of_part) / total if total else None


@dataclass
class Record:
    """What a run, or a part of it, has recorded so far."""

    progress: Progress | None = None  # Called at every report of progress
    seconds: dict[str, float] = field(default_factory=dict)  # Wall time of each stage
    choices: dict[str, Any] = field(default_factory=dict)  # Decisions of the stages, by name
    notes: list[str] = field(default_factory=list)  # Warnings and adaptations, each once
    running: str | None = None  # The stage that is being timed
    forecast: Forecast = field(default_factory=Forecast)  # Shared by the records of a run and its parts


_current: ContextVar[Record | None] = ContextVar("record", default=None)


@contextmanager
def record_run(progress: Progress | None = None) -> Iterator[Record]:
    """Start a record to which all code in the block writes. After the block, ``progress`` is called with "done"."""
    with _write_to(Record(progress)) as record:
        yield record
        report_progress("done", len(STAGES), len(STAGES))


def current_record() -> Record:
    """Return the record of the current run; outside a run, return an empty one."""
    return _current.get() or Record()


@contextmanager
def record_part(*, silent: bool = False, title: str | None = None) -> Iterator[Record]:
    """Start a separate record for a part of the current run, to which all code in the block writes.

    If ``silent`` is true, the progress of the part is not reported. In reports of progress, ``title`` is put before the
    names of the part's stages, as if these stages were steps of one stage.
    """
    progress = None if silent else current_record().progress
    if progress is not None and title is not None:
        progress = _titled(progress, title)
    with _write_to(Record(progress, forecast=current_record().forecast)) as record:
        yield record


def _titled(progress: Progress, title: str) -> Progress:
    """Return a progress function that puts a title before each text."""
    return lambda text, done, total: progress(f"{title}: {text}", done, total)


@contextmanager
def _write_to(record: Record) -> Iterator[Record]:
    """Make ``record`` the current record within the block."""
    token = _current.set(record)
    try:
        yield record
    finally:
        _current.reset(token)


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Report the progress of a stage, and record the seconds of the block, or of the decorated function.

    A stage within another stage is neither reported nor recorded, because its time counts for the outer stage. The
    place of ``name`` in ``STAGES`` is reported. A name that is not there has the place after the last finished stage.
    """
    record = _current.get()
    if record is None or record.running is not None:
        yield
        return
    if name not in record.seconds:  # if a stage continues after a break, this is not a new step
        finished = [STAGES.index(other) for other in record.seconds if other in STAGES]
        place = STAGES.index(name) if name in STAGES else max(finished, default=-1) + 1
        report_progress(name, place, len(STAGES))
    record.running, start = name, time.perf_counter()
    try:
        yield
    finally:
        record.running = None
        if name in RELEASED:
            release_memory()
        add_seconds({name: time.perf_counter() - start})


def list_some(items: Sequence[str], separator: str = ", ") -> str:
    """Join the first items to a text for a note, with the number of items that are left out."""
    max_named = 4  # largest number of items that a note lists
    rest = f" and {len(items) - max_named} more" if len(items) > max_named else ""
    return separator.join(items[:max_named]) + rest


def list_faults(faults: Sequence[str]) -> str:
    """Join faults, each the name of a photo and a reason, to a text that says each reason once."""
    reasons = dict[str, list[str]]()
    for fault in faults:
        photo, _, reason = fault.partition(": ")
        reasons.setdefault(reason, []).append(photo)
    return list_some([f"{list_some(names)}: {reason}" for reason, names in reasons.items()], "; ")


def note(text: str) -> None:
    """Add a note or a :class:`Doubt` to the current record and to the package's log, unless it is in the record."""
    record = current_record()
    if text not in record.notes:
        record.notes.append(text)
        logging.getLogger("gsmerge").info(text)


def record_choices(**choices: Any) -> None:
    """Add decisions of a stage to the current record, by name."""
    current_record().choices.update(choices)


def add_seconds(seconds: Mapping[str, float]) -> None:
    """Add the wall time of stages to the current record, by name."""
    record = current_record()
    for name, stage_seconds in seconds.items():
        record.seconds[name] = record.seconds.get(name, 0.0) + stage_seconds


def adopt(part: Record) -> None:
    """Copy the choices and notes of a part's record into the current record."""
    record = current_record()
    record.choices |= part.choices
    record.notes += [text for text in part.notes if text not in record.notes]


def expect_parts(parts: Iterable[RunPart]) -> None:
    """Replace the parts that the current run expects after its present part."""
    current_record().forecast.parts = [*parts]


def begin_part(name: str) -> None:
    """Begin the next part of this name in the forecast of the current run."""
    current_record().forecast.begin(name)


def report_progress(text: str, done: int, total: int) -> None:
    """Report to the caller of the current run that ``done`` of ``total`` steps are done.

    ``text`` is the name of a stage. For a step within a stage, ``text`` is ``"stage: detail"``.
    """
    record = current_record()
    if text.startswith(FIT_STEP):
        record.forecast.take_step(done, total)
    if record.progress is not None:
        record.progress(text, done, total)
