"""What a batch knows of what it did: records, locks, totals, and how scenes are spread."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from batches import rows

from gsmerge.batch import BatchOptions, Job, locks, plan
from gsmerge.batch.locks import LOCKS, BusyError, run_lock, scene_lock
from gsmerge.batch.plan import estimate_seconds, make_schedule
from gsmerge.batch.records import (
    COLUMNS,
    DONE,
    FAILED,
    RECORDS,
    SKIPPED,
    DoneResult,
    RecordIndex,
    check_folder,
    record,
)
from gsmerge.batch.summary import MAX_LISTED, Totals, summary_lines, write_summary
from gsmerge.errors import SceneError, UsageError
from gsmerge.io.atomic import temporary_path
from gsmerge.options import CompactOptions
from gsmerge.runtime.estimate import memory_bytes
from gsmerge.runtime.jsonl import append_line, each_line

SHA = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # of abc


def done(output: str, key: str = "k", **report: Any) -> dict[str, Any]:
    sizes = {"num_gaussians": 100, "bytes": 1000}
    filled = {
        "input": sizes,
        "output": {"num_gaussians": 4, "bytes": 50},
        "levels": [],
        "ratio": 0.04,
        "psnr_input_views": {"before": 20.0, "after": None},
        "total_seconds": 1.5,
        "peak_memory_bytes": 5,
        "unmet": None,
    }
    files = [{"path": output, "sha256": SHA, "bytes": 3}]
    return record(DONE, f"in/{output}", output, key=key, files=files, report=filled | report)


def test_results_are_known_by_what_they_were_made_of_and_what_they_are(tmp_path: Path) -> None:
    append_line(tmp_path / RECORDS, done("a.ply"))
    index = RecordIndex(tmp_path)
    index.read_on()
    known = index.known["a.ply"]
    assert known == DoneResult("k", (("a.ply", SHA),))
    assert not known.holds(tmp_path, "k")  # there is no file
    (tmp_path / "a.ply").write_bytes(b"abc")
    assert known.holds(tmp_path, "k")
    assert not known.holds(tmp_path, "other")
    (tmp_path / "a.ply").write_bytes(b"abd")
    assert not known.holds(tmp_path, "k")
    assert index.result_paths() == {os.path.realpath(tmp_path / "a.ply")}


def test_an_index_reads_on_and_past_what_is_damaged(tmp_path: Path) -> None:
    path = tmp_path / RECORDS
    index = RecordIndex(tmp_path)
    index.read_on()
    append_line(path, done("a.ply"))
    append_line(path, record(FAILED, "in/b.ply", "b.ply", error="no"))
    index.read_on()
    assert list(index.known) == ["a.ply"]
    with path.open("ab") as file:
        file.write(b"\x00\x00\n" + b'{"status":"done","output":"c.p')
    index.read_on()
    assert (index.damaged, index.end) == (1, path.stat().st_size - 30)
    append_line(path, done("c.ply"))
    append_line(path, done("a.ply", key="newer"))
    append_line(path, {"status": "done", "output": "d.ply", "files": "none"})
    append_line(path, record(FAILED, "in/c.ply", "c.ply"))
    index.read_on()
    assert {name: known.key for name, known in index.known.items()} == {"a.ply": "newer", "c.ply": "k"}
    assert {name: known.failed_since for name, known in index.known.items()} == {"a.ply": False, "c.ply": True}


WRONG: dict[str, Any] = {
    "a number": 5, "null": None, "a list": [1], "an object": {"a": 1}, "a text": "x", "true": True,
    "a list of lists": [[]], "a huge number": 10**400, "a zero byte": "a\0b", "half a letter": "\ud800",
    "empty": {}, "inf": math.inf,
}  # fmt: skip


def foreign_lines() -> list[bytes]:
    """Lines that are no records: every entry of one with every odd value, and without it."""
    whole = done("a.ply")
    lines = [b"[" * 100_000, b'{"a":' * 100_000, b"9" * 10_000, b"[]", b"{}", b'{"status":"done"}']
    for key in ("status", "scene", "output", "files", "key", "report"):
        lines += [json.dumps({**whole, key: value}).encode() for value in WRONG.values()]
        lines.append(json.dumps({name: value for name, value in whole.items() if name != key}).encode())
    for key in whole["report"]:
        lines += [json.dumps({**whole, "report": {**whole["report"], key: v}}).encode() for v in WRONG.values()]
    for key in ("path", "sha256"):
        lines += [json.dumps({**whole, "files": [{**whole["files"][0], key: v}]}).encode() for v in WRONG.values()]
    return lines


def test_whatever_a_line_holds_the_records_can_be_read(tmp_path: Path) -> None:
    path, lines = tmp_path / RECORDS, foreign_lines()
    for line in lines:
        path.write_bytes(line + b"\n" + json.dumps(done("b.ply")).encode() + b"\n")
        index = RecordIndex(tmp_path)
        index.read_on()
        assert "b.ply" in index.known, line[:200]
        assert index.damaged in (0, 1)
        index.result_paths()
        assert not any(known.holds(tmp_path, "k") for known in index.known.values())
        summary = {row["output"] for row in rows(write_summary(tmp_path).parent)}
        assert "b.ply" in summary
        assert summary <= {"b.ply", "a.ply", "x", ""}, line[:200]


@pytest.mark.parametrize("line", [b'"output":[1]', b'"output":null', b'"report":5', b'"key":[]', b'"files":[7]'])
def test_a_line_of_odd_types_counts_as_damaged(tmp_path: Path, line: bytes) -> None:
    key = json.loads(b"{" + line + b"}")
    (tmp_path / RECORDS).write_text(json.dumps(done("a.ply") | key) + "\n")
    index = RecordIndex(tmp_path)
    index.read_on()
    assert (index.damaged, index.known) == (1, {})


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
def test_a_pipe_in_place_of_a_result_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.ply")
    assert not DoneResult("k", (("a.ply", SHA),)).holds(tmp_path, "k")


APPEND = """
import pathlib, sys
from gsmerge.runtime.jsonl import append_line
for number in range(25):
    append_line(pathlib.Path(sys.argv[1]), {"name": sys.argv[2], "number": number, "padding": "x" * 5000})
