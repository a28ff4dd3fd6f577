"""Archives of zip: what those that are read unpack to is bounded by what they promise."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsmerge.errors import SceneError
from gsmerge.io.bounds import read_budget
from gsmerge.types import StrPath

# For others, zipfile unpacks each piece of packed bytes whole, whatever the directory promises
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_PIECE = 1 << 14  # bytes that are unpacked in a budget's step


@contextmanager
def open_archive(path: StrPath) -> Iterator[zipfile.ZipFile]:
    """Open an archive; SceneError unless all its members are stored or deflated."""
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            if info.compress_type not in _METHODS:
                problem = f"{info.filename!r:.80}: expected a member that is stored or deflated, found one packed"
                raise SceneError(path, f"{problem} by method {info.compress_type}", "pack it again")
        yield archive


def new_member(name: str) -> zipfile.ZipInfo:
    """Return a member to write, of 1980 and of Unix: the same bytes at any time and on any system."""
    member = zipfile.ZipInfo(name)
    member.create_system = 3
    return member


def read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    """Read the bytes that the directory promises, and unpack no more, as ``ZipFile.read`` does."""
    with archive.open(info) as file:
        return file.read(info.file_size)


def damaged_member(path: Path) -> str | None:
    """Describe what is wrong with an archive's members by their checksums; None if nothing is."""
    try:
        with open_archive(path) as archive:
            pieces = sum(-(-info.file_size // _PIECE) for info in archive.infolist())
            read_budget(path).check_steps(pieces, f"pieces of {_PIECE:,} unpacked bytes")
            name = archive.testzip()
    except SceneError as error:
        return str(error).removeprefix(f"{path}: ")
    except Exception as error:  # whatever a damaged archive makes the library raise
        return f"cannot be unpacked ({' '.join(str(error).split())})"
    return None if name is None else f"{name}: not what was written, by its checksum"
