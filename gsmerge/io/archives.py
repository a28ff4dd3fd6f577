"""Read zip archives. No member unpacks to more bytes than the archive's directory states."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager

from gsmerge.errors import SceneError
from gsmerge.types import StrPath

# With methods other than stored and deflated, zipfile may unpack more bytes of a member than the archive's directory
# states
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


@contextmanager
def open_archive(path: StrPath) -> Iterator[zipfile.ZipFile]:
    """Open a zip archive; raise SceneError if a member is packed with a method other than "stored" or "deflated"."""
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            if info.compress_type not in _METHODS:
                problem = f"expected members that are stored or deflated, found {info.filename!r:.80} packed by method"
                raise SceneError(path, f"{problem} {info.compress_type}", "pack the archive again with one of these")
        yield archive


def read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    """Read as many bytes of a member as the archive's directory states; ``ZipFile.read`` might unpack more."""
    with archive.open(info) as file:
        return file.read(info.file_size)
