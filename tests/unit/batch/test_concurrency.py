"""Scenes are spread over processors and memory."""

from __future__ import annotations

from typing import Any

import pytest

from gsmerge.batch import BatchOptions, Job, run
from gsmerge.batch.jobs import CompactCall
from gsmerge.batch.run import choose_concurrency
from gsmerge.runtime.memory import memory_bytes
from gsmerge.scene.exporters import NO_HINTS
from gsmerge.settings.compact import CompactOptions

CALL = CompactCall(CompactOptions(), "auto", NO_HINTS)


def jobs(*counts: int) -> list[Job]:
    return [Job(f"{i}", (f"{i}.ply",), CALL, count) for i, count in enumerate(counts)]


def machine(monkeypatch: pytest.MonkeyPatch, processors: int, memory: int | None) -> None:
    monkeypatch.setattr(run, "available_threads", lambda: processors)
    monkeypatch.setattr(run, "free_memory", lambda: memory)


def test_processors_are_divided_among_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    machine(monkeypatch, 8, 10**12)

    def spread(count: int, **message: Any) -> tuple[int, int]:
        settings = CompactOptions().with_settings({"threads": message.pop("threads", None)})
        concurrency = choose_concurrency(jobs(*[1000] * count), BatchOptions(settings, **message))
        return concurrency.jobs, concurrency.threads

    assert spread(100) == (8, 1)
    assert spread(3) == (3, 2)
    assert spread(1) == (1, 8)
    assert spread(0) == (1, 8)
    assert spread(100, jobs=2) == (2, 4)
    assert spread(100, jobs=20) == (20, 1)
    assert spread(100, threads=4) == (2, 4)
    assert spread(100, threads=4, jobs=3) == (3, 4)
    assert spread(100, engine="ray") == (0, 1)
    assert spread(100, engine="ray", jobs=5, threads=2) == (5, 2)


def test_memory_limits_how_many_come_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    large, small = 10_000_000, 10_000
    scenes, need = jobs(small, large, small, large, small), memory_bytes(large)

    def count(share: float | None, **message: Any) -> int:
        machine(monkeypatch, 4, None if share is None else int(share * need / run.FREE_MEMORY_SHARE) + 1)
        return choose_concurrency(scenes, BatchOptions(**message)).jobs

    assert [count(3), count(2), count(1.9), count(0.5), count(None)] == [4, 2, 1, 1, 4]
    assert count(1, jobs=3) == 3  # who asks for it gets it
