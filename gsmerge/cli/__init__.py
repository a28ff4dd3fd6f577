"""The command line, which parses, calls and prints; nothing heavy is imported before a command runs."""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from typing import NoReturn

INTERRUPTED = 130  # exit code
GC_THRESHOLDS = 200_000, 10, 10  # a command imports 115,000 objects: looking for cycles in them takes 30 ms each time


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        args: Arguments without the program's name; those of the process when None.

    Returns:
        0 done, 1 unexpected error, 2 wrong usage, 3 bad input, 4 target not met, 5 part of a batch failed,
        129 ended by SIGHUP, 130 interrupted, 143 ended by SIGTERM.
    """
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # we report damaged images ourselves
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # its threads would spin beside ours
    gc.set_threshold(*GC_THRESHOLDS)
    _open_streams()
    try:
        from gsmerge.cli.app import run

        return run(args)
    except Exception as error:  # a library that is needed is broken, or explaining an error failed
        if "--debug" in (sys.argv[1:] if args is None else args):
            traceback.print_exc()
        problem = f"unexpected error: {type(error).__name__}: {error}".splitlines()[0] + "; run again with --debug"
        if isinstance(error, ModuleNotFoundError):  # of sources that nobody installed
            problem = f"{error.name} is not installed, which this needs: pip install -e the folder of the project"
        print(f"gsmerge: error: {problem}", file=sys.stderr)
        return 1


def _open_streams() -> None:
    """Make sure that stdout and stderr exist and accept any character, since file names may have any.

    A descriptor from 0 to 2 that the caller closed becomes the null device: the next file would take its place, and a
    process of a batch writes to it.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest that is free
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the caller
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - as long as the process
        reconfigure = getattr(getattr(sys, name), "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="backslashreplace")


def stop_at_once(*_: object) -> NoReturn:
    """End the process with a line, as the handler of SIGINT while there is nothing to clean up, such as in imports."""
    with suppress(OSError):
        os.write(2, b"gsmerge: error: interrupted\n")
    os._exit(INTERRUPTED)


def program() -> NoReturn:
    """Run :func:`main` as the installed program, and end the process.

    Exit handlers run and output is flushed. The interpreter is not shut down, which would take time with gigabytes of
    arrays.
    """
    if signal.getsignal(signal.SIGINT) == signal.default_int_handler:
        signal.signal(signal.SIGINT, stop_at_once)
    code = main()
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # the command has said so, or whoever read its output has seen enough
            stream.flush()
    os._exit(code)