"""


def test_lines_of_several_processes_stay_whole(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    path.write_bytes(b'{"torn": ')
    processes = [subprocess.Popen([sys.executable, "-c", APPEND, str(path), name]) for name in "ab"]
    assert [process.wait() for process in processes] == [0, 0]
    lines = [value for _, value in each_line(path) if value is not None]
    assert len(lines) == 50
    for name in "ab":
        assert [line["number"] for line in lines if line["name"] == name] == list(range(25))


def test_lines_can_be_read_from_the_middle(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    assert list(each_line(path)) == []
    for number in range(3):
        append_line(path, {"number": number})
    ends = [end for end, _ in each_line(path)]
    assert [value for _, value in each_line(path, ends[0])] == [{"number": 1}, {"number": 2}]
    assert ends[-1] == path.stat().st_size


def test_a_line_that_does_not_fit_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    """A full disk takes the first part of a line: stood in for by the largest size of a file."""
    path = tmp_path / "lines.jsonl"
    append_line(path, {"number": 0})
    whole = path.read_bytes()
    code = f"""
import resource, pathlib
from gsmerge.errors import SceneError
from gsmerge.runtime.jsonl import append_line
resource.setrlimit(resource.RLIMIT_FSIZE, ({len(whole) + 20}, {len(whole) + 20}))
try:
    append_line(pathlib.Path({str(path)!r}), {{"text": "x" * 100}})
except SceneError as error:
    print(error)
