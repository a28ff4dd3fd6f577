"""Tests of training share this fixture."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from gsmerge.runtime.threads import use_threads


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """Use one thread, as in a run: torch's own cost more than these sizes take."""
    with use_threads(1):
        yield
