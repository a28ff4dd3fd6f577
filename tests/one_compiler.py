"""Test processes that start with an empty cache side by side: a kernel that one compiles, the others wait for."""

from __future__ import annotations

import fcntl
from pathlib import Path
from typing import Any

from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

from gsmerge.kernels.jit import cache_folder


def compile_once() -> None:
    """Lock every kernel while it is loaded or compiled; kernels that it calls are locked in turn."""
    folder, compile_alone = Path(cache_folder()), Dispatcher.compile
    folder.mkdir(parents=True, exist_ok=True)

    def compile_locked(self: Any, signature: Any) -> Any:
        # numba's own lock goes first: two threads of a process would take the two in different orders
        with global_compiler_lock, (folder / f"{self.py_func.__name__}.lock").open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            return compile_alone(self, signature)

    Dispatcher.compile = compile_locked
