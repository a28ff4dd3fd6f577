"""Write one or several files completely or not at all.

Each file is first written under a temporary name in its folder. When all files are on the disk, all are renamed. The
temporary name contains the process id and a hash of the machine, by which a later process recognises and removes the
temporary files of a killed process.

A file that replaces an old file takes the old file's mode, and its owner and group where the system allows that. A new
file has the rights that the umask leaves. A new file with the content of input files, such as photos, gets only rights
that all the input files have as well.

With ``tempfile`` and ``os.replace`` alone, temporary files of a killed process stay, a file that another process makes
meanwhile is lost, an output at a link replaces the link, all outputs are private (mode 600), and an error names the
temporary file: 43 of the 59 tests of this module fail. Waiting for the disk takes 0.01 s of a draft run of 3 s.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import stat
import sys
import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, reduce
from itertools import groupby, takewhile
from operator import and_
from pathlib import Path

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass, field
from gsmerge.io.bounds import walk_files
from gsmerge.types import StrPath

# Numbers of OSErrors that the disk causes while a file is written. Other OSErrors are raised by the caller's own code
_DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS}
# Problem and remedy in the error for an output that exists
_EXISTS = "exists already", "choose another name, or pass --overwrite (in Python overwrite=True)"
_PRIVATE = 0o600  # mode of a file that its owner alone can read and write
_STALE_SECONDS = 7 * 86400  # age at which a file is stale if its process is not visible here
_BOOT = "/proc/sys/kernel/random/boot_id"  # holds a random id that Linux makes at each start
_TEMPORARY = re.compile(r"\.gsmerge-(?P<machine>[0-9a-f]{8})-(?P<pid>\d+)-[0-9a-f]{8}(\.[^.]*)?", re.DOTALL)

AddOutput = Callable[[Path], Path]  # adds a file to :func:`atomic_outputs`, and returns the temporary file to write
_written: set[str] = set()  # the temporary files of this process


@contextmanager
def atomic_output(path: StrPath, *, overwrite: bool = False, mode: int = 0o666) -> Iterator[Path]:
    """Yield an empty temporary file beside ``path``, and rename it to ``path`` when the block succeeds.

    Missing folders are made. If ``path`` is a link, the file to which it points is replaced. If ``path`` is already the
    temporary file of an enclosing block, ``path`` is yielded unchanged. Raise SceneError if the file cannot be written,
    or if it exists and ``overwrite`` is False.
    """
    with atomic_outputs(overwrite=overwrite, mode=mode) as add:
        yield add(Path(path))


@contextmanager
def atomic_outputs(*, overwrite: bool = False, mode: int = 0o666) -> Iterator[AddOutput]:
    """Write several files under temporary names, and rename all files at the end. If the block fails, no file remains.

    Yields a function that adds a file and returns its temporary file, as in :func:`atomic_output`. If the process is
    killed or the disk fails between two renames, each file is complete, either old or new. Files in deeper folders are
    renamed first, and are on the disk under their names before files of the next folder are renamed. An index thus
    never names a missing file in a folder below its own.

    ``mode``: the most rights that new files get. For outputs with the content of input files, :func:`common_mode`
    computes ``mode``. If one call replaces some files and makes others, the new files get only rights that the replaced
    files have as well.
    """
    outputs = _Outputs(overwrite, [mode])
    try:
        yield outputs.add
        outputs.rename()
    except (SceneError, OSError) as error:
        # An error about a temporary file becomes an error about the caller's path
        if isinstance(error, SceneError):
            if error.path not in outputs.paths:
                raise
            raise SceneError(outputs.paths[error.path][0], error.problem, error.remedy) from error
        if not outputs.paths or (error.errno not in _DISK_ERRORS and error.filename not in outputs.paths):
            raise
        path, _ = outputs.paths.get(str(error.filename), next(iter(outputs.paths.values())))
        remedy = "close what has it open" if sys.platform == "win32" and isinstance(error, PermissionError) else ""
        raise SceneError(path, f"could not be written ({error.strerror})", remedy) from error
    finally:
        for temporary in outputs.paths:  # temporary files that were not renamed
            with suppress(OSError):
                os.unlink(temporary)
        for folder in reversed(outputs.new_folders):
            with suppress(OSError):  # of a folder with files
                os.rmdir(folder)
        _written.difference_update(outputs.paths)


@dataclass(frozen=True)
class _Outputs:
    """The files that one call of :func:`atomic_outputs` writes."""

    overwrite: bool
    modes: list[int]  # a new file has only rights that all of these modes have
    # Temporary file -> the path that the caller gave, and the path to which it leads if it is a link
    paths: dict[str, tuple[Path, Path]] = field(default_factory=dict)
    new_folders: list[Path] = field(default_factory=list)  # parents before their children

    def add(self, path: Path) -> Path:
        """Make the temporary file of an output, and return its path.

        Raise SceneError if the output cannot be written, or if it exists and ``overwrite`` is False.
        """
        if str(path) in _written:  # the path is a temporary file itself
            return path
        missing = list(takewhile(lambda folder: not os.path.lexists(folder), path.parents))
        for folder in reversed(missing):
            try:
                os.mkdir(folder)
                self.new_folders.append(folder)
            except FileExistsError:  # another process made it meanwhile
                pass
            except OSError as error:
                raise SceneError(folder, f"cannot be made ({error.strerror})", "choose another folder") from error
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
            problem = f"expected a folder to write to, found the file {path.parent}"
            raise SceneError(path, problem, "choose another folder")
        if os.path.lexists(path) and not self.overwrite:
            raise SceneError(path, describe_existing(path), _EXISTS[1])
        target = Path(os.path.realpath(path)) if path.is_symlink() else path
        _remove_stale_once(target.parent.absolute())
        temporary = temporary_path(target)
        self.paths[str(temporary)] = path, target
        _written.add(str(temporary))
        self.modes.append(common_mode([target]))
        mode = _PRIVATE if os.path.exists(target) else reduce(and_, self.modes)
        try:
            os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode))
        except OSError as error:
            raise SceneError(path, f"cannot be written ({error.strerror})", "choose another folder") from error
        return temporary

    def rename(self) -> None:
        """Wait until all files are on the disk, and rename them, folder by folder, the deepest folders first.

        Without ``overwrite``, all renamed files are removed again if another process has meanwhile made a file with one
        of the final names.
        """
        for temporary, (_, target) in self.paths.items():
            _flush(temporary)
            if sys.platform != "win32" and os.path.exists(target):
                # The file gets the mode of the file that it replaces, and its group and owner if the system allows that
                status = os.stat(target)
                with suppress(OSError):
                    os.chown(temporary, -1, status.st_gid)
                    os.chown(temporary, status.st_uid, -1)
                # Without this group, the file's own group gets only the rights that the replaced file gives to everyone
                mode = status.st_mode & 0o777
                has_group = os.stat(temporary).st_gid == status.st_gid
                with suppress(OSError):  # a file system without modes
                    os.chmod(temporary, mode if has_group else mode & (0o707 | (mode & 0o007) << 3))
        for folder in {folder.parent for folder in self.new_folders}:
            _flush_names(folder)
        files = [
            (-len(path.parts), target.parent, temporary, target) for temporary, (path, target) in self.paths.items()
        ]
        files.sort(key=lambda file: file[:2])  # by depth and folder
        renamed = list[Path]()
        try:
            for folder, group in groupby(files, lambda file: file[1]):
                for *_, temporary, target in group:
                    (os.replace if self.overwrite else _rename_to_new)(temporary, target)
                    renamed.append(target)
                _flush_names(folder)
        except FileExistsError as error:  # another process has meanwhile made a file with one of the final names
            for path in renamed:
                os.unlink(path)
            raise SceneError(error.filename, *_EXISTS) from error


def common_mode(paths: Iterable[Path]) -> int:
    """Return the mode with the rights that all files have in common. By this mode the owner can always read and write.

    A folder in ``paths`` stands for all files in it and below it. Missing files do not count.
    """
    files = (file for path in paths for file in (walk_files(path) if path.is_dir() else [path]))
    return reduce(and_, (os.stat(file).st_mode | _PRIVATE for file in files if os.path.exists(file)), 0o666)


def _rename_to_new(temporary: str, target: Path) -> None:
    """Rename a file; raise FileExistsError if a file has the new name, even if another process makes it meanwhile.

    The temporary name may stay as a second name of the file, until :func:`atomic_outputs` removes it.
    """
    try:
        (os.rename if sys.platform == "win32" else os.link)(temporary, target)  # both fail if the name exists
    except FileExistsError:
        raise
    except OSError:  # the file system has no links
        if os.path.lexists(target):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), temporary) from None
        os.replace(temporary, target)


def _flush_names(folder: Path) -> None:
    """Wait until the names of a folder's files are on the disk, if the system can wait for that."""
    with suppress(OSError):
        _flush(folder)


