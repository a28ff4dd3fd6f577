"""Print status lines, progress bars and warnings on stderr, and data on stdout."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from gsmerge.errors import Doubt, list_doubts, name_notes

if TYPE_CHECKING:
    from gsmerge.runtime.record import Progress

Kind = Literal["info", "note", "warning", "error"]  # of a line on stderr
PREFIXES: Mapping[Kind, str] = {
    "info": "", "note": "note: ", "warning": "gsmerge: warning: ", "error": "gsmerge: error: ",
}  # fmt: skip


@dataclass
class JsonLines:
    """Progress as lines of JSON on stderr."""

    start: float = field(default_factory=time.monotonic)
    share: float | None = None  # of the run that is done; None: unknown
    first: tuple[float, float] | None = None  # seconds since the start, and share, when the share was first known

    def print(self, event: Mapping[str, Any]) -> None:
        """Print an event with the seconds since the start, the share that is done and the seconds left."""
        share = self.share
        left = self.seconds_left
        numbers = {"share": None if share is None else round(share, 3), "seconds": round(self.seconds, 2)}
        numbers["seconds_left"] = None if left is None else round(left, 1)
        with suppress(OSError):
            print(json.dumps({**event, **numbers}), file=sys.stderr, flush=True)

    def move(self, share: float | None) -> None:
        """Set the share that is done, if it is known and not smaller than before."""
        if share is not None:
            self.share = max(self.share or 0.0, share)
            self.first = self.first or (self.seconds, self.share)

    @property
    def seconds_left(self) -> float | None:
        """Seconds until the run ends, if its mean speed since the share was first known stays the same.

        None if the share is not known, or has not grown since it was first known.
        """
        if self.share == 1:
            return 0.0
        first_seconds, first_share = self.first or (0.0, 1.0)
        if self.share is None or self.share <= first_share:
            return None
        return (self.seconds - first_seconds) * (1 - self.share) / (self.share - first_share)

    @property
    def seconds(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self.start


_json_lines: ContextVar[JsonLines | None] = ContextVar("json_lines", default=None)  # None: progress is not JSON


def one_line(text: str) -> str:
    """Escape the characters of a text that no terminal prints, such as line breaks, and shorten it if it is long."""
    clean = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
    max_line = 5000  # characters
    return clean if len(clean) <= max_line else f"{clean[: max_line // 2]} ... {clean[-max_line // 2 :]}"


def say(message: str, *, kind: Kind = "info", quiet: bool = False) -> None:
    """Print a message as one line on stderr unless ``quiet``; a closed stderr is ignored.

    Notes, warnings and errors begin with their kind. A terminal wraps the line between words. With ``--progress json``
    the line is a JSON object, whose key is the kind. This object is printed even if ``quiet``.
    """
    json_lines = _json_lines.get()
    if json_lines is not None:
        json_lines.print({kind: one_line(message)})
    elif not quiet:
        from gsmerge.runtime.documents import wrap_line

        text = one_line(PREFIXES[kind] + message)
        with suppress(OSError):
            print("\n".join(wrap_line(text, terminal_columns(sys.stderr))), file=sys.stderr, flush=True)


def say_notes(notes: Sequence[str], *, quiet: bool = False) -> None:
    """Print each note on stderr unless ``quiet``; doubts are warnings."""
    for note in notes:
        say(note, kind="warning" if isinstance(note, Doubt) else "note", quiet=quiet)


def terminal_columns(stream: Any) -> int | None:
    """Return the width of a stream's terminal in columns; None if the stream is not a terminal."""
    return shutil.get_terminal_size().columns if stream.isatty() else None


def print_document(
    document: Mapping[str, Any], lines: Sequence[str] | str, *, as_json: bool, quiet: bool = False, wrap: bool = True
) -> None:
    """Print a result on stdout: the document as JSON or, unless ``quiet``, the lines of text.

    ``wrap``: lines that are longer than the terminal is wide are broken between words.
    """
    from gsmerge.runtime.documents import to_json, wrap_line

    if as_json:
        sys.stdout.write(to_json(document))
    elif not quiet:
        columns = terminal_columns(sys.stdout) if wrap else None
        for line in [lines] if isinstance(lines, str) else lines:
            print("\n".join(wrap_line(one_line(line), columns)))


@contextmanager
def plain_warnings() -> Iterator[None]:
    """Print each warning in the block on one line, without file and line number.

    NumPy's warnings about numbers give one note together.
    """
    has_numeric_note = False

    def show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        nonlocal has_numeric_note
        if not issubclass(category, RuntimeWarning):
            say(str(message), kind="warning")
        elif not has_numeric_note:
            say(f"some numbers are too large or undefined ({message})", kind="note")
            has_numeric_note = True

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


def _terminal(*, quiet: bool) -> Any:
    """Open Rich's console on stderr; return None if ``quiet``, or if stderr is not a terminal."""
    if quiet:
        return None
    from rich.console import Console

    console = Console(stderr=True)
    # On Ctrl-C the terminal prints ^C after the bar. The bar leaves room for ^C, which would otherwise wrap to a new
    # line
    console.width = max(20, console.width - len("^C") - 1)
    return console if console.is_terminal else None


