"""Compute many items in parallel, on one pool of threads for the whole package.

A kernel runs on one thread and releases the GIL of Python, so several threads can run kernels at once, each on another
view or on another band of an image. Threads wait for each other only at the end of a pass over all views, and sleep
while they wait. A result cannot depend on the number of threads, because every item is computed by itself and results
are returned in order. While a pool is in use, OpenCV and torch may use one thread each, so that they do not compete
with the pool for cores. Torch is limited only if other code has imported it.

The threads are those of the standard library. Its ``map`` makes a future for each item: in place of
:func:`parallel_map`, a call with eight items of 0.25 ms takes 1.05 to 1.18 times the CPU.
"""

from __future__ import annotations

import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

import cv2

from gsmerge.errors import UsageError
from gsmerge.runtime import MOST_THREADS

THREADS = "GSMERGE_THREADS"  # environment variable with the default number of threads
T = TypeVar("T")
R = TypeVar("R")
LIBRARIES = r"(PIL|numpy|gsmerge\.io)\b"  # modules that warn of damaged files, which readers report themselves
AT_ONCE = 12  # most results of in_turn that are in memory at the same time


@contextmanager
def quiet_warnings() -> Iterator[None]:
    """Ignore warnings of libraries in the block, which may run in several threads at once.

    Filters of warnings are shared by all threads. If each block used Python's ``catch_warnings``, a block could restore
    filters that another block has set. To prevent this, the first block sets the filter, and the last block that ends
    removes it.
    """
    with _Quiet.lock:
        if not _Quiet.blocks:
            _Quiet.saved = warnings.catch_warnings()
            _Quiet.saved.__enter__()
            warnings.filterwarnings("ignore", module=LIBRARIES)
        _Quiet.blocks += 1
    try:
        yield
    finally:
        with _Quiet.lock:
            _Quiet.blocks -= 1
            if not _Quiet.blocks:
                _Quiet.saved.__exit__(None, None, None)


class _Quiet:
    """State of :func:`quiet_warnings`, which all threads share."""

    lock = threading.Lock()
    blocks = 0  # number of blocks that are running
    saved: Any = None  # the filters before the first block


class _Local(threading.local):
    """State of each calling thread, so that two calls at the same time do not shut down each other's pool."""

    pool: ThreadPoolExecutor | None = None
    count = 1  # threads that parallel_map uses
    inside = False  # True on a thread that computes an item; such a thread must not wait for a pool
    holds_torch = False  # True if torch was limited to one thread because this thread has a pool


class _Libraries:
    """Numbers of threads of torch and OpenCV, which are settings of the process, so all callers share them."""

    lock = threading.Lock()
    pools = 0  # number of pools in use
    opencv = 1  # number of OpenCV's threads before the first pool
    torch: int | None = None  # number of torch's threads before it was limited; None if it is not limited


_local, _libraries = _Local(), _Libraries()


def available_threads() -> int:
    """Return the number in the variable ``GSMERGE_THREADS``, or the number of processors that this process may use.

    Raises UsageError if the variable is not a number from 1 to ``MOST_THREADS``.
    """
    text = os.environ.get(THREADS)
    if text:  # an empty variable counts as not set
        if not (text.isascii() and text.isdecimal() and len(text) < 10 and 1 <= int(text) <= MOST_THREADS):
            raise UsageError(f"{THREADS}: expected a number from 1 to {MOST_THREADS}, got {text!r:.40}")
        return int(text)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def default_threads(count: int) -> Iterator[None]:
    """Set the number of threads that are available in the block, also to processes that it starts."""
    before = os.environ.get(THREADS)
    os.environ[THREADS] = str(count)
    try:
        yield
    finally:
        os.environ.pop(THREADS)
        if before is not None:
            os.environ[THREADS] = before


def work_alone() -> None:
    """Let the calling thread compute all items of :func:`parallel_map` by itself, as threads of a pool do."""
    _local.inside = True


@contextmanager
def use_threads(count: int | None = None) -> Iterator[int]:
    """Let :func:`parallel_map` use ``count`` threads (None: all processors) inside the block.

    A block inside another block uses the threads of the outer block.
    """
    if _local.pool is not None or _local.inside:
        hold_torch()
        yield _local.count
        return
    count = available_threads() if count is None else count
    with _libraries.lock:
        if _libraries.pools == 0:
            _libraries.opencv = cv2.getNumThreads()
        _libraries.pools += 1
        cv2.setNumThreads(1)
    num_helpers = max(count - 1, 1)  # a pool has a thread at least, which starts only when it gets work
    _local.pool = ThreadPoolExecutor(num_helpers, "gsmerge", work_alone)
    _local.count = count
    hold_torch()
    try:
        yield count
    finally:
        _local.pool.shutdown()
        _local.pool = None
        _local.count = 1
        with _libraries.lock:  # torch is as before if this pool limited it, and OpenCV after the last pool
            _libraries.pools -= 1
            if _local.holds_torch:
                sys.modules["torch"].set_num_threads(_libraries.torch)
                _local.holds_torch = False
            if _libraries.pools == 0:
                cv2.setNumThreads(_libraries.opencv)
                _libraries.torch = None


def hold_torch() -> None:
    """Limit torch to one thread while the calling thread has a pool, if torch is imported.

    :func:`use_threads` and :func:`parallel_map` call this function. Code that imports torch while a pool is in use must
    call :func:`hold_torch` before its first computation with torch.
    """
    torch = sys.modules.get("torch")
    if _local.pool is None or _local.holds_torch or torch is None or not hasattr(torch, "set_num_threads"):
        return
    with _libraries.lock:
        if _libraries.torch is None:
            _libraries.torch = torch.get_num_threads()
        torch.set_num_threads(1)
        _local.holds_torch = True


def parallel_map(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """Return ``[function(item) for item in items]``, computed on the pool, in the order of the items.

    Outside of :func:`use_threads`, a pool with all processors is made for the call. If ``function`` itself calls
    :func:`parallel_map`, the inner call computes its items one by one. The calling thread computes items as well, and a
    free thread takes the next item. The call does not wait for threads that took no item. Once an item has failed, a
    thread ends after its item. If several items fail, the error of the first failed item is raised, even if another
    thread failed earlier: items are taken in order, and each item that is taken is computed.
    """
    items = list(items)
    with use_threads() as count:
        if count == 1 or len(items) < 2 or _local.pool is None or _local.inside:
            return [function(item) for item in items]
        results: list[R] = [None] * len(items)  # type: ignore[list-item]
        indices = iter(range(len(items)))  # its next() is atomic
        errors: dict[int, BaseException] = {}  # by index of the item

        def work() -> None:
            """Take items and compute them until no item is left, or until an item has failed."""
            for index in indices:
                try:
                    results[index] = function(items[index])
                except BaseException as error:
                    errors[index] = error
                if errors:
                    break

        helpers = [_local.pool.submit(work) for _ in range(min(count, len(items)) - 1)]
        _local.inside = True
        try:
            work()
        finally:
            _local.inside = False
        for helper in helpers:
            if not helper.cancel():  # it has begun
                helper.result()
        if errors:
            raise errors.pop(min(errors))
        return results


def in_turn(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Yield the results of :func:`parallel_map` in order, with at most ``AT_ONCE`` of them in memory at a time.

    Callers use :func:`in_turn` for large results of views, so that memory does not grow with the number of views.
    """
    items = list(items)
    for start in range(0, len(items), AT_ONCE):
        yield from parallel_map(function, items[start : start + AT_ONCE])
