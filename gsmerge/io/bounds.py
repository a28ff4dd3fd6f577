"""Check the size of a file before anything is read from it or allocated for it."""

from __future__ import annotations

import json
import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from gsmerge.errors import SceneError
from gsmerge.types import StrPath

MAX_TEXT_BYTES = 32 << 20  # of a camera file, far more than any has
MAX_MODEL_BYTES = 256 << 20  # of a COLMAP text file, which lists the points of every image as well
MAX_VIEWS = 10_000
MAX_FILES = 100_000  # below a folder of photos
MAX_PIXELS = 1 << 26  # of one image


@contextmanager
def read_errors(path: StrPath) -> Iterator[None]:
    """Turn an OSError of the block into a SceneError that names the file."""
    try:
        yield
    except OSError as error:
        raise SceneError(path, f"cannot be read ({error.strerror})") from error


def check_file(path: Path) -> int:
    """Return the size of a file in bytes; SceneError if it is missing, a folder, a pipe or a device."""
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:
        missing = isinstance(error, FileNotFoundError)
        reason = "no such file" if missing else f"cannot be read ({getattr(error, 'strerror', error)})"
        raise SceneError(path, reason) from error
    if stat.S_ISDIR(status.st_mode):
        raise SceneError(path, "expected a file, found a folder")
    if not stat.S_ISREG(status.st_mode):
        raise SceneError(path, "expected a file, found a pipe or a device", "write its content to a file first")
    return status.st_size


def walk_files(folder: Path) -> list[Path]:
    """List all files below a folder, without following links to folders; SceneError if there are too many."""
    files: list[Path] = []
    for num_folders, (base, _, names) in enumerate(os.walk(folder), 1):
        files += [Path(base) / name for name in names]
        if len(files) + num_folders > MAX_FILES:
            problem = f"expected a folder of photos, found one with more than {MAX_FILES:,} files and folders"
            raise SceneError(folder, problem, "name the folder that holds the photos alone with --images")
    return files


def read_text(path: Path, limit: int = MAX_TEXT_BYTES) -> str:
    """Read a UTF-8 text file; SceneError if it is no text or has more than ``limit`` bytes."""
    size = check_file(path)
    if size > limit:
        raise SceneError(path, f"expected a text file of at most {limit >> 20} MiB, found {size >> 20} MiB")
    try:
        with read_errors(path):
            return path.read_text(encoding="utf-8-sig")
    except ValueError as error:
        raise SceneError(path, f"cannot be read as text ({error})") from error


def read_json(path: Path) -> Any:
    """Read a JSON file of at most 32 MiB; SceneError if it cannot be read or is no JSON."""
    text = read_text(path)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError(path, f"expected JSON, found something else ({error})") from error


def read_table(path: Path) -> dict[str, Any]:
    """Read a table from a ``.json`` file or, from Python 3.11 on, a TOML file; SceneError on failure."""
    is_json = path.suffix.lower() == ".json"
    if not is_json and sys.version_info < (3, 11):
        raise SceneError(path, "TOML needs Python 3.11", "write the settings as JSON")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(path, "expected a TOML or JSON file, found none that can be read") from error
    try:
        table = json.loads(text) if is_json else import_module("tomllib").loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError(path, f"expected TOML or JSON, found a mistake ({str(error).splitlines()[0]})") from error
    if not isinstance(table, dict):
        raise SceneError(path, "expected a table of settings, found no table")
    return table


def check_pixels(path: StrPath, width: int, height: int) -> None:
    """Raise a SceneError if an image size is not positive or has more than 2^26 pixels."""
    if width < 1 or height < 1:
        raise SceneError(path, f"expected a positive image size, found {width} x {height}")
    if width * height > MAX_PIXELS:
        millions = MAX_PIXELS // 1_000_000
        raise SceneError(path, f"expected at most {millions} million pixels an image, found {width} x {height}")
