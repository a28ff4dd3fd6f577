"""The one place that configures numba.

Compiled kernels are cached where the user may write: ``GSMERGE_CACHE_DIR`` if it is set, beside the sources, in the
user's cache folder, or below the system's temporary one, whichever is the first that can be written. The folder's
name carries a hash of all kernel sources: numba looks at a kernel's own file alone and would go on with an old copy of
what it inlined from another.
"""

from __future__ import annotations

import getpass
import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

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
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """Where this version's compiled kernels are kept."""
    given = os.environ.get("GSMERGE_CACHE_DIR") or os.environ.get("NUMBA_CACHE_DIR")
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gsmerge"
    places = [Path(given)] if given else [Path(__file__).parent / "__pycache__", user]
    name = f"kernels-{_sources_hash()}"
    for place in places:
        if _writable(place):
            return place / name
    return Path(tempfile.gettempdir()) / f"gsmerge-{getpass.getuser()}" / name


_CACHE = str(cache_folder())


def kernel(function: Callable[..., Any] | None = None, *, inline: bool = False, exact: bool = False) -> Any:
    """Compile a kernel: cached, without the GIL, with float rules that keep NaN and inf.

    Args:
        function: The function, when used as a plain decorator.
        inline: Inline at every call (for the small pieces of a loop).
        exact: No reassociation at all (for code whose order of operations matters).
    """

    def wrap(f: Callable[..., Any]) -> Any:
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, _CACHE
        try:
            return numba.njit(
                cache=True,
                nogil=True,
                error_model="numpy",
                fastmath=False if exact else set(FAST),
                inline="always" if inline else "never",
            )(f)
        finally:
            numba.config.CACHE_DIR = before

    return wrap(function) if function is not None else wrap
