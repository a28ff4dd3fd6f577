"""Files of JSON lines that survive being killed at any moment, also where several processes write at once."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import Any

from gsmerge.errors import SceneError

try:
    import fcntl
except ImportError:  # not a POSIX system: one process at a time
    fcntl = None  # type: ignore[assignment]


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
