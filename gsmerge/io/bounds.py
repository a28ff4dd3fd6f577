"""Check what a file asks for before anything is read from it or allocated for it.

One budget holds for every reader: reading takes at most 64 MB + 20 x the file's bytes of memory, and 5 s + 2 s per MB
of processor time. A reader asks a :class:`ReadBudget` before it allocates, or loops, as often as a file says.
"""

from __future__ import annotations

import json
import os
import re
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, TextIO

from gsmerge.errors import OUT_OF_MEMORY, SceneError
from gsmerge.io.first_bytes import check_first_bytes
from gsmerge.types import StrPath

MAX_TEXT_BYTES = 32 << 20  # of a camera file, far more than any has
MAX_MODEL_BYTES = 256 << 20  # of a COLMAP text file, which lists the points of every image as well
MAX_SETTINGS_BYTES = 1 << 20
MAX_VIEWS = 10_000
MAX_FILES = 100_000  # below a folder of photos
MAX_PIXELS = 1 << 26  # of one image

_ADDRESS = re.compile(r"(https?|s3|gs|ftp|file):/")  # of another machine
_FREE_MEMORY, _MEMORY_PER_BYTE = 64_000_000, 20
_FREE_STEPS, _BYTES_PER_STEP = 250_000, 10  # of 20 microseconds: 5 s, and 2 s for each MB
_PARTS_PER_STEP = 4000  # parts of a TOML key, squared
# Bytes of Python's objects for each of these characters in JSON, the most that CPython 3.10 to 3.14 takes
_JSON_BYTES = {"[": 88, "{": 130, ":": 110, '"': 30, ",": 34}


@dataclass(frozen=True)
class ReadBudget:
    """What reading a file may take: memory of 64 MB + 20 x its bytes, and a loop's steps for 5 s + 2 s per MB.

    Args:
        path: The file.
        file_bytes: Its bytes, with those of files that are read together with it.
        memory_per_byte: Bytes of memory for each of them.
        remedy: What to do about a file that takes more.
    """

    path: StrPath
    file_bytes: int
    memory_per_byte: int = _MEMORY_PER_BYTE
    remedy: str = ""

    @property
    def memory(self) -> int:
        """Bytes of memory that the file allows."""
        return _FREE_MEMORY + self.memory_per_byte * self.file_bytes

    def check_memory(self, num_bytes: float, what: str) -> None:
        """Raise SceneError if ``what`` takes ``num_bytes`` at once, and the file allows less."""
        if not num_bytes <= self.memory:
            problem = f"expected at most {self.memory / 1e6:,.0f} MB of memory for a file of {self.file_bytes:,} bytes"
            raise SceneError(self.path, f"{problem}, found {what} of {num_bytes / 1e6:,.0f} MB", self.remedy)

    def check_steps(self, count: int, what: str) -> None:
        """Raise SceneError if a loop over ``count`` of ``what`` takes longer than the file allows."""
        most = _FREE_STEPS + self.file_bytes // _BYTES_PER_STEP
        if not count <= most:
            problem = f"expected at most {most:,} {what} in a file of {self.file_bytes:,} bytes"
            raise SceneError(self.path, f"{problem}, found {count:,}")


def read_budget(path: Path) -> ReadBudget:
    """Return the budget of a file; SceneError as in :func:`check_file`."""
    return ReadBudget(path, check_file(path))


def parse_json(text: str, budget: ReadBudget) -> Any:
    """Parse JSON; SceneError if its objects would take more memory than the budget, ValueError if it is not JSON."""
    objects = sum(size * text.count(character) for character, size in _JSON_BYTES.items())
    budget.check_memory(sys.getsizeof(text) + objects, "JSON")
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


@contextmanager
def read_errors(path: StrPath) -> Iterator[None]:
    """Turn an OSError of the block, or a lack of memory, into a SceneError that names the file."""
    try:
        yield
    except OSError as error:
        raise SceneError(path, f"cannot be read ({error.strerror or error})") from error
    except MemoryError as error:
        raise SceneError(path, OUT_OF_MEMORY) from error


def check_file(path: Path) -> int:
    """Return the size of a file in bytes; SceneError if it is missing, no file, or not what its name says."""
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:
        if _ADDRESS.match(str(path)):
            raise SceneError(path, "addresses are not read", "download the file and give its path") from error
        missing = isinstance(error, FileNotFoundError)
        reason = "no such file" if missing else f"cannot be read ({getattr(error, 'strerror', error)})"
        raise SceneError(path, reason) from error
    if stat.S_ISDIR(status.st_mode):
        raise SceneError(path, "expected a file, found a folder", "name the file in it")
    if not stat.S_ISREG(status.st_mode):
        raise SceneError(path, "expected a file, found a pipe or a device", "write its content to a file first")
    check_first_bytes(Path(path), status.st_size)
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
    """Read a UTF-8 text file; SceneError if it is not text or has more than ``limit`` bytes."""
    with _text_file(path, limit) as file:
        return file.read()


def read_lines(path: Path, limit: int = MAX_TEXT_BYTES) -> Iterator[str]:
    """Yield the lines of a UTF-8 text file with their line ends, one at a time; SceneError as in :func:`read_text`."""
    with _text_file(path, limit) as file:
        yield from file


@contextmanager
def _text_file(path: Path, limit: int) -> Iterator[TextIO]:
    size = check_file(path)
    if size > limit:
        raise SceneError(path, f"expected a text file of at most {limit >> 20} MiB, found {size >> 20} MiB")
    try:
        with read_errors(path), path.open(encoding="utf-8-sig") as file:
            yield file
    except ValueError as error:
        raise SceneError(path, f"cannot be read as text ({error})") from error


def read_json(path: Path) -> Any:
    """Read a JSON file of at most 32 MiB; SceneError if it cannot be read or is not JSON."""
    text = read_text(path)
    try:
        return parse_json(text, read_budget(path))
    except ValueError as error:
        raise SceneError(path, f"expected JSON, found something else ({error})") from error


def read_table(path: Path) -> dict[str, Any]:
    """Read a table from a ``.json`` file or, from Python 3.11 on, a TOML file; SceneError on failure."""
    is_json = path.suffix.lower() == ".json"
    if not is_json and sys.version_info < (3, 11):
        raise SceneError(path, "TOML needs Python 3.11", "write the settings as JSON")
    text, budget = read_text(path, MAX_SETTINGS_BYTES), read_budget(path)
    if not is_json:  # whose reader compares each part of a dotted key with all before it
        parts = sum(line.count(".") ** 2 for line in text.splitlines())
        budget.check_steps(parts // _PARTS_PER_STEP, "steps for dotted keys")
    try:
        table = parse_json(text, budget) if is_json else import_module("tomllib").loads(text)
        repr(table)  # fails for whole numbers of more digits than JSON may have
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


def check_whole(value: Any, name: str, least: int, most: int = 2**53) -> int:
    """Return a number of a document if it is whole and within its range; ValueError otherwise.

    2^53 is the largest whole number that every JSON reader keeps.
    """
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise ValueError(f"{name}: expected a whole number from {least} to {most}, not {value!r:.40}")
    return value