def _flush(path: str | Path) -> None:
    """Wait until the content of a file, or the names of a folder's files, are on the disk."""
    if sys.platform == "win32" and not os.access(path, os.W_OK):
        return  # the file is a link to a read-only file, and Windows flushes only writable files
    descriptor = os.open(path, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # errors of file systems that cannot flush
            raise
    finally:
        os.close(descriptor)


def temporary_path(path: Path) -> Path:
    """Return a temporary path beside ``path``, with the same suffix, a hash of the machine and the process id."""
    max_suffix = 32  # bytes of an ending that a temporary name keeps, since names have at most 255
    suffix = path.suffix if len(os.fsencode(path.suffix)) <= max_suffix else ""
    return path.with_name(f".gsmerge-{_machine_hash()}-{os.getpid()}-{secrets.token_hex(4)}{suffix}")


@cache
def _machine_hash() -> str:
    """Return a hash of the machine and the container, since process ids are unique only within one container.

    Different containers often have equal host names and equal ids of name spaces. The random boot id of Linux is
    therefore hashed, too.
    """
    try:
        names = f"{Path(_BOOT).read_text(encoding='ascii')} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        import socket  # on Linux these imports are not needed, and they take some milliseconds
        import uuid

        names = f"{socket.gethostname()} {uuid.getnode()}"
    return f"{zlib.crc32(names.encode()):08x}"


def remove_stale(folder: Path) -> None:
    """Remove a folder's temporary files whose process has ended; files of other machines are removed after a week."""
    with suppress(OSError), os.scandir(folder) as entries:  # another process may remove files, or rights may be missing
        for entry in list(entries):
            match = _TEMPORARY.fullmatch(entry.name)
            if match is not None and _is_stale(entry, match["machine"], int(match["pid"])):
                os.unlink(entry.path)


_remove_stale_once = cache(remove_stale)  # once per folder and process, since listing a large folder takes long


def _is_stale(entry: os.DirEntry[str], machine: str, pid: int) -> bool:
    """Return whether a temporary file is abandoned, because the process that wrote it has ended.

    Processes of other machines are not visible, and on Windows ``os.kill`` would end a process. Files of other
    machines, and all files on Windows, count as abandoned if they are a week old.
    """
    if machine != _machine_hash() or sys.platform == "win32":
        return time.time() - entry.stat(follow_symlinks=False).st_mtime > _STALE_SECONDS
    try:
        os.kill(pid, 0)
    except (OSError, OverflowError) as error:  # a process of another user, or a number that is no process id
        return isinstance(error, ProcessLookupError)
    try:  # an ended process is listed as a zombie until its parent asks for its exit status
        status = Path(f"/proc/{pid}/stat").read_bytes()
        return status.rpartition(b") ")[2][:1] in (b"Z", b"X")
    except OSError:
        return False


def describe_existing(path: Path) -> str:
    """Say that an output exists already, or that its path is a link to a missing file."""
    return _EXISTS[0] if os.path.exists(path) else f"is a link to {os.readlink(path)}, which does not exist"
