"""Files that are either complete or not there, one or several together.

Each is written under another name beside its place, and renamed when all is done and on the disk. The name holds the
process that writes it and where that runs, so that the next process removes what a killed one left.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import socket
import stat
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from gsmerge.errors import SceneError

# What the disk itself may answer in the middle of writing; any other OSError is the caller's own.
_DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS}
_MAX_STEM, _MAX_SUFFIX = 100, 32  # bytes of a name that its temporary one keeps: names end at 255
_TEMPORARY = re.compile(r"\..*-[0-9a-f]{8}-(?P<place>[0-9a-f]{8})-(?P<pid>\d+)-[0-9a-f]{8}(\.[^.]*)?", re.DOTALL)

_written: set[str] = set()  # the temporary files of this process
_clean: set[str] = set()  # folders in which it has looked for those of dead ones


@contextmanager
def atomic_output(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary file next to ``path``, renamed to it when the block succeeds and removed when it fails.

    Args:
        path: The file to be written. Its folder must exist. A link stays one: the file that it leads to is replaced.
        overwrite: Replace an existing file; without it one is refused, before the block is entered.

    Yields:
        An empty file in the same folder with the same suffix, to be written by the block. For a file that such a block
        yielded, the file itself.

    Raises:
        SceneError: If the file exists and may not be replaced, or the folder cannot be written.
    """
    with atomic_outputs(overwrite=overwrite) as add:
        yield add(Path(path))


@contextmanager
def atomic_outputs(*, overwrite: bool = False) -> Iterator[Callable[[Path], Path]]:
    """A block that writes several files, all of them or none: the function makes each, as :func:`atomic_output`.

    Where one cannot take its name, the others lose theirs, and earlier files of these names are back. A process that is
    killed while the files take their names leaves each whole, old or new.
    """
    made: dict[str, tuple[Path, Path]] = {}  # temporary file -> as it was asked for, where it goes

    def add(path: Path) -> Path:
        if str(path) in _written:
            return path
        _refuse(path, overwrite)
        target = Path(os.path.realpath(path)) if path.is_symlink() else path
        remove_stale(target.parent)
        temporary = temporary_path(target)
        made[str(temporary)] = path, target
        _written.add(str(temporary))
        try:
            os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        except OSError as error:
            raise SceneError(path, f"cannot be written ({error.strerror})", "choose another folder") from error
        return temporary

    try:
        yield add
        for path, _ in made.values():
            _refuse(path, overwrite)  # somebody else may have been quicker
        for temporary in made:
            _flush(temporary)
        _rename_all([(temporary, target) for temporary, (_, target) in made.items()])
        for folder in {target.parent for _, target in made.values()}:
            with suppress(OSError):  # not every system can
                _flush(folder)
    except SceneError as error:
        if error.path not in made:
            raise
        path = made[error.path][0]  # the temporary name means nothing to the caller
        raise SceneError(path, error.problem, error.remedy) from error
    except OSError as error:
        if not made or (error.errno not in _DISK_ERRORS and error.filename not in made):
            raise
        path = made.get(str(error.filename), next(iter(made.values())))[0]
        raise SceneError(path, f"could not be written ({error.strerror})") from error
    finally:
        _remove(made)
        _written.difference_update(made)


def _rename_all(files: list[tuple[str, Path]]) -> None:
    """Give all temporary files their names, or, where one cannot take its own, none."""
    earlier: dict[str, str] = {}  # temporary file -> another name of what it replaces
    try:
        for temporary, target in files[:-1]:  # once the last has its name, nothing is to be undone
            if os.path.lexists(target):
                earlier[temporary] = str(temporary_path(target))
                _keep(target, earlier[temporary])
        for temporary, target in files:
            os.replace(temporary, target)
    except BaseException:
        for temporary, target in reversed(files):
            if not os.path.lexists(temporary):  # it has taken its name
                _put_back(target, earlier.pop(temporary, None))
        _remove(earlier.values())
        raise
    _remove(earlier.values())


