"""Locks on scenes and on the output folder, which end with the process that holds them, however it ends.

They are in a folder of their own in the output folder. A lock file without a holder means that a process was killed
while it worked on the scene: its unfinished files may be removed, and its result replaced.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from gsmerge.errors import SceneError, UsageError

try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None  # type: ignore[assignment]

LOCKS = ".batch"
RUN = "run"  # name of the folder's own lock
LOCK_TIMEOUT = 10.0  # seconds: a run locks the folder exclusively for an instant only


class BusyError(Exception):
    """Another process holds the lock."""


@dataclass(frozen=True)
class Lock:
    """A lock that this process holds."""

    path: Path  # its file
    abandoned: bool  # whether a process was killed while it held it
    fresh: bool  # whether there was no result before the first process that held it

    def finish(self) -> None:
        """Remove the file: nothing is left unfinished."""
        self.path.unlink(missing_ok=True)
        with suppress(OSError):  # other locks are in the folder
            self.path.parent.rmdir()


@contextmanager
def scene_lock(folder: Path, outputs: Sequence[str]) -> Iterator[Lock]:
    """A block in which no other process works on a result; the lock's file stays unless :meth:`Lock.finish` is called.

    ``outputs`` are names of the result and of its further levels. A BusyError if another process works on it, a
    SceneError if the file cannot be made.
    """
    path = folder / LOCKS / f"{hashlib.sha256(outputs[0].encode(errors='surrogateescape')).hexdigest()[:32]}.lock"
    descriptor, abandoned = _acquire(path)
    try:
        fresh = not any(os.path.lexists(folder / name) for name in outputs)
        if abandoned:
            fresh = _read(descriptor).get("fresh") is True
        _write(descriptor, outputs[0], fresh=fresh)
        yield Lock(path, abandoned, fresh)
    finally:
        os.close(descriptor)


def _acquire(path: Path) -> tuple[int, bool]:
    """The open, locked file, and whether it was there before."""
    while True:
        descriptor = _open(path)
        try:
            if _lock(descriptor, path, shared=False) and _is_same_file(descriptor, path):
                return descriptor, os.fstat(descriptor).st_size > 0
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _open(path: Path) -> int:
    while True:
        try:
            path.parent.mkdir(exist_ok=True)
            return os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            if isinstance(error, FileNotFoundError) and path.parent.parent.is_dir():
                continue  # another run ended and removed the folder of locks
            problem = f"cannot be written ({error.strerror})"
            raise SceneError(path, problem, "name another folder with --output") from error


def _lock(descriptor: int, path: Path, *, shared: bool) -> bool:
    """Take the lock: a BusyError if another process holds it, a SceneError if the file system knows no locks."""
    if fcntl is None:
        raise SceneError(path, "expected a system with file locks, found none", "run batches on Linux or macOS")
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            raise BusyError from None
        raise SceneError(path, f"cannot be locked ({error.strerror})", "name another folder with --output") from error
    return True


def _is_same_file(descriptor: int, path: Path) -> bool:
    """Whether the open file still has that name; its last holder may have removed it."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False


def _write(descriptor: int, what: str, **facts: bool) -> None:
    text = json.dumps({"host": socket.gethostname(), "pid": os.getpid(), "what": what, **facts}).encode()
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, text, 0)


def _read(descriptor: int) -> dict[str, object]:
    try:
        value = json.loads(os.pread(descriptor, 1 << 16, 0))
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


@contextmanager
def run_lock(folder: Path, name: str) -> Iterator[None]:
    """A block of a run, which shares the folder only with runs of the same name, see :meth:`BatchOptions.name`.

    A UsageError if a run of another name uses the folder, a SceneError if the file cannot be made.
    """
    path = folder / LOCKS / f"{RUN}.lock"
    deadline = time.monotonic() + LOCK_TIMEOUT
    while (joined := _join_run(path, name)) is None:
        if time.monotonic() > deadline:
            raise UsageError(f"{folder}: another batch is at work there; name another --output")
        time.sleep(0.05)
    descriptor, holder = joined
    try:
        if holder["what"] != name:
            raise UsageError(
                f"{folder}: a batch with other settings is at work there (process {holder['pid']} on"
                f" {holder['host']}); wait for it, or name another --output"
            )
        yield
    finally:
        _leave(descriptor, path)


def _join_run(path: Path, name: str) -> tuple[int, dict[str, object]] | None:
    """The open file with a shared lock, and its content; None where it has to be tried again."""
    try:
        descriptor, _ = _acquire(path)
        _write(descriptor, name)
    except BusyError:
        descriptor = _open(path)
    with suppress(BusyError):
        _lock(descriptor, path, shared=True)  # between the two locks another run may have had it
        holder = _read(descriptor)
        if _is_same_file(descriptor, path) and {"what", "pid", "host"} <= holder.keys():
            return descriptor, holder
    os.close(descriptor)
    return None


def _leave(descriptor: int, path: Path) -> None:
    """Unlock; the last run removes the lock's file, and the folder of locks if no scene was left unfinished."""
    try:
        with suppress(BusyError, OSError, SceneError):  # other runs use the folder, or unfinished scenes are left in it
            _lock(descriptor, path, shared=False)
            path.unlink(missing_ok=True)
            path.parent.rmdir()
    finally:
        os.close(descriptor)
