"""The Typer application: build the commands, run one, and turn exceptions into a line and an exit code."""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import lru_cache
from importlib import import_module
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsmerge.cli import INTERRUPTED, stop_at_once
from gsmerge.cli.console import JsonLines, json_progress, plain_warnings, say
from gsmerge.cli.usage import LAB, PROGRAM, Command, Group, UsageErrors, usage_message
from gsmerge.errors import (
    DAMAGED_OPENCV,
    NO_TORCH,
    GsmergeError,
    SceneError,
    UsageError,
    error_line,
    file_problem,
    is_opencv_damaged,
    is_out_of_memory,
    is_torch_missing,
)
from gsmerge.runtime.plugins import COMMANDS as PLUGINS
from gsmerge.runtime.plugins import find_plugins, load_plugin
from gsmerge.version import __version__

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

DEBUG = "--debug"

# Panel of the help -> commands. The command NAME is the function NAME of the module NAME_command
COMMAND_GROUPS = {
    "Compact": ("compact", "convert"),
    "Many scenes, and views in batches": ("batch", "extend"),
    "Look and measure": ("inspect", "view", "render", "evaluate"),
}
OWN_COMMANDS = {name for names in COMMAND_GROUPS.values() for name in names}
PLUGIN_PANEL = "Added by other packages"


def make_app(only: str | None = None) -> typer.Typer:
    """Make the application with all commands, or with one command alone, so that no other command is imported."""
    app = typer.Typer(
        name=PROGRAM, cls=Group, pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )  # fmt: skip
    app.callback()(root)
    for panel, names in COMMAND_GROUPS.items():
        for name in names:
            if only in (None, name):
                function = getattr(import_module(f"gsmerge.cli.{name}_command"), name)
                app.command(cls=Command, rich_help_panel=panel)(function)
    if only in OWN_COMMANDS:
        return app
    lab = typer.Typer(
        cls=Group, help="Research: charts of many runs, synthetic scenes, bad conditions, training of networks."
    )
    for name, entry in find_plugins(PLUGINS).items():
        in_lab = _is_research(entry)
        if only in (None, LAB if in_lab else name) and name not in OWN_COMMANDS:
            try:
                function = load_plugin(PLUGINS, name)
            except UsageError as error:  # one broken package must not disable the other commands
                say(str(error), kind="warning")
                continue
            if in_lab:
                lab.command(name, cls=Command)(function)
            else:
                app.command(name, rich_help_panel=PLUGIN_PANEL)(function)
    if only in (None, LAB):
        app.add_typer(lab, name=LAB, rich_help_panel="Research")
    return app


@lru_cache
def make_command(only: str | None = None) -> Any:
    """Make the Click command that parses the words of the command line and runs a command; ``only``: see `make_app`.

    Typer's option that installs completion is removed, because it changes files of the user's shell. The option that
    prints the shell's completion stays.
    """
    command = typer.main.get_command(make_app(only))
    command.params = [param for param in command.params if param.name != "install_completion"]
    return command


def _is_research(entry: EntryPoint) -> bool:
    """Return whether a plugin is a research command of this package, and not a command of another package."""
    return entry.module.startswith("gsmerge.")


def _command_of(words: list[str]) -> str | None:
    """Return the name of the only command to import; None if all are needed, to show the help or an error."""
    name = words[0] if words else ""
    if name in (*OWN_COMMANDS, LAB):
        return name
    entry = find_plugins(PLUGINS).get(name)
    return None if entry is None or _is_research(entry) else name


def _names_scene(word: str) -> bool:
    """Return whether the first word is a scene instead of a command: an existing path, or the name of a scene file."""
    if word.startswith("-") or _command_of([word]) is not None:
        return False
    if os.path.lexists(word) or os.path.dirname(word):
        return True
    from gsmerge.io.formats.table import SCENE_SUFFIXES, STATE_ENDING

    return word.lower().endswith((*SCENE_SUFFIXES, STATE_ENDING))


def __getattr__(name: str) -> Any:
    if name == "app":
        return make_app()
    raise AttributeError(name)


def _print_version(value: bool) -> None:
    if value:
        print(f"{PROGRAM} {__version__}")
        raise typer.Exit


def root(
    _: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
    ] = False,
    __: Annotated[
        bool, typer.Option(DEBUG, help="Print tracebacks of errors; also after the name of a command.")
    ] = False,
) -> None:
    """Compact per-pixel 3D Gaussian scenes: 1 to 10 % of the Gaussians, seconds on a CPU."""


