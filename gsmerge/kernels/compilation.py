"""Notice when kernels are compiled rather than loaded from the cache."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager

from numba.core import event


class _FirstStart(event.Listener):
    """Event listener that calls back at the first compilation, from whichever thread compiles."""

    def __init__(self, callback: Callable[[], None]) -> None:
        self.callback: Callable[[], None] | None = callback

    def on_start(self, _: object) -> None:
        callback, self.callback = self.callback, None
        if callback is not None:
            callback()

    def on_end(self, _: object) -> None:
        pass


def watch_compilation(callback: Callable[[], None]) -> AbstractContextManager[None]:
    """Call ``callback`` once in the block, before the first kernel that has to be compiled.

    A kernel that is found in the cache does not count.
    """
    return event.install_listener("numba:compile", _FirstStart(callback))
