"""The process's memory: how much it took, and handing back what is no longer used."""

from __future__ import annotations

import ctypes
import sys


def peak_memory() -> int:
    """Largest resident memory of this process so far, bytes; 0 where the system does not tell."""
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def release_memory() -> None:
    """Return freed memory to the system.

    glibc keeps what a thread has freed for that thread; between stages that each need a lot of it, in other
    threads, this is a tenth of the peak. Does nothing on other systems.
    """
    if sys.platform == "linux":
        try:
            ctypes.CDLL(None).malloc_trim(0)
        except (OSError, AttributeError):
            return
