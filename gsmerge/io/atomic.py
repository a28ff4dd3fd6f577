"""Files that are either complete or not there."""

from __future__ import annotations

import errno
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsmerge.errors import SceneError

# What the disk itself may answer in the middle of writing; any other OSError is the caller's own.
_DISK_ERRORS = {errno.ENOSPC, errno.EFBIG, errno.EIO, errno.EROFS}


@contextmanager
def atomic_output(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary file next to ``path``, renamed to it when the block succeeds and removed when it fails.

    Args:
        path: The file to be written. Its folder must exist.
        overwrite: Replace an existing file; without it one is refused, before the block is entered.

    Yields:
        An empty file in the same folder with the same suffix, to be written by the block.

    Raises:
        SceneError: If the file exists and may not be replaced, or the folder cannot be written.
    """
    path = Path(path)
    _refuse(path, overwrite)
    temporary = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
    try:
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    except OSError as error:
        raise SceneError(path, f"cannot be written ({error.strerror})", "choose another folder") from error
    try:
        yield temporary
        _refuse(path, overwrite)  # somebody else may have been quicker
        temporary.replace(path)
    except SceneError as error:
        if error.path != str(temporary):
            raise
        raise SceneError(path, error.problem, error.remedy) from error  # the temporary name means nothing to the caller
    except OSError as error:
        if error.errno not in _DISK_ERRORS and error.filename != str(temporary):
            raise
        raise SceneError(path, f"could not be written ({error.strerror})") from error
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(path: Path) -> None:
    """Remove the temporary files that killed processes left of this output; nobody may be writing it."""
    name = re.compile(rf"\.+{re.escape(path.stem)}(-[0-9a-f]{{8}})+{re.escape(path.suffix)}")  # also one's own one
    try:
        with os.scandir(path.parent) as entries:
            leftovers = [entry.path for entry in entries if name.fullmatch(entry.name)]
        for leftover in leftovers:
            os.unlink(leftover)
    except OSError as error:
        raise SceneError(path, f"its temporary files cannot be removed ({error.strerror})") from error


def _refuse(path: Path, overwrite: bool) -> None:
    if os.path.isdir(path):
        raise SceneError(path, "expected a file to write, found a folder", "name a file in it")
    if not os.path.isdir(path.parent):
        raise SceneError(path, f"the folder {path.parent} does not exist", "make it first")
    if os.path.lexists(path) and not overwrite:
        raise SceneError(path, "exists already", "choose another name or allow overwriting")