def _keep(target: Path, other: str) -> None:
    """Give a file another name beside its own, so that it is there at every moment."""
    try:
        try:
            os.link(target, other)
        except OSError:  # not every file system has links, and not every file may be linked to
            shutil.copy2(target, other)
    except OSError as error:
        problem = f"could not be kept until all files are written ({error.strerror})"
        raise SceneError(target, problem, "remove it first") from error


def _put_back(target: Path, other: str | None) -> None:
    """Give a name back to the file that had it before, or to none."""
    try:
        if other is None:
            os.unlink(target)
        else:
            os.replace(other, target)
    except OSError as error:
        remedy = "remove it" if other is None else f"what was there before is {other}, move it before the next run"
        raise SceneError(target, f"is new, but other files are not ({error.strerror})", remedy) from error


def _remove(paths: Iterable[str]) -> None:
    for path in paths:
        with suppress(OSError):
            os.unlink(path)


def _flush(path: str | Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # file systems that know no such thing
            raise
    finally:
        os.close(descriptor)


def temporary_path(path: Path) -> Path:
    """A name for what will be ``path``, which says who writes it."""
    return path.with_name(f"{_start(path)}-{_place()}-{os.getpid()}-{secrets.token_hex(4)}{_suffix(path)}")


def _start(path: Path) -> str:
    """What the names of an output's temporary files start with, and no other output's."""
    name = os.fsencode(path.name)
    return f".{os.fsencode(path.stem)[:_MAX_STEM].decode('utf-8', 'ignore')}-{zlib.crc32(name):08x}"


def _suffix(path: Path) -> str:
    return path.suffix if len(os.fsencode(path.suffix)) <= _MAX_SUFFIX else ""


@cache
def _place() -> str:
    """Where process numbers mean the same: the machine, and the container."""
    names = socket.gethostname()
    with suppress(OSError):
        names += os.readlink("/proc/self/ns/pid")
    return f"{zlib.crc32(names.encode()):08x}"


def remove_stale(folder: Path) -> None:
    """Remove the temporary files that processes of this machine left in a folder and that run no more; once."""
    if os.path.realpath(folder) in _clean or os.name == "nt":
        return
    _clean.add(os.path.realpath(folder))
    with suppress(OSError), os.scandir(folder) as entries:  # another may be cleaning as well, or may not
        for entry in list(entries):
            match = _TEMPORARY.fullmatch(entry.name)
            if match is not None and match["place"] == _place() and not _runs(int(match["pid"])):
                if entry.is_dir(follow_symlinks=False):
                    shutil.rmtree(entry.path, ignore_errors=True)
                else:
                    os.unlink(entry.path)


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # another user's
        return True
    return True


def remove_leftovers(path: Path) -> None:
    """Remove all temporary files of this output, on whatever machine it was written; nobody may be writing it."""
    name = re.compile(rf"{re.escape(_start(path))}-[0-9a-f]{{8}}-\d+-[0-9a-f]{{8}}{re.escape(_suffix(path))}")
    try:
        with os.scandir(path.parent) as entries:
            leftovers = [entry.path for entry in entries if name.fullmatch(entry.name)]
        for leftover in leftovers:
            os.unlink(leftover)
    except OSError as error:
        raise SceneError(path, f"its temporary files cannot be removed ({error.strerror})") from error


def _refuse(path: Path, overwrite: bool) -> None:
    """Refuse an output that cannot be written or may not be replaced, as a SceneError."""
    try:
        status = os.stat(path)
    except FileNotFoundError:
        status = None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise SceneError(path, f"cannot be written ({reason})", "choose another name") from error
    if status is not None and stat.S_ISDIR(status.st_mode):
        raise SceneError(path, "expected a file to write, found a folder", "name a file in it")
    if status is not None and not stat.S_ISREG(status.st_mode):
        raise SceneError(path, "expected a file to write, found a pipe or a device", "name a file")
    if not os.path.isdir(path.parent):
        raise SceneError(path, f"the folder {path.parent} does not exist", "make it first")
    if os.path.lexists(path) and not overwrite:
        raise SceneError(path, "exists already", "choose another name or allow overwriting")
