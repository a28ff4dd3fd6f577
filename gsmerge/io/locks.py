"""Locks between processes; the file of a lock exists only while the lock is held."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from gsmerge.errors import SceneError


@contextmanager
def lock_file(path: Path, *, wait: bool = True) -> Iterator[bool]:
    """Let one process at a time into the block, by a lock file; yield whether this process has the lock.

    ``wait``: wait for the lock; otherwise yield False if another process has it. SceneError if the lock file cannot be
    made.
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
        with suppress(OSError):  # Windows removes no open file; there the release removes it
            path.unlink()  # before the release, so that a waiting process notices that its file is no longer the lock
        lock.release()
