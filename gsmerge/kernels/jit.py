"""The one place that configures numba.

Compiled kernels are cached where the user may write: ``GSMERGE_CACHE_DIR`` if it is set, beside the sources, in the
user's cache folder, or below the system's temporary one, whichever is the first that can be written. The folder's
name carries a hash of all kernel sources: numba checks a kernel's own file alone and would go on using an old copy of
what it inlined from another.
"""

from __future__ import annotations

import hashlib
import os
import stat
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

OURS = "GSMERGE_COMMAND"  # set in processes that run nothing but the command line


def _import_numba() -> Any:
    """Import numba; in processes of our own without SciPy's BLAS, which no kernel needs and which takes 0.2 s."""
    hidden = "scipy.linalg" if OURS in os.environ and "scipy.linalg" not in sys.modules else None
    if hidden:
        sys.modules[hidden] = None  # type: ignore[assignment]
    try:
        import numba.np.arraymath

        return numba
    finally:
        if hidden:
            del sys.modules[hidden]


numba = _import_numba()

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
    """Where this version's compiled kernels are kept."""
    given = os.environ.get("GSMERGE_CACHE_DIR") or os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(given)] if given else [Path(__file__).parent / "__pycache__", *_user_folders()]
    name = f"kernels-{_sources_hash()}"
    for place in places:
        if _writable(place):
            return place / name
    return _temporary_folder() / name


_CACHE = str(cache_folder())


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
        config: Any = numba.config
        before, config.CACHE_DIR = config.CACHE_DIR, _CACHE
        try:
            return numba.njit(
                cache=True,
                nogil=True,
                error_model="numpy",
                fastmath=False if exact else set(FAST),
                inline="always" if inline or f.__name__.startswith("_") else "never",
                forceinline=part,
            )(f)
        finally:
            config.CACHE_DIR = before

    return wrap(function) if function is not None else wrap
