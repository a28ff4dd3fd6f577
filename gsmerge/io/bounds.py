"""Limit the memory and time for reading a file, so that a small damaged file cannot fill the memory.

A reader may take 64 MB of memory and 20 bytes more for each byte of the file. The loops of a reader may take 5 seconds,
and 2 seconds more for each MB. A reader checks its :class:`ReadBudget` before it allocates memory or runs a loop whose
size the file states.
"""

from __future__ import annotations

import json
import os
import re
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

from gsmerge.errors import OUT_OF_MEMORY, SceneError
from gsmerge.frozen import dataclass
from gsmerge.io.first_bytes import check_first_bytes
from gsmerge.settings.setting import suggest_name
from gsmerge.types import StrPath

MAX_TEXT_BYTES = 32 << 20  # most bytes of a camera file; real files have far fewer
MAX_MODEL_BYTES = 256 << 20  # most bytes of a COLMAP text file, which also lists the points of every image
MAX_VIEWS = 10_000  # most views of a camera file
MAX_FILES = 100_000  # most files and folders below a folder of photos
MAX_PIXELS = 1 << 26  # most pixels of an image

_ADDRESS = re.compile(r"(https?|s3|gs|ftp|file):/+")  # start of a URL
# bytes of memory for any file, and for each byte of it
_FREE_MEMORY = 64_000_000
_MEMORY_PER_BYTE = 20
# steps of 20 microseconds: 5 s for any file, and 2 s for each MB
_FREE_STEPS = 250_000
_BYTES_PER_STEP = 10
# Character in a JSON text -> most bytes of the objects that CPython 3.10 to 3.14 makes for it
_JSON_BYTES = {"[": 88, "{": 130, ":": 110, '"': 30, ",": 34}


@dataclass(frozen=True)
class ReadBudget:
    """Limits for reading a file, by its size in bytes.

    Args:
        path: The file.
        file_bytes: Bytes of the file, plus those of all files that are read together with it.
        memory_per_byte: Bytes of memory that reading may take for each byte of the file, besides 64 MB for any file.
        remedy: Remedy in the error for a file that needs more memory.
    """

    path: StrPath
    file_bytes: int
    memory_per_byte: int = _MEMORY_PER_BYTE
    remedy: str = ""

    def check_memory(self, num_bytes: float, what: str) -> None:
        """Raise SceneError if ``num_bytes`` of memory, which ``what`` needs, are more than the file allows."""
        most = _FREE_MEMORY + self.memory_per_byte * self.file_bytes
        if not num_bytes <= most:
            problem = f"expected at most {most / 1e6:,.0f} MB of memory for a file of {self.file_bytes:,} bytes"
            raise SceneError(self.path, f"{problem}, found {what} of {num_bytes / 1e6:,.0f} MB", self.remedy)

    def check_steps(self, count: int, what: str) -> None:
        """Raise SceneError if a loop has more steps than the file allows; a step takes 20 microseconds.

        ``what`` names the steps in the error.
        """
        most = _FREE_STEPS + self.file_bytes // _BYTES_PER_STEP
        if not count <= most:
            problem = f"expected at most {most:,} {what} in a file of {self.file_bytes:,} bytes"
            raise SceneError(self.path, f"{problem}, found {count:,}")


def read_budget(path: Path) -> ReadBudget:
    """Return the budget of a file; raise SceneError as in :func:`check_file`."""
    return ReadBudget(path, check_file(path))


def parse_json(text: str, budget: ReadBudget) -> Any:
    """Parse JSON; raise SceneError if its objects take more memory than the budget, ValueError if it is no JSON."""
    objects = sum(size * text.count(character) for character, size in _JSON_BYTES.items())
    budget.check_memory(sys.getsizeof(text) + objects, "JSON")
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


@contextmanager
def read_errors(path: StrPath) -> Iterator[None]:
    """In a ``with`` block, convert an OSError or MemoryError to a SceneError that names the file."""
    try:
        yield
    except OSError as error:
        raise SceneError(path, f"cannot be read ({error.strerror or error})") from error
    except MemoryError as error:
        raise SceneError(path, OUT_OF_MEMORY) from error


