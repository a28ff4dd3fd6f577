"""The command line: parse options, call the library, print results. Heavy imports wait until a command runs."""

from __future__ import annotations

import atexit
import ctypes
import gc
import os
import shutil
import signal
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from typing import NoReturn

INTERRUPTED = 130  # exit code
# Parameters of glibc with their values, see mallopt(3). An array of 32 MiB or more gets separate pages, which return to
# the system when the array is deleted. The process keeps up to 256 MiB of the memory of deleted smaller arrays for new
# arrays. With glibc's default values, the system clears new pages for each array: `view` then has 2.3 times the page
# faults, at the same peak of memory
M_MMAP_THRESHOLD = (-3, 1 << 25)
M_TRIM_THRESHOLD = (-1, 1 << 28)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        args: Arguments without the program's name; None: those of the process.

    Returns:
        0 done, 1 unexpected error, 2 wrong usage, 3 bad input, 4 target not met, 5 part of a batch failed,
        129 ended by SIGHUP, 130 interrupted, 143 ended by SIGTERM.
    """
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # gsmerge reports damaged images itself
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads of OpenBLAS would spin beside the threads of gsmerge
    gc_thresholds = 200_000, 10, 10  # more than the 115,000 imported objects, where a search for cycles takes 30 ms
    gc.set_threshold(*gc_thresholds)
    # If the caller closed descriptor 0, 1 or 2, it becomes the null device. If the descriptor stayed closed, the next
    # file to be opened would get its number, and what a process of a batch prints would go into that file
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # takes the lowest free descriptor
    # Stdout and stderr have to exist and to accept any character, since file names may contain any
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the caller
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - open until the process ends
        reconfigure = getattr(getattr(sys, name), "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="backslashreplace")
    try:
        from gsmerge.cli.app import run

        return run(args)
    except Exception as error:  # a library is broken, or the code that explains errors failed
        if "--debug" in (sys.argv[1:] if args is None else args):
            traceback.print_exc()
        problem = f"unexpected error: {type(error).__name__}: {error}".splitlines()[0] + "; run again with --debug"
        if isinstance(error, ModuleNotFoundError):  # gsmerge runs from its sources, without an installation
            problem = f"{error.name} is not installed, but needed; run pip install -e FOLDER on the project's folder"
        print(f"gsmerge: error: {problem}", file=sys.stderr)
        return 1


def stop_at_once(*_: object) -> NoReturn:
    """Print a line and end the process. This handles SIGINT while there is nothing to clean up, as during imports."""
    with suppress(OSError):
        os.write(2, b"gsmerge: error: interrupted\n")
    os._exit(INTERRUPTED)


def program() -> NoReturn:
    """Run :func:`main` as the installed program, and end the process.

    New arrays reuse the memory of deleted arrays, if the C library can. The process then keeps more memory than it
    uses. At the end exit handlers run, and output is flushed. The interpreter is not shut down, because freeing
    modules and arrays takes time: with `sys.exit`, 0.1 s more of CPU for `gsmerge --help`, and 0.15 s more for a draft
    run, which takes 3 s.
    """
    with suppress(AttributeError, OSError, TypeError):  # not glibc
        mallopt = ctypes.CDLL(None).mallopt
        for parameter, value in (M_MMAP_THRESHOLD, M_TRIM_THRESHOLD):
            mallopt(parameter, value)
    if signal.getsignal(signal.SIGINT) == signal.default_int_handler:
        signal.signal(signal.SIGINT, stop_at_once)
    if os.name != "nt" and os.environ.get("TERM", "") in ("dumb", "unknown", "") and not os.environ.get("FORCE_COLOR"):
        # Rich assumes that a dumb or unknown terminal has 80 by 25 letters, and that a terminal without a name knows
        # escape sequences
        os.environ |= dict(zip(("COLUMNS", "LINES"), map(str, shutil.get_terminal_size()), strict=True), TERM="dumb")
    code = main()
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # the command has reported it, or the reader of a pipe has closed it
            stream.flush()
    os._exit(code)
