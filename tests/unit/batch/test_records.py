"""Records of a batch are found again, whatever else is in the file, and summed up."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import pytest
from batches import rows
from messages import refuses

from gsmerge.batch.records import (
    COLUMNS,
    DONE,
    FAILED,
    MAX_LISTED,
    RECORDS,
    SKIPPED,
    DoneResult,
    RecordIndex,
    Totals,
    check_folder,
    record,
    summary_lines,
    write_summary,
)
from gsmerge.errors import SceneError
from gsmerge.io.jsonl import append_line

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


def test_the_summary_has_the_newest_of_every_scene(tmp_path: Path) -> None:
    later = done("b.ply", ratio=0.5)
    for one in (done("b.ply"), record(FAILED, "in/a.ply", "a.ply", error="no, never"), later):
        append_line(tmp_path / RECORDS, one)
    append_line(tmp_path / RECORDS, done("c.ply"))
    append_line(tmp_path / RECORDS, record(FAILED, "in/c.ply", "c.ply", error="killed"))
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


def test_a_folder_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with refuses(SceneError, "out", "Not a directory", "--output"):
        check_folder(tmp_path / "file" / "out")
    check_folder(tmp_path / "new" / "out")
    assert (tmp_path / "new" / "out" / RECORDS).exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes")
def test_a_pipe_in_the_place_of_the_records_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / RECORDS)
    with refuses(SceneError, RECORDS, "pipe"):
        check_folder(tmp_path)
