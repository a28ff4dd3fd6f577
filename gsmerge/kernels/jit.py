"""The one place that configures numba.

Compiled kernels are cached where the user may write: ``GSMERGE_CACHE_DIR`` if it is set, beside the sources, in the
user's cache folder, or below the system's temporary one, whichever is the first that can be written. The folder's
name carries a hash of all kernel sources: numba checks a kernel's own file alone and would go on using an old copy of
what it inlined from another. Files in it end in a checksum: what a power loss or a full disk damaged is compiled again.
"""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import stat
import sys
import tempfile
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from gsmerge.errors import UsageError

OURS = "GSMERGE_COMMAND"  # set in processes that run nothing but the command line


def _import_numba() -> Any:
    """Import numba; in processes of our own without SciPy's BLAS, which no kernel needs and which takes 0.2 s.

    UsageError if a variable of the environment that numba reads is none that it can use, or turns it off.
    """
    threads = os.environ.get("NUMBA_NUM_THREADS", "1")
    if not threads.isdecimal() or int(threads) < 1:
        raise UsageError(f"NUMBA_NUM_THREADS: expected a number from 1 on, found {threads!r}; unset it")
    hidden = "scipy.linalg" if OURS in os.environ and "scipy.linalg" not in sys.modules else None
    if hidden:
        sys.modules[hidden] = None  # type: ignore[assignment]
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", "Environment variable 'NUMBA_")
            import numba.np.arraymath
    except RuntimeWarning as warning:
        raise UsageError(f"{str(warning).splitlines()[0].rstrip('.')}; unset it") from warning
    finally:
        if hidden:
            del sys.modules[hidden]
    config: Any = numba.config
    if config.DISABLE_JIT:
        raise UsageError("NUMBA_DISABLE_JIT: expected kernels that are compiled, found it set; unset it")
    return numba


numba = _import_numba()
from numba.core import caching  # noqa: E402 - as numba itself

# Reassociation lets sums vectorise; NaN and inf keep their meaning, so that bad input is not optimised away.
FAST = frozenset({"contract", "nsz", "arcp", "reassoc"})


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _sources_hash() -> str:
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _user_folders() -> list[Path]:
    """The user's cache folder; none for an account without a home."""
    try:
        return [Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gsmerge"]
    except RuntimeError:
        return []


def _temporary_folder() -> Path:
    """A folder that only the user can have written: machine code will be loaded from it."""
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = Path(tempfile.gettempdir()) / f"gsmerge-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:
        return Path(tempfile.mkdtemp(prefix="gsmerge-"))
    own = stat.S_ISDIR(status.st_mode) and (os.name == "nt" or (status.st_uid == user and not status.st_mode & 0o022))
    return folder if own else Path(tempfile.mkdtemp(prefix="gsmerge-"))


def cache_folder() -> Path:
    """Return the folder of this version's compiled kernels."""
    given = os.environ.get("GSMERGE_CACHE_DIR") or os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(given)] if given else [Path(__file__).parent / "__pycache__", *_user_folders()]
    name = f"kernels-{_sources_hash()}"
    for place in places:
        folder = place / name
        if _writable(place) and _writable(folder) and all(_writable(inside) for inside in folder.iterdir()):
            return folder  # folders in it may be another user's
    return _temporary_folder() / name


_CACHE = str(cache_folder())
_warned: set[str] = set()  # what was said in this process


def kernel(
    function: Callable[..., Any] | None = None, *, part: bool = False, inline: bool = False, exact: bool = False
) -> Any:
    """Compile a kernel: cached, without the GIL, with float rules that keep NaN and inf.

    What other kernels call must become part of each of them: otherwise every caller's machine code brings a copy of
    its own, optimised in its own way, all under one name, and which of them runs, and how it rounds, depends on what
    was compiled or loaded first. So functions whose names begin with an underscore are inlined by numba before types
    are known, which spares compiling them by themselves, and others that kernels call, inlined by LLVM, say ``part``.

    Args:
        function: The function, when used as a plain decorator.
        part: Other kernels call it.
        inline: Inline by numba, as those with an underscore.
        exact: No reassociation at all (for code whose order of operations matters).
    """

    def wrap(f: Callable[..., Any]) -> Any:
        made = numba.njit(
            nogil=True,
            error_model="numpy",
            fastmath=False if exact else set(FAST),
            inline="always" if inline or f.__name__.startswith("_") else "never",
            forceinline=part,
        )(f)
        config: Any = numba.config
        before, config.CACHE_DIR = config.CACHE_DIR, _CACHE
        try:
            made._cache = _Cache(f)
        except RuntimeError as error:  # nowhere to write: each process compiles anew
            _warn(f"kernels cannot be kept in {_CACHE} ({error})")
        finally:
            config.CACHE_DIR = before
        return made

    return wrap(function) if function is not None else wrap


class _CacheFiles(caching.IndexDataCacheFile):
    """numba's files of one kernel, each of which ends in a checksum; damaged ones count as missing."""

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[io.BytesIO]:
        content = io.BytesIO()
        yield content
        with super()._open_for_write(filepath) as file:
            file.write(content.getvalue() + _checksum(content.getvalue()))

    def _load_index(self) -> dict[Any, str]:
        content = _checked(self._index_path)
        if content is None:
            return {}
        file = io.BytesIO(content)
        if pickle.load(file) != self._version:
            return {}
        stamp, overloads = pickle.load(file)
        return overloads if stamp == self._source_stamp else {}

    def _load_data(self, name: str) -> Any:
        content = _checked(self._data_path(name))
        if content is None:
            raise FileNotFoundError
        return pickle.loads(content)


class _Cache(caching.FunctionCache):
    """numba's cache of one kernel, which never fails: what cannot be read is compiled, what cannot be written is not
    kept.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        whole = self._cache_file
        self._cache_file = _CacheFiles(self._cache_path, self._impl.filename_base, whole._source_stamp)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # whatever a file of the right checksum makes the libraries raise
            _warn(f"the compiled kernels in {self.cache_path} cannot be used ({type(error).__name__}): compiled again")
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _warn(f"compiled kernels cannot be kept in {self.cache_path} ({error.strerror})")


def _checksum(content: bytes) -> bytes:
    return zlib.crc32(content).to_bytes(4, "little")


def _checked(path: str) -> bytes | None:
    """Content of a file of the cache; None where there is none, or it is damaged."""
    try:
        whole = Path(path).read_bytes()
    except FileNotFoundError:
        return None
    if len(whole) > 4 and whole[-4:] == _checksum(whole[:-4]):
        return whole[:-4]
    _warn(f"a compiled kernel in {os.path.dirname(path)} is damaged: compiled again")
    return None


def _warn(message: str) -> None:
    """Warn once for each process and message, on the command line in one line."""
    if message not in _warned:
        _warned.add(message)
        warnings.warn(message, RuntimeWarning, stacklevel=2)