"""
    message = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "lines.jsonl: cannot be written (" in message
    assert path.read_bytes() == whole


def test_a_lock_is_held_by_one_and_gone_when_it_is_finished(tmp_path: Path) -> None:
    with scene_lock(tmp_path, ["a.ply"]) as lock:
        assert not lock.abandoned
        assert json.loads(lock.path.read_text())["pid"] == os.getpid()
        with pytest.raises(BusyError), scene_lock(tmp_path, ["a.ply"]):
            pass
        with scene_lock(tmp_path, ["b.ply"]) as other:
            other.finish()
        lock.finish()
    assert list(tmp_path.iterdir()) == []


def test_a_lock_tells_that_it_was_abandoned_and_whether_there_was_a_file_before(tmp_path: Path) -> None:
    (tmp_path / "old.ply").touch()
    for name, fresh in (("new.ply", True), ("old.ply", False)):
        with scene_lock(tmp_path, [name]):
            pass  # as if killed: never finished
        (tmp_path / name).touch()
        for _ in range(2):
            with scene_lock(tmp_path, [name]) as lock:
                assert (lock.abandoned, lock.fresh) == (True, fresh)


def test_a_lock_survives_that_its_file_is_removed_while_it_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between opening and locking, who held it finishes: the file that is locked then is nobody's any more."""
    locked, calls = locks._lock, []

    def removed_first(descriptor: int, path: Path, *, shared: bool) -> bool:
        if not calls:
            path.unlink()
        calls.append(path)
        return locked(descriptor, path, shared=shared)

    monkeypatch.setattr(locks, "_lock", removed_first)
    with scene_lock(tmp_path, ["a.ply"]) as lock:
        assert len(calls) == 2
        assert lock.path.exists()


def test_a_lock_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / LOCKS).touch()
    with pytest.raises(SceneError, match="cannot be written"), scene_lock(tmp_path, ["a.ply"]):
        pass
    with pytest.raises(SceneError, match="cannot be written"), scene_lock(tmp_path / "gone", ["a.ply"]):
        pass


