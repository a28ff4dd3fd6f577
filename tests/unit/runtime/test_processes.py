"""Processes of a pool end with it."""

from __future__ import annotations

import multiprocessing
import os
from contextlib import closing

import pytest
from messages import names

from gsmerge.runtime.processes import ProcessPool
from gsmerge.runtime.work import Call, LostProcess


def test_a_call_that_fails_leaves_no_process() -> None:
    with closing(ProcessPool(1, 1, 0)) as pool, pytest.raises(ValueError, match="invalid literal"):
        list(pool.run(int, [Call("number", ("none",), 0)]))
    assert multiprocessing.active_children() == []


def test_a_call_that_ends_its_process_says_how_much_memory_it_needs() -> None:
    with closing(ProcessPool(1, 1, 0)) as pool:
        ((key, lost),) = pool.run(os._exit, [Call("large", (1,), 10**15)])
    assert (key, type(lost)) == ("large", LostProcess)
    assert names(lost.reason, "killed", "1000000.0 GB of memory")
