"""Run PlayCanvas' splat-transform, by a temporary ``.ply``, for formats that gsmerge itself cannot read or write."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from gsmerge.errors import GsmergeError, SceneError, UsageError
from gsmerge.io.bounds import check_file, read_json
from gsmerge.io.formats import ply
from gsmerge.io.formats.arrays import StoredRows

PROGRAM, VARIABLE = "splat-transform", "GSMERGE_SPLAT_TRANSFORM"
PACKAGE = "@playcanvas/splat-transform@3.7"
TIME_LIMIT = 1800  # seconds
MAX_OUTPUT = 300  # characters of the program's own output in an error


def find_program() -> str:
    """Find the path of the program; UsageError, which says how to install it, if there is none."""
    named = os.environ.get(VARIABLE)
    program = shutil.which(named or PROGRAM)
    if program is None:
        place = f"at {VARIABLE}={named}" if named else f"on PATH or named by {VARIABLE}"
        problem = f"expected the program {place}, found none; install it with npm install -g {PACKAGE}"
        raise UsageError(f"{PROGRAM}: {problem}")
    return program


def holds_sog(path: Path) -> bool:
    """Return whether a ``meta.json`` belongs to a ``.sog``, and not to another program."""
    try:
        document = read_json(path)
    except SceneError:
        return False
    return isinstance(document, dict) and {"means", "scales", "quats", "sh0"} <= document.keys()


def run_program(*words: object) -> None:
    """Run the program on the CPU with arguments ``words``; the last argument is the file that it writes.

    GsmergeError if it fails or takes longer than ``TIME_LIMIT``, UsageError if it is not installed.
    """
    program = find_program()
    command = [program, "-q", "-w", "-g", "cpu", *map(str, words)]
    try:
        ended = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=TIME_LIMIT, check=False)
    except subprocess.TimeoutExpired as error:
        raise GsmergeError(f"{program}: expected it to end within {TIME_LIMIT} seconds, it was stopped") from error
    if ended.returncode or not Path(str(words[-1])).exists():
        lines = (ended.stderr or ended.stdout).decode(errors="replace").strip().splitlines() or ["without output"]
        reason = next((line for line in lines if "Error: " in line), lines[-1]).rpartition("Error: ")[2]
        problem = f"expected {Path(str(words[-1])).name}, it ended with code {ended.returncode}"
        raise GsmergeError(f"{program}: {problem}: {' '.join(reason.split())[:MAX_OUTPUT]}")


@contextmanager
def name_file(path: Path) -> Iterator[None]:
    """Replace the program's temporary file by the user's file ``path`` in errors."""
    try:
        yield
    except SceneError as error:
        raise SceneError(path, f"{PROGRAM} wrote a file that cannot be used: {error.problem}") from error


def read_rows(path: Path) -> StoredRows:
    """Read the finest level of Gaussians of a file by the program.

    SceneError if it cannot be read. If the program is not installed, the error has the command that converts the file.
    """
    check_file(path)
    with TemporaryDirectory(prefix="gsmerge-") as folder:
        converted = Path(folder) / "scene.ply"
        try:
            run_program(path.absolute(), "-L", 0, converted)
        except UsageError as error:
            target = path.with_name("scene.ply") if path.suffix == ".json" else path.with_suffix(".ply")
            command = shlex.join(["npx", PACKAGE, str(path), "-L", "0", str(target)])
            problem = f"expected the program {PROGRAM} to read this format, found none"
            raise SceneError(path, problem, f"convert it with {command}") from error
        except GsmergeError as error:
            raise SceneError(path, f"cannot be read by {error}") from error
        with name_file(path):
            stored = ply.read_rows(converted)
            with ply.open_rows(converted, stored.rows) as read:
                rows = read(slice(None))
    is_single_file = path.suffix.lower() == ".ksplat"  # the other formats have several files in a folder
    beside = [] if is_single_file else [file for file in path.parent.iterdir() if file.is_file() and file != path]
    return replace(
        stored, rows=rows, layout=f"{stored.layout}, by {PROGRAM}", encoding="logit",
        bytes_beside=sum(file.stat().st_size for file in beside),
    )  # fmt: skip
