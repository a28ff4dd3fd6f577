"""Processes of a pool end with it."""

from __future__ import annotations

import multiprocessing
from contextlib import closing

import pytest

from gsmerge.runtime.processes import ProcessPool
from gsmerge.runtime.work import Call


def test_a_call_that_fails_leaves_no_process() -> None:
    with closing(ProcessPool(1, 1, 0)) as pool, pytest.raises(ValueError, match="invalid literal"):
        list(pool.run(int, [Call("number", ("none",), 0)]))
    assert multiprocessing.active_children() == []