def test_runs_share_a_folder_if_they_make_the_same(tmp_path: Path) -> None:
    with run_lock(tmp_path, "same"), run_lock(tmp_path, "same"):
        message = rf"other settings is at work there \(process {os.getpid()}"
        with pytest.raises(UsageError, match=message), run_lock(tmp_path, "other"):
            pass
        with run_lock(tmp_path, "same"):
            pass
    with run_lock(tmp_path, "other"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_was_killed_holds_nothing_up(tmp_path: Path) -> None:
    (tmp_path / LOCKS).mkdir()
    (tmp_path / LOCKS / "run.lock").write_text('{"what": "old", "pid": 1, "host": "gone"}')
    with run_lock(tmp_path, "new"):
        pass


def test_runs_that_may_share_a_folder_have_one_name() -> None:
    settings = CompactOptions()
    base = BatchOptions(settings)
    same = (replace(base, jobs=3), replace(base, settings=settings.with_settings({"threads": 2}), rerun=True))
    others = (
        replace(base, settings=settings.with_settings({"k": 2})),
        replace(base, output="{index}.ply"),
        replace(base, opacity="raw"),
        replace(base, cameras="{parent}/cameras.json"),
    )
    assert {one.name() for one in same} == {base.name()}
    assert len({base.name(), *(one.name() for one in others)}) == 5


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"jobs": 0}, "jobs: expected at least 1"),
        ({"retries": -1}, "retries: expected at least 0"),
        ({"timeout": 0.0}, "timeout: expected more than 0"),
        ({"timeout": math.nan}, "timeout: expected more than 0"),
        ({"max_memory": 0}, "max memory: expected at least"),
        ({"engine": "slurm"}, "engine: expected one of local, ray"),
        ({"address": "auto"}, "address: expected engine ray"),
        ({"engine": "ray", "max_memory": 5}, "max memory: expected engine local"),
    ],
)
def test_settings_out_of_range_are_refused(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        BatchOptions(**wrong)


def jobs(*counts: int) -> list[Job]:
    return [Job(i, f"{i}", f"{i}.ply", count) for i, count in enumerate(counts)]


def test_processors_are_divided_among_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan, "free_memory", lambda: 10**12)

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

    def schedule(limit: int | None, **message: Any) -> plan.Schedule:
        return make_schedule(scenes, BatchOptions(max_memory=limit, **message), processors=4)

    assert schedule(3 * need).jobs == 4
    assert schedule(2 * need).jobs == 2  # the two large ones may come together
    assert (schedule(2 * need - 1).jobs, schedule(2 * need - 1).threads) == (1, 4)
    assert schedule(2 * need).memory == 2 * need
    assert schedule(2 * need).notes == ()
    assert "2 at once instead of 3" in schedule(2 * need, jobs=3).notes[0]
    alone = schedule(need // 2)
    assert alone.jobs == 1
    assert "the largest scene alone may take" in alone.notes[0]
    monkeypatch.setattr(plan, "free_memory", lambda: need)
    assert schedule(None).jobs == 1
    assert schedule(None, jobs=3).jobs == 3  # who asks for it gets it
    monkeypatch.setattr(plan, "free_memory", lambda: None)
    assert schedule(None).jobs == 4


def test_the_system_tells_its_memory() -> None:
    free = plan.free_memory()
    assert free is None or 10**7 < free < 10**14


def test_estimates_grow_with_scenes_and_shrink_with_processors(made_scene: Path) -> None:
    one = [Job(0, str(made_scene), "a.ply", 30_000)]
    options = BatchOptions()
    seconds = [estimate_seconds(one * count, options, plan.Schedule(at_once, 1, 0)) for count, at_once in
               ((0, 1), (1, 1), (8, 1), (8, 4))]  # fmt: skip
    assert seconds[0] == 0 < seconds[1] < seconds[3] < seconds[2]


def test_the_summary_has_the_newest_of_every_scene(tmp_path: Path) -> None:
    later = done("b.ply", ratio=0.5)
    for one in (done("b.ply"), record(FAILED, "in/a.ply", "a.ply", error="no, never"), later):
        append_line(tmp_path / RECORDS, one)
    append_line(tmp_path / RECORDS, done("c.ply"))
    append_line(tmp_path / RECORDS, record(FAILED, "in/c.ply", "c.ply", error="killed"))
    temporary_path(tmp_path / "summary.csv").touch()  # of a killed run
    assert write_summary(tmp_path) == tmp_path / "summary.csv"
    actual = rows(tmp_path)
    assert list(actual[0]) == list(COLUMNS)
    assert [(r["output"], r["status"], r["ratio"]) for r in actual] == [
        ("a.ply", "failed", ""), ("b.ply", "done", "0.5"), ("c.ply", "failed", ""),
    ]  # fmt: skip
    assert actual[0]["error"] == "no, never"
    append_line(tmp_path / RECORDS, record(SKIPPED, "in/c.ply", "c.ply"))  # it was still there and as it should be
    write_summary(tmp_path)
    assert [r["status"] for r in rows(tmp_path)] == ["failed", "done", "done"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [RECORDS, "summary.csv"]


def test_names_in_the_summary_are_no_formulas(tmp_path: Path) -> None:
    names = ["=cmd|' x'!A1/s.ply", "+1.ply", "-1.ply", "@a.ply", "plain-1.ply"]
    for name in names:
        append_line(tmp_path / RECORDS, record(FAILED, name, name, error=name))
    actual = rows(write_summary(tmp_path).parent)
    for column in ("scene", "output", "error"):
        assert sorted(row[column] for row in actual) == sorted([*(f"'{name}" for name in names[:4]), names[4]])


def test_totals_do_not_grow_with_the_number_of_scenes(tmp_path: Path) -> None:
    totals = Totals(1000)
    for number in range(300):
        totals.add(done(f"{number}.ply"))
        totals.add(record(FAILED, f"{number}", f"{number}.ply", error="no"))
        totals.add(record(SKIPPED, f"{number}", f"{number}.ply"))
    totals.add(done("x.ply", unmet="too few"))
    assert (len(totals.rows), len(totals.failures)) == (MAX_LISTED, MAX_LISTED)
    assert (totals.num_input, totals.num_output, totals.ended, totals.unmet) == (30100, 1204, 901, 1)
    *table, last = summary_lines(totals, tmp_path / "summary.csv")
    assert table[0].split() == ["result", "Gaussians", "of", "kept", "dB", "before", "after", "seconds"]
    assert [line for line in table if "more" in line] == ["... and 281 more", "... and 280 more failed"]
    assert last.startswith(
        "1,000 scenes: 301 done, 300 skipped, 300 failed, 99 left; 30,100 -> 1,204 Gaussians (4.00 %)"
    )
    assert "1 missed the target" in last
    assert summary_lines(Totals(0), None) == ["0 scenes: 0 done"]


def test_a_folder_that_cannot_be_written_is_told_before_anything_is_done(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SceneError, match=r"cannot be written .*--output"):
        check_folder(tmp_path / "file" / "out")
    check_folder(tmp_path / "new" / "out")
    assert (tmp_path / "new" / "out" / RECORDS).exists()