@contextmanager
def _orderly_stop(signals: list[signal.Signals]) -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block as Ctrl-C does, without unfinished files.

    Each signal that arrives is added to ``signals``. Signals that the caller handles or ignores, as under nohup, keep
    their handlers.
    """
    default_handlers = {signal.SIGINT: signal.default_int_handler}
    default_handlers |= {  # Windows has no SIGHUP
        getattr(signal, name): signal.SIG_DFL for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)
    }
    if threading.current_thread() is not threading.main_thread():
        default_handlers = {}  # only the main thread may set handlers
    replaced_handlers = {
        number: handler for number, default in default_handlers.items()
        if (handler := signal.getsignal(number)) in (default, stop_at_once)
    }  # fmt: skip
    replaced_hook = sys.unraisablehook

    def stop(number: int, _: object) -> None:
        """Handle a signal: end the block."""
        if number != signal.SIGINT:
            signals.append(signal.Signals(number))
        raise KeyboardInterrupt

    def raise_again(unraisable: sys.UnraisableHookArgs) -> None:
        """Raise a signal again if it arrived in a library's callback, where no caller can catch KeyboardInterrupt."""
        if unraisable.exc_type is KeyboardInterrupt:
            retry_seconds = 0.02  # delay, after which the callback has ended
            timer = threading.Timer(retry_seconds, signal.raise_signal, (signals[-1] if signals else signal.SIGINT,))
            timer.daemon = True
            timer.start()
        else:
            replaced_hook(unraisable)

    for number in replaced_handlers:
        signal.signal(number, stop)
    sys.unraisablehook = raise_again
    try:
        yield
    finally:
        sys.unraisablehook = replaced_hook
        for number, handler in replaced_handlers.items():
            signal.signal(number, handler)


def run(args: Sequence[str] | None = None) -> int:
    """Run the application and return its exit code; print an error as one line on stderr."""
    arguments = list(sys.argv[1:] if args is None else args)
    words = [word for word in arguments if word != DEBUG]
    as_json = "--progress=json" in words or ("--progress", "json") in pairwise(words)
    json_lines = JsonLines()
    signals: list[signal.Signals] = []  # SIGTERM or SIGHUP, if one arrives

    def print_style() -> AbstractContextManager[None]:
        """Return a block that prints on stderr as JSON with ``--progress json``, otherwise as text."""
        return json_progress(json_lines) if as_json else nullcontext()

    def end_with(message: str, code: int) -> int:
        """Print an error, and return the exit code."""
        if DEBUG in arguments:
            traceback.print_exc()
        with print_style():
            say(message, kind="error")
        return code

    def end_by_signal() -> int:
        """Print that the run was ended by a signal, by default Ctrl-C, and return the exit code."""
        return (
            end_with(f"ended by {signals[0].name}", 128 + signals[0])
            if signals
            else end_with("interrupted", INTERRUPTED)
        )

    try:
        with plain_warnings(), _orderly_stop(signals), print_style():
            try:
                os.getcwd()
            except OSError as error:  # libraries would fail unclearly without the working directory
                reason = f"the working directory cannot be used ({error.strerror})"
                raise SceneError(os.curdir, reason, "change to another one") from error
            words = ["compact", "--open", *words] if words and _names_scene(words[0]) else words
            if words[:1] == ["help"] or words in ([], [LAB]):
                words = [word for word in (*words, "--help") if word != "help"]
            command = make_command(_command_of(words))
            code = command(args=words, prog_name=PROGRAM, standalone_mode=False) or 0
            with suppress(BrokenPipeError):  # the reader of a pipe has closed it
                sys.stdout.flush()
        return end_by_signal() if code == INTERRUPTED else code  # Typer turns Ctrl-C into this code
    except (KeyboardInterrupt, typer.Abort) as error:
        if isinstance(error.__cause__, EOFError) and not signals:
            # Typer assumes that an EOFError means the end of user input, but no command reads user input
            return end_with("unexpected error: EOFError; run again with --debug", 1)
        return end_by_signal()
    except BrokenPipeError:
        return 1
    except Exception as error:
        if signals or isinstance(error.__cause__, KeyboardInterrupt):  # a library has raised it as an error
            return end_by_signal()
        return end_with(*_explain(error))


def _explain(error: Exception) -> tuple[str, int]:
    """Return the message and the exit code for an exception that ends a command."""
    if isinstance(error, GsmergeError):
        return str(error), error.exit_code
    if isinstance(error, UsageErrors):
        return usage_message(error), UsageError.exit_code
    if is_out_of_memory(error) or file_problem(error) is not None:
        return error_line(error, "what was printed"), SceneError.exit_code
    if is_opencv_damaged(error):
        return DAMAGED_OPENCV, 1
    if is_torch_missing(error):
        return NO_TORCH, UsageError.exit_code
    first_line = f"{type(error).__name__}: {error}".splitlines()[0]
    return f"unexpected error: {first_line}; run again with --debug", 1
