"""Run PlayCanvas' program splat-transform, which writes levels of detail for streaming."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsmerge.errors import GsmergeError, SceneError, UsageError
from gsmerge.io.first_bytes import CONVERTER_PACKAGE

SPLAT_TRANSFORM_PROGRAM = "splat-transform"
VARIABLE = "GSMERGE_SPLAT_TRANSFORM"
TIME_LIMIT = 1800  # seconds after which the program is stopped


def find_program() -> str:
    """Return the path of splat-transform; raise UsageError if the program is not installed."""
    named = os.environ.get(VARIABLE)
    program = shutil.which(named or SPLAT_TRANSFORM_PROGRAM)
    if program is None:
        place = f"at {VARIABLE}={named}" if named else f"on PATH or named by {VARIABLE}"
        problem = f"expected the program {place}, found none; install it with npm install -g {CONVERTER_PACKAGE}"
        raise UsageError(f"{SPLAT_TRANSFORM_PROGRAM}: {problem}")
    return program


def run_program(*arguments: object) -> None:
    """Run splat-transform on the CPU with ``arguments``, the last of which is the file that it writes.

    Raise GsmergeError if the program fails or takes longer than ``TIME_LIMIT``, UsageError if it is not installed.
    """
    program = find_program()
    command = [program, "-q", "-w", "-g", "cpu", *map(str, arguments)]
    try:
        ended = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=TIME_LIMIT, check=False)
    except subprocess.TimeoutExpired as error:
        raise GsmergeError(f"{program}: expected it to end within {TIME_LIMIT} seconds, it was stopped") from error
    if ended.returncode or not Path(str(arguments[-1])).exists():
        lines = (ended.stderr or ended.stdout).decode(errors="replace").strip().splitlines() or ["without output"]
        reason = next((line for line in lines if "Error: " in line), lines[-1]).rpartition("Error: ")[2]
        problem = f"expected {Path(str(arguments[-1])).name}, it ended with code {ended.returncode}"
        max_output = 300  # most characters of the program's output in an error
        raise GsmergeError(f"{program}: {problem}: {' '.join(reason.split())[:max_output]}")


@contextmanager
def blame_program(path: Path) -> Iterator[None]:
    """Convert errors in reading the program's temporary file to errors of the user's output ``path``."""
    try:
        yield
    except SceneError as error:
        raise SceneError(
            path, f"{SPLAT_TRANSFORM_PROGRAM} wrote a file that cannot be used: {error.problem}"
        ) from error
