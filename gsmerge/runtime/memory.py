"""Measure and estimate memory, keep large arrays in files, and release unused memory."""

from __future__ import annotations

import ctypes
import math
import mmap
import os
import sys
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from weakref import WeakSet

import numpy as np

# Files with the memory limit of a control group, version 2 and version 1
LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
MAPPED_BYTES = 1 << 28  # arrays of this size or more are mapped from files
# Bytes of memory that a run needs
BYTES_FIXED = 250_000_000  # for the interpreter and the libraries
BYTES_PER_GAUSSIAN = 150  # for each Gaussian of the scene, without higher harmonics
BYTES_PER_VALUE = 4.5  # for each value of higher harmonics, in the scene and in some of its groups
BYTES_PER_PIXEL = 90  # for the photo as floats, and arrays of segmentation and rendering
# Bytes that a conversion to .sog or .glb needs for each Gaussian, and for each value of higher harmonics. A conversion
# to .ply needs a third of these bytes
BYTES_CONVERTED = 330
BYTES_CONVERTED_VALUE = 6
BYTES_ELSEWHERE = 40  # for each Gaussian outside of the block that is in memory
FEWER_PIXELS = (
    "use fewer views (gsmerge extend adds more later), export without higher harmonics, or try --effort draft"
)
_own_pages: WeakSet[mmap.mmap] = WeakSet()  # maps that this module has made; only their pages may be discarded


def peak_memory() -> int:
    """Return the peak resident memory of this process in bytes."""
    if sys.platform == "win32":
        counters = (ctypes.c_uint64 * 9)(72)  # PROCESS_MEMORY_COUNTERS; it begins with its size, and the peak follows
        ctypes.windll.kernel32.K32GetProcessMemoryInfo(ctypes.c_void_p(-1), counters, 72)
        return counters[1]
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def machine_memory() -> int | None:
    """Return the bytes of memory of this machine, or the limit of its control group if lower; None if unknown."""
    if sys.platform == "win32":
        return _memory_status()[1]
    limits = []
    with suppress(OSError, ValueError):
        limits.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for path in LIMITS:
        with suppress(OSError, ValueError):  # the text "max" means no limit
            limits.append(int(Path(path).read_text(encoding="ascii")))
    return min((limit for limit in limits if limit > 0), default=None)


def free_memory() -> int | None:
    """Return how many bytes of memory new processes can take; None if unknown."""
    if sys.platform == "win32":
        return _memory_status()[2]
    with suppress(OSError, KeyError, ValueError), open("/proc/meminfo", encoding="ascii") as file:
        values = dict(line.split(":", 1) for line in file)
        return int(values["MemAvailable"].split()[0]) * 1024
    return machine_memory()


def _memory_status() -> list[int]:
    """Return the struct MEMORYSTATUSEX of Windows as numbers; the second is all memory, the third free memory."""
    status = (ctypes.c_uint64 * 8)(64)  # the structure begins with its size
    if sys.platform == "win32":
        ctypes.windll.kernel32.GlobalMemoryStatusEx(status)
    return list(status)


def memory_bytes(pixels: int, *, num_rest: int = 0, num_elsewhere: int = 0) -> int:
    """Estimate the memory of a run in bytes, imports included.

    ``pixels`` is the number of pixels or Gaussians of the scene, or of the block in memory. ``num_rest`` is the number
    of values of higher harmonics of a Gaussian, and ``num_elsewhere`` the number of Gaussians outside the block.
    """
    pixel_bytes = BYTES_PER_GAUSSIAN + BYTES_PER_VALUE * num_rest + BYTES_PER_PIXEL
    return BYTES_FIXED + round(pixel_bytes * pixels + BYTES_ELSEWHERE * num_elsewhere)


def conversion_bytes(count: int, num_rest: int) -> int:
    """Estimate the memory, bytes, that a conversion of ``count`` Gaussians with ``num_rest`` higher harmonics needs."""
    return count * (BYTES_CONVERTED + BYTES_CONVERTED_VALUE * num_rest)


def memory_problem(needed: int, remedy: str = FEWER_PIXELS) -> str | None:
    """Return the message, with a remedy, for a run that needs more memory than this machine has; None if it fits."""
    available = machine_memory()
    if available is None or needed <= available:
        return None
    return f"about {needed / 1e9:.1f} GB of memory are needed, and this machine has {available / 1e9:.1f} GB; {remedy}"


def release_memory() -> None:
    """Return freed memory to the operating system.

    The C library glibc keeps memory that a thread has freed for this thread. If the stages of a run use different
    threads, the kept memory is up to a tenth of the peak memory. The function does nothing on systems other than Linux.
    """
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)


def make_array(shape: tuple[int, ...], dtype: type[np.generic], mapped_bytes: int | None = None) -> np.ndarray:
    """Return an uninitialised array. A large array is mapped from an unnamed temporary file, if the disk has room.

    A large array has at least ``mapped_bytes`` bytes, or ``MAPPED_BYTES`` if that is less or ``mapped_bytes`` is None.
    A mapped array takes memory only for the pages in use, and none after :func:`free_pages`. The file of a mapped array
    is in the system's temporary folder (``TMPDIR``) and is removed with the array.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size >= min(MAPPED_BYTES, mapped_bytes or MAPPED_BYTES) and hasattr(os, "posix_fallocate"):
        with suppress(OSError), tempfile.TemporaryFile() as file:
            os.posix_fallocate(file.fileno(), 0, size)  # on a full disk, writing to a page would kill the process
            pages = mmap.mmap(file.fileno(), size)
            _own_pages.add(pages)
            return np.frombuffer(pages, dtype).reshape(shape)
    return np.empty(shape, dtype)


def free_pages(arrays: Iterable[np.ndarray]) -> None:
    """Release the memory of arrays that :func:`make_array` mapped from files; the files keep their values."""
    for array in arrays:
        base = array  # a view of a mapped array refers to it by `base`, which in the end refers to the mapped file
        while isinstance(base, np.ndarray) and base.base is not None:
            base = base.base
        pages = base.obj if isinstance(base, memoryview) else base
        if isinstance(pages, mmap.mmap) and pages in _own_pages and hasattr(mmap, "MADV_DONTNEED"):
            pages.madvise(mmap.MADV_DONTNEED)


def gather(array: np.ndarray, *ids: np.ndarray) -> np.ndarray:
    """Return a copy of ``array[ids]``, with few pages of a mapped array in memory at a time if ids are sorted."""
    num_parts = -(-array.nbytes // MAPPED_BYTES)
    if num_parts <= 1:
        return array[ids]
    copies = []
    for part_ids in zip(*(np.array_split(axis_ids, num_parts) for axis_ids in ids), strict=True):
        copies.append(array[part_ids])
        free_pages([array])
    return np.concatenate(copies)


def human_share(share: float, digits: int = 2) -> str:
    """Format a share in [0, 1] as a percentage: ``0.044`` -> ``4.40 %``.

    The percentage has ``digits`` decimals, or more decimals if these would all be zeros.
    """
    percent = 100 * share
    digits = digits if percent <= 0 else max(digits, -math.floor(math.log10(percent)))
    return f"{percent:.{digits}f} %"


def human_bytes(count: float) -> str:
    """Format a number of bytes with units of powers of ten: ``1234567`` -> ``1.2 MB``."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} GB"