def check_file(path: Path) -> int:
    """Return the size of a file in bytes; raise SceneError if the file is missing, or of a kind that is not read."""
    try:
        status = os.stat(path)
    except FileNotFoundError as error:
        raise no_such_path(path) from error
    except (OSError, ValueError) as error:
        raise SceneError(path, f"cannot be read ({getattr(error, 'strerror', error)})") from error
    if stat.S_ISDIR(status.st_mode):
        raise SceneError(path, "expected a file, found a folder", "name a file in it")
    if not stat.S_ISREG(status.st_mode):
        raise SceneError(path, "expected a file, found a pipe or a device", "write its content to a file first")
    check_first_bytes(Path(path), status.st_size)
    return status.st_size


def no_such_path(path: StrPath, problem: str = "no such file or folder") -> SceneError:
    """Return the error for a path that does not exist, with what may have been meant."""
    if _ADDRESS.match(str(path)):  # a Path has lost a slash
        address = _ADDRESS.sub(r"\1://", str(path))
        return SceneError(address, "expected a path, found a URL", "download the file and name its path")
    return SceneError(path, problem, suggest_path(path).removeprefix("; "))


def suggest_path(path: StrPath) -> str:
    """Return the end of a message about a missing path: "; perhaps NAME", or nothing if no name beside it is alike."""
    folder, name = os.path.split(os.path.normpath(path))
    with suppress(OSError):
        return suggest_name(name, os.listdir(folder or "."))
    return ""


def walk_files(folder: Path) -> list[Path]:
    """List all files in and below a folder, but not in linked folders; raise SceneError for more than ``MAX_FILES``."""
    files: list[Path] = []
    for num_folders, (base, _, names) in enumerate(os.walk(folder), 1):
        files += [Path(base) / name for name in names]
        if len(files) + num_folders > MAX_FILES:
            problem = f"expected a folder of photos, found more than {MAX_FILES:,} files and folders in it"
            raise SceneError(folder, problem, "name a folder that holds only the photos with --images")
    return files


def read_text(path: Path) -> str:
    """Read a UTF-8 text file; raise SceneError if the file is too large or no text."""
    with _text_file(path, MAX_TEXT_BYTES) as file:
        return file.read()


def read_lines(path: Path, limit: int = MAX_TEXT_BYTES) -> Iterator[str]:
    """Yield the lines of a UTF-8 text file, with line ends, one at a time; raise SceneError as :func:`read_text`."""
    with _text_file(path, limit) as file:
        yield from file


@contextmanager
def _text_file(path: Path, limit: int) -> Iterator[TextIO]:
    """Open a UTF-8 text file; raise SceneError as in :func:`read_text`."""
    size = check_file(path)
    if size > limit:
        raise SceneError(path, f"expected a text file of at most {limit >> 20} MiB, found {size >> 20} MiB")
    try:
        with read_errors(path), path.open(encoding="utf-8-sig") as file:
            yield file
    except ValueError as error:
        raise SceneError(path, f"expected UTF-8 text, found other bytes ({error})") from error


def read_json(path: Path) -> Any:
    """Read a JSON file of at most 32 MiB; raise SceneError if the file cannot be read or is no JSON."""
    text = read_text(path)
    try:
        return parse_json(text, read_budget(path))
    except ValueError as error:
        raise SceneError(path, f"expected JSON, found other text ({error})") from error


def check_image_size(path: StrPath, width: int, height: int) -> None:
    """Raise SceneError if an image size is not positive or has more than 2^26 pixels."""
    if width < 1 or height < 1:
        raise SceneError(path, f"expected a positive image size, found {width} x {height}")
    if width * height > MAX_PIXELS:
        millions = MAX_PIXELS // 1_000_000
        raise SceneError(path, f"expected at most {millions} million pixels per image, found {width} x {height}")


def check_whole(value: Any, name: str, least: int, most: int = 2**53) -> int:
    """Return ``value`` if it is a whole number from ``least`` to ``most``; raise ValueError for any other value.

    The error begins with ``name``. By default ``most`` is 2^53, since every JSON reader stores whole numbers up to 2^53
    exactly.
    """
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise ValueError(f"{name}: expected a whole number from {least} to {most}, found {value!r:.40}")
    return value
