"""A fixture runs kernels with the library of every target of this processor."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pytest
from targets import runnable_targets

from gsmerge.method.kernels.library import load_library

Function = Callable[[], Sequence[np.ndarray]]


@pytest.fixture
def each_target(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Function], Sequence[np.ndarray]]]:
    """Run a function with each library -> its arrays, whose bits must be the same."""

    def run(function: Function) -> Sequence[np.ndarray]:
        results = []
        for target in runnable_targets():
            monkeypatch.setenv("GSMERGE_TARGET", target)
            load_library.cache_clear()
            results.append(function())
        for other in results[1:]:
            for one, two in zip(results[0], other, strict=True):
                assert np.asarray(one).tobytes() == np.asarray(two).tobytes()
        return results[0]

    yield run
    monkeypatch.undo()
    load_library.cache_clear()
