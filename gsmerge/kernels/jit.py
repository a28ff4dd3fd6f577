"""The one place that configures numba.

Compiled kernels are cached where the user may write, even if the package folder may not be: numba's own choice
(``__pycache__`` beside the source, then the user's cache folder) unless neither is writable, then a folder below
the system's temporary one.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

# Reassociation lets sums vectorise; NaN and inf keep their meaning, so that bad input is not optimised away.
FAST = frozenset({"contract", "nsz", "arcp", "reassoc"})


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _choose_cache() -> None:
    """Point numba at a temporary folder when neither the package nor the user's cache can be written."""
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "numba"
    if "NUMBA_CACHE_DIR" in os.environ or _writable(Path(__file__).parent / "__pycache__") or _writable(user):
        return
    os.environ["NUMBA_CACHE_DIR"] = str(Path(tempfile.gettempdir()) / f"gsmerge-kernels-{os.getuid()}")


_choose_cache()

from numba import njit  # noqa: E402 - the cache folder is read at import


def kernel(function: Callable[..., Any] | None = None, *, inline: bool = False, exact: bool = False) -> Any:
    """Compile a kernel: cached, without the GIL, with float rules that keep NaN and inf.

    Args:
        function: The function, when used as a plain decorator.
        inline: Inline at every call (for the small pieces of a loop).
        exact: No reassociation at all (for code whose order of operations matters).
    """

    def wrap(f: Callable[..., Any]) -> Any:
        return njit(
            cache=True,
            nogil=True,
            error_model="numpy",
            fastmath=False if exact else set(FAST),
            inline="always" if inline else "never",
        )(f)

    return wrap(function) if function is not None else wrap
