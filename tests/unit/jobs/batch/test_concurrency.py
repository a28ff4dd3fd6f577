"""Scenes are spread over processors and memory."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from batches import InlinePool

from gsmerge.jobs.batch import BatchOptions, Job, run
from gsmerge.jobs.batch.jobs import CompactCall
from gsmerge.jobs.batch.run import choose_concurrency
from gsmerge.reading.exporters import NO_HINTS
from gsmerge.runtime.memory import memory_bytes
from gsmerge.runtime.processes import ProcessPool
from gsmerge.runtime.work import Call
from gsmerge.settings.compact import CompactOptions

CALL = CompactCall(CompactOptions(), "auto", NO_HINTS)


def make_jobs(*counts: int) -> list[Job]:
    return [Job(f"{i}", (f"{i}.ply",), CALL, count) for i, count in enumerate(counts)]


def set_machine(monkeypatch: pytest.MonkeyPatch, processors: int, memory: int | None) -> None:
    monkeypatch.setattr(run, "available_threads", lambda: processors)
    monkeypatch.setattr(run, "free_memory", lambda: memory)


def test_processors_are_divided_among_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    set_machine(monkeypatch, 8, 10**12)

    def spread(count: int, **message: Any) -> tuple[int, int]:
        settings = CompactOptions().with_settings({"threads": message.pop("threads", None)})
        concurrency = choose_concurrency(make_jobs(*[1000] * count), BatchOptions(settings, **message))
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


def test_memory_limits_the_number_of_concurrent_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    large, small = 10_000_000, 10_000
    scenes, need = make_jobs(small, large, small, large, small), memory_bytes(large)

    def count(share: float | None, **message: Any) -> int:
        set_machine(monkeypatch, 4, None if share is None else int(share * need / run.FREE_MEMORY_SHARE) + 1)
        return choose_concurrency(scenes, BatchOptions(**message)).jobs

    assert [count(3), count(1), count(None)] == [4, 4, 4]  # those that are larger than most wait for each other
    assert count(1, jobs=3) == 3  # who asks for it gets it
    scenes = make_jobs(small, large, large)
    assert [count(4), count(2), count(1.9), count(0.5), count(None)] == [3, 2, 1, 1, 3]
    assert choose_concurrency(scenes, BatchOptions(jobs=2)).memory == math.inf


class Gauge(InlinePool):
    """A pool of three calls at once, which end one after the other."""

    capacity, most = 3, 0

    def __init__(self, memory: float) -> None:
        super().__init__()
        self.memory, self.order, self.calls = memory, list[int](), dict[int, tuple[Call, None]]()

    has_room = ProcessPool.has_room  # type: ignore[assignment]

    def submit(self, _: Any, call: Call) -> None:
        self.calls[call.key] = call, None
        self.order.append(call.key)
        self.most = max(self.most, sum(running.memory for running, _ in self.calls.values()))

    def wait(self) -> list[tuple[Any, Any]]:
        key = next(iter(self.calls))
        return [(key, self.calls.pop(key)[0].memory)]


@pytest.mark.parametrize(("memory", "most"), [(math.inf, 15), (12, 12), (10, 9), (8, 9), (0, 9)])
def test_concurrent_calls_fit_into_the_memory_unless_one_is_alone(memory: float, most: int) -> None:
    pool, sizes = Gauge(memory), [2, 3, 9, 2, 4, 1]
    ended = dict(pool.run(int, (Call(key, (), size) for key, size in enumerate(sizes))))
    assert ended == dict(enumerate(sizes))
    assert pool.order == list(range(len(sizes)))
    assert pool.most == most


def test_a_scene_that_must_run_alone_comes_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    set_machine(monkeypatch, 4, 4 * memory_bytes(10))
    monkeypatch.setattr(run, "ProcessPool", InlinePool)
    done = run.run_batch(make_jobs(10, 10**7, 10, 10), tmp_path, BatchOptions())
    assert [line["scene"] for line in done] == ["0", "2", "3", "1"]
