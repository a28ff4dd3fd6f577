"""The typer application, and the one place that turns exceptions into a line and an exit code."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from gsmerge import __version__
from gsmerge.cli.batch import batch
from gsmerge.cli.chart import chart
from gsmerge.cli.compact import compact
from gsmerge.cli.console import one_line, plain_warnings
from gsmerge.cli.decode import decode
from gsmerge.cli.encode import encode
from gsmerge.cli.evaluate import evaluate
from gsmerge.cli.extend import extend
from gsmerge.cli.generate import generate
from gsmerge.cli.inspect import inspect
from gsmerge.cli.options import debug_wanted, set_debug
from gsmerge.cli.preview import preview
from gsmerge.cli.render import render
from gsmerge.cli.report import report
from gsmerge.cli.segment import segment
from gsmerge.cli.stress import stress
from gsmerge.cli.train import train
from gsmerge.errors import DAMAGED_OPENCV, GsmergeError, is_opencv_damaged

PROGRAM = "gsmerge"
INTERRUPTED = 130

app = typer.Typer(
    name=PROGRAM, pretty_exceptions_enable=False, context_settings={"help_option_names": ["-h", "--help"]}
)
COMMANDS = (
    compact, batch, encode, decode, extend, evaluate, inspect, segment, render, preview, report, stress, chart,
    generate, train,
)  # fmt: skip
for command in COMMANDS:
    app.command()(command)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"{PROGRAM} {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def root(
    context: typer.Context,
    _: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Compact per-pixel 3D Gaussian scenes: 1 to 10 % of the Gaussians, seconds on a CPU."""
    if context.invoked_subcommand is None:
        print(context.get_help())


def _fail(message: str, code: int) -> int:
    if debug_wanted():
        traceback.print_exc()
    print(one_line(f"{PROGRAM}: error: {message}"), file=sys.stderr)
    return code


def _usage_message(error: Any) -> str:
    context = error.ctx
    place = context.command_path if context is not None else PROGRAM
    told = error.format_message().replace("Value error, ", "", 1)  # of the checks that typer borrows
    return f"{told.rstrip('.')}; see '{place} --help'"


def run(args: Sequence[str] | None = None) -> int:
    """Run the application; every error becomes one line on stderr and an exit code."""
    set_debug(False)
    try:
        with plain_warnings():
            code = app(args=args, prog_name=PROGRAM, standalone_mode=False) or 0
        return _fail("interrupted", code) if code == INTERRUPTED else code  # typer turns Ctrl-C into this code
    except GsmergeError as error:
        return _fail(str(error), error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        return _fail("interrupted", INTERRUPTED)
    except MemoryError:
        return _fail("out of memory; use a smaller scene or fewer --threads", 1)
    except Exception as error:
        if isinstance(error, _UsageErrors):
            return _fail(_usage_message(error), 2)
        if is_opencv_damaged(error):
            return _fail(DAMAGED_OPENCV, 1)
        told = f"{type(error).__name__}: {error}".splitlines()[0]
        return _fail(f"unexpected error: {told}; run again with --debug", 1)


# typer keeps its usage errors to itself; BadParameter, which it exports, derives from their common base
_UsageErrors = typer.BadParameter.__mro__[2]
