"""Read and append JSON lines. A file stays valid if a process is killed, or if several processes append at once."""

from __future__ import annotations

import errno
import json
import mmap
import os
from collections.abc import Iterator, Mapping
from io import FileIO
from pathlib import Path
from typing import Any

from gsmerge.errors import SceneError
from gsmerge.io.bounds import parse_json, read_budget, read_errors
from gsmerge.io.locks import lock_file

LOCK = ".gsmerge-lock"  # name of the lock file that is beside a file while a line is appended


def each_line(path: Path, start: int = 0) -> Iterator[tuple[int, dict[str, Any] | None]]:
    """Yield the position in bytes after each complete line, and the line's JSON object, from byte ``start`` on.

    For a damaged line, None is yielded as its object. A line whose object takes more memory than the file's budget
    counts as damaged.
    """
    if not path.exists():
        return
    budget = read_budget(path)
    with read_errors(path), path.open("rb") as file:
        end = file.seek(start)
        for line in file:
            if line.endswith(b"\n"):
                end += len(line)
                try:
                    value = parse_json(line.decode("utf-8"), budget)
                except (ValueError, SceneError):
                    value = None
                yield end, value if isinstance(value, dict) else None


def append_line(path: Path, value: Mapping[str, Any]) -> None:
    """Append one JSON line and wait until it is on the disk.

    The new line replaces an incomplete last line, which a killed process left. If the disk is full, all earlier lines
    stay in the file. Raise SceneError if the file cannot be written, ValueError if a value is NaN or inf.
    """
    line = json.dumps(value, separators=(",", ":"), ensure_ascii=True, allow_nan=False).encode("ascii") + b"\n"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with lock_file(path.parent / LOCK), FileIO(path, "a+b") as file:
            end = file.seek(0, os.SEEK_END)
            if end > 0:
                with mmap.mmap(file.fileno(), end, access=mmap.ACCESS_READ) as data:
                    end = data.rfind(b"\n") + 1  # after the last complete line
            file.truncate(end)
            if file.write(line) != len(line):  # a full disk stores the first part without an error
                file.truncate(end)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(file.fileno())
    except OSError as error:
        raise SceneError(path, f"cannot be written ({error.strerror})", "name another folder with --output") from error
