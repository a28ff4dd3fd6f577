"""The command line: parse, call, print. Nothing heavy is imported before a command runs."""

from __future__ import annotations

import os
from collections.abc import Sequence


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        args: Arguments without the program's name; those of the process when None.

    Returns:
        0 done, 1 unexpected error, 2 wrong usage, 3 bad input, 4 target not met, 5 part of a batch failed,
        130 interrupted.
    """
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # we report damaged images ourselves
    os.environ.setdefault("GSMERGE_COMMAND", "1")  # see gsmerge.kernels.jit
    from gsmerge.cli.app import run

    return run(args)
