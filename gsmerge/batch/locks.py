"""Who works on what: locks that end with the process that holds them, however it ends.

They lie in a folder of their own in the output folder. A lock file that is there and that nobody holds says that a
process was killed over this scene: what it left half-done may be removed, and its result replaced.
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
from pathlib import Path

from gsmerge.errors import SceneError, UsageError

try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None  # type: ignore[assignment]

LOCKS = ".batch"
RUN = "run"
PATIENCE = 10.0  # seconds: a run holds the folder alone for an instant only


class BusyError(Exception):
    """Another process holds the lock."""


class Lock:
    """A lock that this process holds.

    Args:
        path: Its file.
        abandoned: Whether a process was killed while it held it.
        fresh: Whether there was no result before the first process that held it.
    """

    def __init__(self, path: Path, *, abandoned: bool, fresh: bool) -> None:
        self.path, self.abandoned, self.fresh = path, abandoned, fresh

    def finish(self) -> None:
        """Nothing is left half-done: the file goes, and with it the memory of it."""
        self.path.unlink(missing_ok=True)
        with suppress(OSError):  # others' locks are in there
            self.path.parent.rmdir()


@contextmanager
def scene_lock(folder: Path, outputs: Sequence[str]) -> Iterator[Lock]:
    """A block in which nobody else works on a result; its file stays unless :meth:`Lock.finish` is called.

    Args:
        folder: The output folder.
        outputs: Names of the result and of its further levels.

    Raises:
        BusyError: If another process does.
        SceneError: If the file cannot be made.
    """
    path = folder / LOCKS / f"{hashlib.sha256(outputs[0].encode(errors='surrogateescape')).hexdigest()[:32]}.lock"
    descriptor, abandoned = _acquired(path)
    try:
        fresh = not any(os.path.lexists(folder / name) for name in outputs)
        if abandoned:
            fresh = _read(descriptor).get("fresh") is True
        _write(descriptor, outputs[0], fresh=fresh)
        yield Lock(path, abandoned=abandoned, fresh=fresh)
    finally:
        os.close(descriptor)


def _acquired(path: Path) -> tuple[int, bool]:
    """The open, locked file, and whether it was there before."""
    while True:
        descriptor = _opened(path)
        try:
            if _locked(descriptor, path, shared=False) and _is_still(descriptor, path):
                return descriptor, os.fstat(descriptor).st_size > 0
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _opened(path: Path) -> int:
    while True:
        try:
            path.parent.mkdir(exist_ok=True)
            return os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            if isinstance(error, FileNotFoundError) and path.parent.parent.is_dir():
                continue  # another run ended and removed the folder of locks
            raise SceneError(
                path, f"cannot be written ({error.strerror})", "name another folder with --output"
            ) from error


def _locked(descriptor: int, path: Path, *, shared: bool) -> bool:
    """Take the lock.

    Raises:
        BusyError: If another process holds it.
        SceneError: If the file system knows no locks.
    """
    if fcntl is None:
        raise SceneError(path, "expected a system with file locks, found none", "run batches on Linux or macOS")
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            raise BusyError from None
        raise SceneError(path, f"cannot be locked ({error.strerror})", "name another folder with --output") from error
    return True


def _is_still(descriptor: int, path: Path) -> bool:
    """Whether the file is the one of that name; who held it before may have removed it."""
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
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}


@contextmanager
def run_lock(folder: Path, name: str) -> Iterator[None]:
    """A block of a run, beside others that make the same of the same scenes, and no others.

    Args:
        folder: The output folder.
        name: One for all runs that may share it.

    Raises:
        UsageError: If a run of another name is at work.
        SceneError: If the file cannot be made.
    """
    path = folder / LOCKS / f"{RUN}.lock"
    deadline = time.monotonic() + PATIENCE
    while (found := _joined(path, name)) is None:
        if time.monotonic() > deadline:
            raise UsageError(f"{folder}: another batch is at work there; name another --output")
        time.sleep(0.05)
    descriptor, holder = found
    try:
        if holder["what"] != name:
            raise UsageError(
                f"{folder}: a batch with other settings is at work there (process {holder['pid']} on"
                f" {holder['host']}); wait for it, or name another --output"
            )
        yield
    finally:
        _leave(descriptor, path)


def _joined(path: Path, name: str) -> tuple[int, dict[str, object]] | None:
    """The open file, locked together with other runs, and who wrote it; None where it has to be tried again."""
    try:
        descriptor, _ = _acquired(path)
        _write(descriptor, name)
    except BusyError:
        descriptor = _opened(path)
    try:
        _locked(descriptor, path, shared=True)  # between the two locks another run may have had it
        holder = _read(descriptor)
        if _is_still(descriptor, path) and {"what", "pid", "host"} <= holder.keys():
            return descriptor, holder
    except BusyError:
        pass
    os.close(descriptor)
    return None


def _leave(descriptor: int, path: Path) -> None:
    """The last run of a folder takes the lock's file with it, and the folder if no scene was left half-done."""
    try:
        _locked(descriptor, path, shared=False)
        path.unlink(missing_ok=True)
        path.parent.rmdir()
    except (BusyError, OSError, SceneError):
        pass  # others are at work, or what they left is still to be seen to
    finally:
        os.close(descriptor)
