"""The record of a run: seconds by stage, choices, notes for the user, and progress."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

from gsmerge.runtime.memory import release_memory

Progress = Callable[[str, int, int], None]
# stages that leave much behind that was freed in other threads
RELEASED = ("prepare", "segment", "encode", "robust", "match", "refine", "close", "choose", "fit")
STAGES = (
    "prepare", "segment", "curve", "reduce", "members", "encode", "robust", "match", "refine", "close",
    "cover", "decode", "choose", "join", "fit", "score", "input",
)  # fmt: skip


@dataclass
class RunLog:
    """Clock and record of one run."""

    progress: Progress | None = None  # Called with (stage, done, total)
    seconds: dict[str, float] = field(default_factory=dict)  # Wall time of each stage
    choices: dict[str, Any] = field(default_factory=dict)  # What the stages decided
    notes: list[str] = field(default_factory=list)  # Things worth telling, one sentence each
    viewmats: Any = None  # [v,4,4] canonical poses of the prepared views where the fit moved them

    def fit_progress(self, step: int, steps: int, photos: float, held_out: float) -> None:
        """One step of the fit is done."""
        if self.progress:
            self.progress(f"fit: photos {photos:.1f} dB, held out {held_out:.1f} dB", step, steps)

    def add_fit(self, report: Any) -> None:
        """What a fit did (a dataclass with ``accepted``); None: nothing was asked for."""
        if report is None:
            return
        self.choices["fit"] = asdict(report)
        self.viewmats = self.choices["fit"].pop("viewmats", None)
        if not report.accepted:
            self.notes.append("the fit was not accepted: held-out parts of the photos did not get better")

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """A block whose time counts as that of a stage."""
        if self.progress:
            self.progress(name, STAGES.index(name), len(STAGES))
        start = time.perf_counter()
        yield
        if name in RELEASED:
            release_memory()
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
