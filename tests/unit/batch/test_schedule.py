"""Scenes are spread over processors and memory, and tried again as often as they may be."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from batches import QUICK, records
from messages import names, refuses

from gsmerge.batch import BatchOptions, Job
from gsmerge.batch import schedule as runs
from gsmerge.batch.records import (
    BUSY,
    DONE,
    FAILED,
    SKIPPED,
    STUCK,
    record,
)
from gsmerge.batch.schedule import dispatch, estimate_seconds, make_schedule
from gsmerge.batch.task import BatchContext, Task
from gsmerge.errors import SceneError
from gsmerge.runtime.estimate import memory_bytes
from gsmerge.runtime.work import Lost
from gsmerge.settings.compact import CompactOptions

LOST = "lost"


def jobs(*counts: int) -> list[Job]:
    return [Job(i, f"{i}", f"{i}.ply", count) for i, count in enumerate(counts)]


def test_processors_are_divided_among_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "free_memory", lambda: 10**12)

    def spread(count: int, processors: int, **message: Any) -> tuple[int, int]:
        settings = CompactOptions().with_settings({"threads": message.pop("threads", None)})
        schedule = make_schedule(jobs(*[1000] * count), BatchOptions(settings, **message), processors=processors)
        return schedule.jobs, schedule.threads

    assert spread(100, 8) == (8, 1)
    assert spread(3, 8) == (3, 2)
    assert spread(1, 8) == (1, 8)
    assert spread(0, 8) == (1, 8)
    assert spread(100, 8, jobs=2) == (2, 4)
    assert spread(100, 8, jobs=20) == (20, 1)
    assert spread(100, 8, threads=4) == (2, 4)
    assert spread(100, 8, threads=4, jobs=3) == (3, 4)
    assert spread(100, 8, engine="ray") == (0, 1)
    assert spread(100, 8, engine="ray", jobs=5, threads=2) == (5, 2)


def test_memory_limits_how_many_come_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    large, small = 10_000_000, 10_000
    scenes = jobs(small, large, small, large, small)
    need = memory_bytes(large, photos=True)

    def schedule(limit: int | None, **message: Any) -> runs.Schedule:
        return make_schedule(scenes, BatchOptions(max_memory=limit, **message), processors=4)

    assert schedule(3 * need).jobs == 4
    assert schedule(2 * need).jobs == 2  # the two large ones may come together
    assert (schedule(2 * need - 1).jobs, schedule(2 * need - 1).threads) == (1, 4)
    assert schedule(2 * need).memory == 2 * need
    assert schedule(2 * need).notes == ()
    assert names(schedule(2 * need, jobs=3).notes[0], 2, 3)
    alone = schedule(need // 2)
    assert alone.jobs == 1
    assert names(alone.notes[0], "largest", "alone")
    monkeypatch.setattr(runs, "free_memory", lambda: need)
    assert schedule(None).jobs == 1
    assert schedule(None, jobs=3).jobs == 3  # who asks for it gets it
    monkeypatch.setattr(runs, "free_memory", lambda: None)
    assert schedule(None).jobs == 4


def test_estimates_grow_with_scenes_and_shrink_with_processors(made_scene: Path) -> None:
    one = [Job(0, str(made_scene), "a.ply", 30_000)]
    options = BatchOptions()
    seconds = [estimate_seconds(one * count, options, runs.Schedule(at_once, 1, 0)) for count, at_once in
               ((0, 1), (1, 1), (8, 1), (8, 4))]  # fmt: skip
    assert seconds[0] == 0 < seconds[1] < seconds[3] < seconds[2]


class Script:
    """A pool whose tasks end as it is told, in order; a scene without a script is done."""

    def __init__(self, scripts: dict[str, list[str]], room: int = 2) -> None:
        self.scripts, self.room, self.tasks, self.seen = scripts, room, list[Task](), list[tuple[str, int]]()

    @property
    def has_room(self) -> bool:
        return len(self.tasks) < self.room

    def submit(self, task: Task, *_: object, memory: int = 0) -> None:
        self.tasks.append(task)
        self.seen.append((task.job.scene, task.attempt))

    def wait(self, _: float | None) -> list[tuple[Task, Any]]:
        task = self.tasks.pop(0)
        script = self.scripts.get(task.job.scene, [])
        status = script.pop(0) if script else DONE
        lost, actual = Lost("told so"), record(status, task.job.scene, task.job.output, error="told so")
        return [(task, lost if status == LOST else actual)]

    def close(self) -> list[Task]:
        return []


def handed_out(pool: Script, context: BatchContext, count: int) -> list[tuple[str, str]]:
    def each() -> Iterator[Task]:
        for number in range(count):
            assert len(pool.tasks) < pool.room  # nothing is asked for before there is room
            yield Task(Job(number, str(number), f"{number}.ply", 0), None)

    return [(actual["scene"], actual["status"]) for actual in dispatch(each(), pool, context)]


@pytest.fixture
def context(tmp_path: Path) -> BatchContext:
    return BatchContext(tmp_path, replace(QUICK, retries=2), 0)


def test_lost_tasks_are_tried_again_as_often_as_retries_say(context: BatchContext) -> None:
    pool = Script({"1": [LOST, LOST], "2": [LOST, LOST, LOST]})
    assert sorted(handed_out(pool, context, 4)) == [("0", DONE), ("1", DONE), ("2", FAILED), ("3", DONE)]
    assert [attempt for scene, attempt in pool.seen if scene == "2"] == [1, 2, 3]
    assert [(r["scene"], r["error"], r["attempt"]) for r in records(context.folder)] == [("2", "told so", 3)]


def test_what_failed_is_not_tried_again(context: BatchContext) -> None:
    pool = Script({"0": [FAILED]})
    assert handed_out(pool, context, 2) == [("0", FAILED), ("1", DONE)]
    assert len(pool.seen) == 2


def test_what_others_work_on_comes_last(context: BatchContext, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsmerge.batch.schedule.BUSY_RETRY_SECONDS", 0.05)
    pool = Script({"0": [BUSY, BUSY, SKIPPED]})
    start = time.monotonic()
    assert handed_out(pool, context, 3) == [("1", DONE), ("2", DONE), ("0", SKIPPED)]
    assert time.monotonic() - start >= 0.1


def test_a_batch_that_cannot_record_ends(context: BatchContext) -> None:
    with refuses(SceneError, "batch.jsonl", "told so"):
        handed_out(Script({"1": [STUCK]}), context, 3)


def test_nothing_to_do_is_done_at_once(context: BatchContext) -> None:
    assert handed_out(Script({}), context, 0) == []
