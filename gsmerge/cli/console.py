"""What the command line says on stderr: status lines, progress bars, warnings. Data goes to stdout."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

Progress = Callable[[str, int, int], None]

MAX_LINE = 5000  # characters


def one_line(text: str) -> str:
    """Text from files or names as one line that does nothing to a terminal: what cannot be printed is escaped."""
    clean = text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
    return clean if len(clean) <= MAX_LINE else f"{clean[: MAX_LINE // 2]} ... {clean[-MAX_LINE // 2 :]}"


def say(message: str, *, quiet: bool = False) -> None:
    """Print one status line on stderr unless ``quiet``; that nobody can read it is no reason to stop."""
    if not quiet:
        with suppress(OSError):
            print(one_line(message), file=sys.stderr, flush=True)


def say_notes(notes: Sequence[str], *, quiet: bool = False) -> None:
    """Print a line on stderr for each note about the input or the run, unless ``quiet``."""
    for note in notes:
        say(f"note: {note}", quiet=quiet)


def print_document(
    document: Mapping[str, Any], lines: Sequence[str] | str, *, as_json: bool, quiet: bool = False
) -> None:
    """Print the result of a command on stdout: the document as JSON, or lines for people unless ``quiet``."""
    from gsmerge.report import to_json

    if as_json:
        sys.stdout.write(to_json(document))
    elif not quiet:
        print("\n".join(map(one_line, [lines] if isinstance(lines, str) else lines)))


@contextmanager
def plain_warnings() -> Iterator[None]:
    """Warnings as one line each, without the place in the code that raised them."""

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        say(f"gsmerge: warning: {message}")

    with warnings.catch_warnings():
        warnings.showwarning = show
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


def _terminal(*, quiet: bool) -> Any:
    """Rich's console on stderr; None when quiet or where stderr is no terminal."""
    if quiet:
        return None
    from rich.console import Console

    console = Console(stderr=True)
    return console if console.is_terminal else None


@contextmanager
def stage_progress(*, quiet: bool) -> Iterator[Progress]:
    """A progress bar per stage on stderr, unless quiet or where stderr is no terminal.

    ``FORCE_COLOR`` in the environment makes anything a terminal.

    Yields:
        ``(stage, done, total) -> None``.
    """
    console = _terminal(quiet=quiet)
    if console is None:
        yield lambda stage, done, total: None
        return
    from rich import progress as rich

    columns = (
        rich.TextColumn("{task.description:>12}"), rich.BarColumn(), rich.MofNCompleteColumn(),
        rich.TimeElapsedColumn(), rich.TextColumn("{task.fields[detail]}"),
    )  # fmt: skip
    with rich.Progress(*columns, console=console, transient=True, refresh_per_second=5) as bars:
        tasks: dict[str, Any] = {}

        def move(stage: str, done: int, total: int) -> None:
            name, _, detail = stage.partition(": ")
            if name not in tasks:
                tasks[name] = bars.add_task(name, total=total, detail="")
            bars.update(tasks[name], completed=done, total=total, detail=detail)

        yield move


@contextmanager
def total_progress(total: int, *, quiet: bool) -> Iterator[Progress]:
    """One bar for many runs on stderr: done of total, time left; a line per run where there is no terminal.

    Yields:
        ``(text, done, total) -> None``.
    """
    console = _terminal(quiet=quiet)
    if console is None:
        yield lambda text, done, total: say(f"{done}/{total} {text}", quiet=quiet)
        return
    from rich import progress as rich

    columns = (
        rich.BarColumn(), rich.MofNCompleteColumn(), rich.TimeElapsedColumn(), rich.TextColumn("left"),
        rich.TimeRemainingColumn(), rich.TextColumn("{task.description}"),
    )  # fmt: skip
    with rich.Progress(*columns, console=console, transient=True) as bars:
        task = bars.add_task("", total=total)
        yield lambda text, done, total: bars.update(task, completed=done, total=total, description=one_line(text))


def duration(seconds: float) -> str:
    """``95`` -> ``95 s``, ``600`` -> ``10 min``, ``9000`` -> ``2.5 h``."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
