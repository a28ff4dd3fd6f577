"""Sizes of an index whose coarser levels come out smaller than what stood for them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gsmerge import Gaussians
from gsmerge.budget import FileSize
from gsmerge.compaction import file_size
from gsmerge.compaction.file_size import NEAR, measure_bytes, meet_bytes_of_levels
from gsmerge.io.formats.table import LEVELS


def cloud(count: int) -> Gaussians:
    rng = np.random.default_rng(count)
    columns = rng.normal(size=(count, 3)), rng.normal(size=(count, 4)), rng.uniform(0.01, 0.1, (count, 3))
    more = rng.uniform(0.1, 1, count), rng.normal(size=(count, 1, 3)), np.zeros((count, 0, 3))
    return Gaussians(*(column.astype(np.float32) for column in (*columns, *more)))


@pytest.mark.slow
@pytest.mark.parametrize(("share", "rebuilt"), [(0.99, False), (0.9, True)])
def test_the_finest_level_is_built_again_with_what_the_others_leave(
    share: float, rebuilt: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def candidate(count: int) -> Any:
        asked.append(count)
        return SimpleNamespace(gaussians=cloud(count))

    monkeypatch.setattr(file_size, "shrink", lambda _, kept, *scene: SimpleNamespace(gaussians=kept))  # without scores
    finest, coarser = candidate(1500), [candidate(40)]
    most = round(measure_bytes([finest.gaussians, coarser[0].gaussians], LEVELS) / share)
    prepared: Any = SimpleNamespace(input_scene=SimpleNamespace(num_gaussians=10_000))
    plan: Any = SimpleNamespace(size=FileSize(most, LEVELS, 2))
    best = meet_bytes_of_levels(finest, coarser, candidate, prepared, plan)
    assert (max(asked) > 1500) == rebuilt
    assert NEAR * most <= measure_bytes([best.gaussians, coarser[0].gaussians], LEVELS) <= most
