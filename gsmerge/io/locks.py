"""Locks between processes: files that are there only meanwhile."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

from gsmerge.errors import SceneError


@contextmanager
def lock_file(path: Path, *, wait: bool = True) -> Iterator[bool]:
    """Let one process at a time into the block, and make a file for that; yield whether it is this one's turn.

    ``wait``: wait for that turn. SceneError if the file cannot be made.
    """
    from filelock import FileLock, Timeout  # most commands need none

    lock = FileLock(path)
    try:
        lock.acquire(timeout=-1 if wait else 0)
    except Timeout:
        yield False
        return
    except OSError as error:
        raise SceneError(path, f"cannot be written ({error.strerror})", "choose another folder") from error
    try:
        yield True
    finally:
        with suppress(OSError):  # Windows removes no open file; there the release does
            path.unlink()  # before the release: who waits for it sees that it is nobody's any more
        lock.release()


def lock_folder(folder: Path) -> AbstractContextManager[bool]:
    """Let one process at a time into the block for a folder; others wait."""
    return lock_file(folder / ".gsmerge-lock")
