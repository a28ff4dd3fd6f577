"""The Typer application, and the one place that turns exceptions into a line and an exit code."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated, Any

import typer

from gsmerge import __version__
from gsmerge.cli.console import one_line, plain_warnings
from gsmerge.cli.options import renamed
from gsmerge.errors import DAMAGED_OPENCV, GsmergeError, is_opencv_damaged

PROGRAM = "gsmerge"
INTERRUPTED = 130

# Panel of the help -> commands, each the function of its name in the module of its name
COMMANDS = {
    "Compact": ("compact",),
    "Many scenes, and encoding once": ("batch", "encode", "decode", "extend"),
    "Look and measure": ("inspect", "view", "preview", "render", "segment", "evaluate", "report"),
    "Research": ("stress", "chart", "generate", "train"),
}


def make_app(only: str | None = None) -> typer.Typer:
    """The application with all commands, or with one alone, which imports no other."""
    made = typer.Typer(
        name=PROGRAM, pretty_exceptions_enable=False, context_settings={"help_option_names": ["-h", "--help"]}
    )
    made.callback(invoke_without_command=True)(root)
    for panel, names in COMMANDS.items():
        for name in names:
            if only in (None, name):
                function = getattr(import_module(f"gsmerge.cli.{name}"), name)
                made.command(rich_help_panel=panel)(function)
    return made


def __getattr__(name: str) -> Any:
    if name == "app":
        return make_app()
    raise AttributeError(name)


def _print_version(value: bool) -> None:
    if value:
        print(f"{PROGRAM} {__version__}")
        raise typer.Exit


def root(
    context: typer.Context,
    _: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Compact per-pixel 3D Gaussian scenes: 1 to 10 % of the Gaussians, seconds on a CPU."""
    if context.invoked_subcommand is None:
        print(context.get_help())


def _usage_message(error: Any) -> str:
    """One line about wrong usage, where possible with the new name of an option that was renamed."""
    place = PROGRAM if error.ctx is None else error.ctx.command_path
    message = renamed(getattr(error, "option_name", ""), place.rpartition(" ")[2])
    message = message or error.format_message().replace("Value error, ", "", 1)  # a prefix of checks inside Typer
    return f"{message.rstrip('.')}; see '{place} --help'"


def run(args: Sequence[str] | None = None) -> int:
    """Run the application; every error becomes one line on stderr and an exit code."""
    words = list(sys.argv[1:] if args is None else args)

    def fail(message: str, code: int) -> int:
        if "--debug" in words:
            traceback.print_exc()
        print(one_line(f"{PROGRAM}: error: {message}"), file=sys.stderr)
        return code

    known = any(words[:1] == [name] for names in COMMANDS.values() for name in names)
    try:
        with plain_warnings():
            app = make_app(words[0] if known else None)
            code = app(args=words, prog_name=PROGRAM, standalone_mode=False) or 0
        return fail("interrupted", code) if code == INTERRUPTED else code  # Typer turns Ctrl-C into this code
    except GsmergeError as error:
        return fail(str(error), error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        return fail("interrupted", INTERRUPTED)
    except MemoryError:
        return fail("out of memory; use a smaller scene or fewer --threads", 1)
    except Exception as error:
        if isinstance(error, _UsageErrors):
            return fail(_usage_message(error), 2)
        if is_opencv_damaged(error):
            return fail(DAMAGED_OPENCV, 1)
        first = f"{type(error).__name__}: {error}".splitlines()[0]
        return fail(f"unexpected error: {first}; run again with --debug", 1)


# Typer does not export its usage errors; BadParameter, which it exports, derives from their common base
_UsageErrors = typer.BadParameter.__mro__[2]
