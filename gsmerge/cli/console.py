"""What the command line says on stderr: status lines, progress bars, warnings. Data goes to stdout."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

Progress = Callable[[str, int, int], None]

MAX_LINE = 5000  # characters


def one_line(text: str) -> str:
    """Text from files or names as one line that does nothing to a terminal: what cannot be printed is escaped."""
    clean = text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
    return clean if len(clean) <= MAX_LINE else f"{clean[: MAX_LINE // 2]} ... {clean[-MAX_LINE // 2 :]}"


def say(message: str, *, quiet: bool = False) -> None:
    """Print one status line on stderr unless ``quiet``."""
    if not quiet:
        print(one_line(message), file=sys.stderr, flush=True)


def say_notes(notes: Sequence[str], *, quiet: bool = False) -> None:
    """Print what the reader or the work had to say, a line each, unless ``quiet``."""
    for note in notes:
        say(f"note: {note}", quiet=quiet)


def show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    """Stand-in for :func:`warnings.showwarning` that prints the message alone."""
    say(f"gsmerge: warning: {message}")


@contextmanager
def plain_warnings() -> Iterator[None]:
    """Warnings as one line each, without the place in the code that raised them."""
    with warnings.catch_warnings():
        warnings.showwarning = show_warning
        yield


@contextmanager
def announce_compilation(*, quiet: bool, share: bool = False) -> Iterator[Callable[[], None]]:
    """A block that says so, once, when a kernel has to be compiled (the first run after installation).

    Args:
        quiet: Say nothing.
        share: Let a second process compile the kernels of the fit in the meantime.

    Yields:
        What waits for the second process; to be called before the fit, which would compile the same again.
    """
    from gsmerge.kernels.compilation import watch_compilation

    second: list[subprocess.Popen[bytes]] = []

    def begin() -> None:
        say("compiling kernels for their first use, up to 30 s", quiet=quiet)
        if share and (os.cpu_count() or 1) > 1:
            silent = subprocess.DEVNULL
            command = [sys.executable, "-m", "gsmerge.stages.fit.warm"]
            second.append(subprocess.Popen(command, stdin=silent, stdout=silent, stderr=silent))

    def finish() -> None:
        for process in second:
            process.wait()

    with watch_compilation(begin):
        try:
            yield finish
        finally:
            for process in second:
                process.terminate()
                process.wait()


@contextmanager
def stage_progress(*, quiet: bool) -> Iterator[Progress | None]:
    """A progress bar per stage on stderr; yields the callable that moves it.

    Yields:
        ``(stage, done, total) -> None``, or None when quiet or when stderr is no terminal (``FORCE_COLOR`` set
        in the environment counts as one).
    """
    if quiet:
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield None
        return
    columns = (
        TextColumn("{task.description:>12}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[detail]}"),
    )
    with Progress(*columns, console=console, transient=True, refresh_per_second=5) as bars:
        tasks: dict[str, Any] = {}

        def move(stage: str, done: int, total: int) -> None:
            name, _, detail = stage.partition(": ")
            if name not in tasks:
                tasks[name] = bars.add_task(name, total=total, detail="")
            bars.update(tasks[name], completed=done, total=total, detail=detail)

        yield move


@contextmanager
def total_progress(total: int, *, quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """One bar for many runs on stderr: done of total, time left; a line per run where there is no terminal.

    Yields:
        ``(what, done, total) -> None``.
    """
    if quiet:
        yield lambda what, done, total: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda what, done, total: say(f"{done}/{total} {what}")
        return
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    with Progress(*columns, TextColumn("{task.description}"), console=console, transient=True) as bars:
        task = bars.add_task("", total=total)
        yield lambda what, done, total: bars.update(task, completed=done, total=total, description=one_line(what))


def duration(seconds: float) -> str:
    """``95`` -> ``95 s``, ``600`` -> ``10 min``, ``9000`` -> ``2.5 h``."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
