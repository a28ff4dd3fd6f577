"""Locks on scenes and on the output folder, which end with the process that has them, however it ends."""

from __future__ import annotations

import hashlib
import os
import secrets
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from gsmerge.errors import SceneError, UsageError

PREFIX = ".batch-"  # of the names of all files here, which are in the output folder
RUN_TIMEOUT = 10.0  # seconds: other runs look at the lock of a run for an instant only


class BusyError(Exception):
    """Another process has the lock."""


@contextmanager
def scene_lock(folder: Path, output: str) -> Iterator[Path]:
    """Keep other processes from a result while the block runs.

    Yields:
        The file whose presence says that a batch has begun to write the result: one that was killed leaves it.

    Raises:
        BusyError: If another process works on the result.
        SceneError: If the lock cannot be made.
    """
    name = hashlib.sha256(output.encode(errors="surrogateescape")).hexdigest()[:32]
    with _lock(folder / f"{PREFIX}{name}.lock"):
        yield folder / f"{PREFIX}{name}.begun"


@contextmanager
def run_lock(folder: Path, name: str) -> Iterator[None]:
    """Share the folder with runs of the same name alone, see :meth:`BatchOptions.name`, while the block runs.

    Raises:
        UsageError: If a run of another name uses the folder.
        SceneError: If the lock cannot be made.
    """
    own = f"{PREFIX}{name[:32]}.{secrets.token_hex(4)}.{os.getpid()}.{socket.gethostname()}.run"
    with _lock(folder / own, RUN_TIMEOUT):  # before others are looked for: of two, one sees the other
        for path in folder.glob(f"{PREFIX}*.run"):
            if path.name != own and _is_locked(path) and not path.name.startswith(f"{PREFIX}{name[:32]}."):
                *_, process, host = path.stem.removeprefix(PREFIX).split(".", 3)
                raise UsageError(
                    f"{folder}: a batch with other settings is at work there (process {process} on {host}); wait for"
                    " it, or name another --output"
                )
        yield


@contextmanager
def _lock(path: Path, seconds: float = 0.0) -> Iterator[None]:
    """Lock a file that is removed after the block; a BusyError if that takes longer than so many seconds."""
    lock = FileLock(path)
    try:
        lock.acquire(timeout=seconds)
    except Timeout:
        raise BusyError from None
    except OSError as error:
        raise SceneError(path, f"cannot be written ({error.strerror})", "name another folder with --output") from error
    try:
        yield
    finally:
        path.unlink(missing_ok=True)  # before the release: who waits for it sees that the file is nobody's any more
        lock.release()


def _is_locked(path: Path) -> bool:
    try:
        with _lock(path):
            return False
    except BusyError:
        return True
