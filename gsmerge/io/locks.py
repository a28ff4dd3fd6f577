"""Lock files so that one process at a time writes. A lock file exists only while a process has the lock."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from gsmerge.errors import SceneError


@contextmanager
def lock_file(path: Path, *, wait: bool = True) -> Iterator[bool]:
    """Lock a file against other processes during a ``with`` block, and yield whether this process has the lock.

    If another process has the lock, the call waits until the lock is free, or yields False if ``wait`` is False. Raise
    SceneError if the lock file cannot be made.
    """
    from filelock import FileLock, Timeout  # most commands need no lock

    lock = FileLock(path)
    try:
        lock.acquire(timeout=-1 if wait else 0)
    except Timeout:
        yield False
        return
    except OSError as error:
        raise SceneError(path.parent, f"cannot be written ({error.strerror})", "choose another folder") from error
    try:
        yield True
    finally:
        # The lock file is removed before the lock is released, so that a waiting process notices that its open file is
        # no longer the lock file
        with suppress(OSError):  # an open file on Windows, which the release removes
            path.unlink()
        lock.release()
