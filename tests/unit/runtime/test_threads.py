"""Work on several threads keeps its order, its errors and the number of threads."""

from __future__ import annotations

import sys
import threading
import time
import warnings
import weakref
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import cv2
import pytest

from gsmerge.runtime.threads import in_turn, parallel_map, quiet_warnings, use_threads, work_alone


@pytest.fixture(autouse=True)
def library_threads() -> Iterator[None]:
    before = library_thread_counts()
    yield
    assert library_thread_counts() == before


def library_thread_counts() -> list[int]:
    """Return the threads of OpenCV, and of torch where it is installed."""
    torch = sys.modules.get("torch")
    return [cv2.getNumThreads(), *([torch.get_num_threads()] if torch else [])]


@pytest.mark.parametrize("count", [1, 2, 8])
def test_results_keep_the_order_of_the_items(count: int) -> None:
    with use_threads(count):
        assert parallel_map(lambda i: i * i, range(100)) == [i * i for i in range(100)]
        assert parallel_map(str, iter([])) == []


def test_pool_works_on_as_many_items_at_once_as_threads() -> None:
    barrier = threading.Barrier(3, timeout=30)  # breaks unless three threads wait together
    with use_threads(3) as count:
        assert count == 3
        assert len(parallel_map(lambda _: barrier.wait(), range(3))) == 3


def test_other_libraries_are_held_to_one_thread(torch: Any) -> None:
    with use_threads(2):
        assert (torch.get_num_threads(), cv2.getNumThreads()) == (1, 1)


def test_torch_that_is_imported_later_is_held_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in of two threads that is there only after the pool."""
    counts = [2]
    late = SimpleNamespace(get_num_threads=lambda: counts[-1], set_num_threads=counts.append)
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    with use_threads(2):
        monkeypatch.setitem(sys.modules, "torch", late)
        parallel_map(abs, [1, 2])
        assert counts == [2, 1]
    assert counts == [2, 1, 2]


def test_outer_block_decides_the_number_of_threads() -> None:
    with use_threads(3):
        with use_threads(7) as count:
            assert count == 3
        with use_threads() as count:
            assert count == 3


def test_pool_threads_do_not_wait_for_their_own_pool() -> None:
    def outer(i: int) -> list[int]:
        return parallel_map(lambda j: 10 * i + j, range(3))

    with use_threads(2):
        assert parallel_map(outer, range(4)) == [[10 * i + j for j in range(3)] for i in range(4)]


def test_a_thread_that_works_alone_has_no_helpers() -> None:
    seen = list[set[int]]()

    def read() -> None:
        work_alone()
        seen.append(set(parallel_map(lambda _: threading.get_ident(), range(50))))

    reader = threading.Thread(target=read)
    with use_threads(3):
        reader.start()
        reader.join()
    assert seen == [{reader.ident}]


def test_error_of_an_item_leaves_the_pool_usable() -> None:
    def fail(i: int) -> int:
        if i == 1:
            raise KeyError("one")
        return i

    with use_threads(2):
        with pytest.raises(KeyError, match="one"):
            parallel_map(fail, range(4))
        assert parallel_map(abs, [-1, -2]) == [1, 2]
    with pytest.raises(KeyError, match="one"), use_threads(2):
        parallel_map(fail, range(4))


def test_overlapping_blocks_give_the_libraries_their_threads_back() -> None:
    """The first caller in is the first one out, while the second still works."""
    inside, out = threading.Event(), threading.Event()

    def second() -> None:
        with use_threads(2):
            inside.set()
            out.wait(30)

    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        thread = threading.Thread(target=second)
        with use_threads(2):
            thread.start()
            assert inside.wait(30)
        out.set()
        thread.join(30)
        assert cv2.getNumThreads() == 3
    finally:
        cv2.setNumThreads(before)


@pytest.mark.parametrize("at_once", [1, 4, 100])
def test_in_turn_gives_results_in_order_and_begins_few_ahead(monkeypatch: pytest.MonkeyPatch, at_once: int) -> None:
    begun: list[int] = []

    def work(i: int) -> int:
        begun.append(i)
        return i * i

    monkeypatch.setattr("gsmerge.runtime.threads.AT_ONCE", at_once)
    with use_threads(2):
        for i, square in enumerate(in_turn(work, range(10))):
            assert square == i * i
            assert len(begun) <= at_once * (i // at_once + 1)
    assert sorted(begun) == list(range(10))


def test_pool_keeps_no_item_once_it_is_done() -> None:
    class Item:
        pass

    barrier = threading.Barrier(3, timeout=30)  # each thread takes one
    with use_threads(3):
        items = [Item() for _ in range(3)]
        refs = [weakref.ref(item) for item in items]
        parallel_map(lambda _: barrier.wait(), items)
        del items
        for _ in range(1000):  # until the other threads have come back from their last lines
            if all(ref() is None for ref in refs):
                break
            time.sleep(0.01)
        assert [ref() for ref in refs] == [None] * 3


def test_after_an_error_nothing_more_is_begun() -> None:
    begun: list[int] = []

    def fail(i: int) -> None:
        begun.append(i)
        raise KeyError(i)

    with use_threads(2), pytest.raises(KeyError):
        parallel_map(fail, range(100))
    assert len(begun) <= 2


def test_the_error_of_the_first_item_comes_through() -> None:
    def fail(i: int) -> None:
        time.sleep(0.02 * (2 - i))  # the last one fails first
        raise KeyError(i)

    with use_threads(3), pytest.raises(KeyError, match="0"):
        parallel_map(fail, range(3))


def test_blocks_without_warnings_that_overlap_leave_the_filters_as_they_were() -> None:
    """With Python's own ``catch_warnings`` the filter of the second block would stay for good."""
    first, second = quiet_warnings(), quiet_warnings()
    before = list(warnings.filters)
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    with pytest.warns(UserWarning, match="of a user"):  # those of others are given
        warnings.warn("of a user", stacklevel=1)
    second.__exit__(None, None, None)
    assert warnings.filters == before
