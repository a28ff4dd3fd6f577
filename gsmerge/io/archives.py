"""Read and write zip archives. No member unpacks to more bytes than the archive's directory states."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager

from gsmerge.errors import SceneError
from gsmerge.types import StrPath

# With other methods, zipfile may unpack more bytes of a member than the directory states
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


@contextmanager
def open_archive(path: StrPath) -> Iterator[zipfile.ZipFile]:
    """Open a zip archive; SceneError if a member is packed with a method other than "stored" or "deflated"."""
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            if info.compress_type not in _METHODS:
                problem = f"expected members that are stored or deflated, found {info.filename!r:.80} packed by method"
                raise SceneError(path, f"{problem} {info.compress_type}", "pack the archive again with one of these")
        yield archive


def new_member(name: str) -> zipfile.ZipInfo:
    """Make a member to write. Its date is 1980 and its system Unix, so that archives have the same bytes everywhere."""
    member = zipfile.ZipInfo(name)
    member.create_system = 3
    return member


def read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    """Read only as many bytes of a member as the directory states, where ``ZipFile.read`` might unpack more."""
    with archive.open(info) as file:
        return file.read(info.file_size)