@contextmanager
def json_progress(lines: JsonLines | None = None) -> Iterator[None]:
    """Print progress in the block as lines of JSON on stderr, even with ``--quiet``; continue ``lines`` if given."""
    token = _json_lines.set(lines or JsonLines())
    try:
        yield
    finally:
        _json_lines.reset(token)


def _share_done(text: str, done: int, total: int) -> float | None:
    """Return the share of a run that is done when it reports progress; None if the share is not known.

    The record of the run forecasts the share. Without a forecast, it is the share of the stage's steps that are done,
    if the stage counts its steps.
    """
    from gsmerge.runtime.record import STAGES, current_record

    if text == "done":
        return 1.0
    share = current_record().forecast.share
    return done / total if share is None and total and text not in STAGES else share


@contextmanager
def stage_progress(*, quiet: bool) -> Iterator[Progress]:
    """Show a progress bar of a run on stderr, if it is a terminal (or ``FORCE_COLOR`` is set) and not ``quiet``.

    Yields a function of ``(stage, done, total)``. The bar shows the stage, and the time left if the run keeps its
    speed.
    """
    json_lines, console = _json_lines.get(), _terminal(quiet=quiet)
    if json_lines is not None:

        def print_json(text: str, done: int, total: int) -> None:
            """Print a step of the run as a line of JSON."""
            stage, _, detail = one_line(text).partition(": ")
            json_lines.move(_share_done(text, done, total))
            json_lines.print({"stage": stage, "detail": detail, "done": done, "total": total})

        yield print_json
    elif console is None:
        yield lambda stage, done, total: None
    else:
        from rich import progress as rich
        from rich.table import Column

        text_column = Column(no_wrap=True, overflow="ellipsis")
        least_columns = 60  # narrower terminals get shorter bars with less text
        is_wide = console.width >= least_columns
        columns = [rich.BarColumn(16 if is_wide else 8), rich.TimeRemainingColumn(compact=True)]
        columns += [rich.TimeElapsedColumn()] if is_wide else []
        columns += [rich.TextColumn("{task.description}", markup=False, table_column=text_column)]
        with rich.Progress(*columns, console=console, transient=True, refresh_per_second=5) as bars:
            task = bars.add_task("", total=None)

            def move_bar(text: str, done: int, total: int) -> None:
                share = _share_done(text, done, total)
                is_stage = ": " not in text
                total_share = None if share is None else 1.0
                bars.update(task, description=one_line(text), completed=share, total=total_share, refresh=is_stage)

            yield move_bar


@contextmanager
def separate_stdout(engine: str, *, quiet: bool) -> Iterator[None]:
    """Keep stdout free for data: in the block, Ray's messages go to stderr, or nowhere if ``quiet``."""
    if engine != "ray":
        yield
        return
    with open(os.devnull, "w", encoding="utf-8") as null_device, redirect_stdout(null_device if quiet else sys.stderr):
        yield


class RunEnd(NamedTuple):
    """Facts about one of many runs, when it ends."""

    name: str
    status: str
    done: int  # Runs that have ended
    failure: str  # Empty after a run that succeeded
    num_failed: int  # Runs that have failed
    share: float  # Part of the work done so far, 0 to 1
    notes: Sequence[str] = ()  # Printed only as JSON

    @property
    def text(self) -> str:
        """Name and status of the run, and the number of failures so far."""
        ending = {"skipped": "skipped, since it was done before"}.get(self.status, self.status)
        ending += ", doubtful" if list_doubts(self.notes) else ""
        return f"{self.name} {ending}{f', {self.num_failed} failed' if self.num_failed and not self.failure else ''}"


RunProgress = Callable[[RunEnd], None]


@contextmanager
def total_progress(total: int, *, quiet: bool) -> Iterator[RunProgress]:
    """Show one bar for many runs on stderr, with the time left, and print the name of each run that failed.

    Without a terminal a line is printed for each run. Why runs failed is printed once, after the last one. Yields a
    function to call at the end of each run.
    """
    json_lines = _json_lines.get()
    console = _terminal(quiet=quiet or json_lines is not None)
    if json_lines is not None:
        json_lines.move(0.0)

        def print_json(end: RunEnd) -> None:
            """Print the end of a scene of a batch as a line of JSON."""
            say_notes(name_notes(end.name, end.notes))
            json_lines.move(end.share)
            event = {"scene": end.name, "status": end.status, "done": end.done, "total": total}
            event |= {"failed": end.num_failed, "doubts": list_doubts(end.notes), "error": end.failure or None}
            json_lines.print(event)

        yield print_json
    elif console is None:

        def print_line(end: RunEnd) -> None:
            say(f"{end.done}/{total} {end.text}", quiet=quiet)

        yield print_line
    else:
        from rich import progress as rich

        columns = (
            rich.BarColumn(16), rich.MofNCompleteColumn(), rich.TimeElapsedColumn(), rich.TextColumn("left"),
            rich.TimeRemainingColumn(), rich.TextColumn("{task.description}", markup=False),
        )  # fmt: skip
        with rich.Progress(*columns, console=console, transient=True, refresh_per_second=5) as bars:
            task = bars.add_task("", total=total)

            def move_bar(end: RunEnd) -> None:
                bars.update(task, completed=end.done, description=one_line(end.text))
                if end.failure:
                    bars.console.print(one_line(end.text), markup=False, highlight=False)

            yield move_bar
