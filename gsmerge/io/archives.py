"""Read and write zip archives; no member unpacks to more bytes than the directory of the archive states for it."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager

from gsmerge.errors import SceneError
from gsmerge.types import StrPath

# With any other method, zipfile unpacks a piece of packed bytes completely, even if the directory states fewer bytes
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


@contextmanager
def open_archive(path: StrPath) -> Iterator[zipfile.ZipFile]:
    """Open a zip archive; SceneError if any member is packed by another method than "stored" or "deflated"."""
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            if info.compress_type not in _METHODS:
                problem = f"expected members that are stored or deflated, found {info.filename!r:.80} packed by method"
                raise SceneError(path, f"{problem} {info.compress_type}", "pack the archive again with one of these")
        yield archive


def new_member(name: str) -> zipfile.ZipInfo:
    """Return a member to write, dated 1980 and marked as Unix, so that bytes are equal at any time on any system."""
    member = zipfile.ZipInfo(name)
    member.create_system = 3
    return member


def read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    """Read as many bytes of a member as the directory states; ``ZipFile.read`` might unpack more."""
    with archive.open(info) as file:
        return file.read(info.file_size)
