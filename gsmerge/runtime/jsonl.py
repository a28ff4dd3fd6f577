"""Files of JSON lines that survive being killed at any moment, also where several processes write at once."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Any

from gsmerge.errors import SceneError

try:
    import fcntl
except ImportError:  # not a POSIX system: one process at a time
    fcntl = None  # type: ignore[assignment]


@dataclass(frozen=True)
class Lines:
    """What a file of JSON lines holds."""

    values: tuple[dict[str, Any], ...]  # One per line that could be read
    notes: tuple[str, ...]  # Lines that were dropped, one sentence each


def read_lines(path: Path) -> Lines:
    """Read a file of JSON lines; what a killed run left half-written is dropped, and said."""
    values: list[dict[str, Any]] = []
    notes, last = [], 0
    for number, (end, value) in enumerate(each_line(path), 1):
        last = end
        if value is None:
            notes.append(f"{path}: line {number} is damaged and was dropped; its run is done again")
        else:
            values.append(value)
    if path.exists() and last < path.stat().st_size:
        notes.append(f"{path}: the last line is incomplete and was dropped; its run is done again")
    return Lines(tuple(values), tuple(notes))


def each_line(path: Path, start: int = 0) -> Iterator[tuple[int, dict[str, Any] | None]]:
    """The complete lines of a file from a byte on, one at a time.

    Yields:
        The byte after the line, and what it holds; None if it is damaged.
    """
    if not path.exists():
        return
    try:
        with path.open("rb") as file:
            end = file.seek(start)
            for line in file:
                if line.endswith(b"\n"):
                    end += len(line)
                    yield end, _parsed(line)
    except OSError as error:
        raise SceneError(path, f"cannot be read ({error.strerror})") from error


def _parsed(line: bytes) -> dict[str, Any] | None:
    try:
        value = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def append_line(path: Path, value: Mapping[str, Any]) -> None:
    """Append one JSON line: on the disk when this returns, and in place of a half-written one.

    What cannot be written whole leaves the file as it was.

    Raises:
        SceneError: If the file cannot be written.
        ValueError: If there is NaN or inf among the values.
    """
    line = json.dumps(value, separators=(",", ":"), ensure_ascii=True, allow_nan=False).encode("ascii") + b"\n"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with FileIO(path, "a+b") as file, alone(file.fileno()):
            end = _whole_bytes(path)
            file.truncate(end)
            try:
                _write(file, line)
            except OSError:
                file.truncate(end)
                raise
            os.fsync(file.fileno())
    except OSError as error:
        raise SceneError(path, f"cannot be written ({error.strerror})", "name another folder with --output") from error


def _write(file: FileIO, line: bytes) -> None:
    """All of it: a full disk takes a part of what it is given first, and says so only when asked again."""
    while line:
        written = file.write(line)
        if not written:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        line = line[written:]


@contextmanager
def alone(descriptor: int) -> Iterator[None]:
    """A block in which no other process that asks the same is in its own for this open file."""
    if fcntl is None:
        yield
        return
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    try:
        yield
    finally:
        fcntl.flock(descriptor, fcntl.LOCK_UN)


def _whole_bytes(path: Path) -> int:
    """Bytes up to the end of the last complete line."""
    with path.open("rb") as file:
        end = file.seek(0, os.SEEK_END)
        while end > 0:
            start = max(0, end - 65536)
            file.seek(start)
            newline = file.read(end - start).rfind(b"\n")
            if newline >= 0:
                return start + newline + 1
            end = start
    return 0
