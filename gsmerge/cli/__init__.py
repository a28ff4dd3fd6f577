"""The command line: parse, call, print. Nothing heavy is imported before a command runs."""

from __future__ import annotations

import atexit
import os
import sys
from collections.abc import Sequence
from typing import NoReturn


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        args: Arguments without the program's name; those of the process when None.

    Returns:
        0 done, 1 unexpected error, 2 wrong usage, 3 bad input, 4 target not met, 5 part of a batch failed,
        129 ended by SIGHUP, 130 interrupted, 143 ended by SIGTERM.
    """
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # we report damaged images ourselves
    os.environ.setdefault("GSMERGE_COMMAND", "1")  # see gsmerge.kernels.jit
    from gsmerge.cli.app import run

    return run(args)


def program() -> NoReturn:
    """The installed program: :func:`main`, then the end of the process.

    Exit handlers run and output is flushed, but the interpreter is not taken apart: with hundreds of compiled kernels
    and gigabytes of arrays that took 0.3 s.
    """
    code = main()
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except BrokenPipeError:  # whoever read our output has seen enough
            pass
        except OSError:
            code = code or 1
    os._exit(code)
