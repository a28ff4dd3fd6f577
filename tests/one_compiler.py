"""Test processes that start with an empty cache side by side: a kernel that one compiles, the others wait for."""

from __future__ import annotations

import fcntl
from typing import Any

from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

from gsmerge.kernels.jit import cache_folder


def compile_once() -> None:
    """Lock every kernel that Python calls while it is loaded or compiled, with all kernels that it calls."""
    folder, compile_alone = cache_folder(), Dispatcher.compile
    folder.mkdir(parents=True, exist_ok=True)
    under_way: list[Any] = []

    def compile_locked(self: Any, signature: Any) -> Any:
        with global_compiler_lock:  # first, or two threads of a process would take the two locks in different orders
            if under_way:
                return compile_alone(self, signature)
            name = f"{self.py_func.__module__}.{self.py_func.__name__}.lock"
            with (folder / name).open("w") as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                under_way.append(self)
                try:
                    return compile_alone(self, signature)
                finally:
                    under_way.pop()

    Dispatcher.compile = compile_locked
