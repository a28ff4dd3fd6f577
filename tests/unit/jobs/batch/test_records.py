"""Records of a batch are found again, whatever else is in the file."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import pytest
from messages import NO_FOLDER, refuses

from gsmerge.errors import SceneError
from gsmerge.io.jsonl import append_line
from gsmerge.jobs.batch.records import DONE, FAILED, RECORDS, DoneResult, RecordIndex, prepare_folder, record

SHA = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # of abc
FILES = [{"path": "a.ply", "sha256": SHA, "bytes": 3}]


def done_record(output: str, key: str = "k") -> dict[str, Any]:
    files = [{"path": output, "sha256": SHA, "bytes": 3}]
    return record(DONE, f"in/{output}", output, key=key, files=files, report={"worse": None}, unmet="too few")


def test_a_done_result_holds_for_its_key_while_its_file_is_unchanged(tmp_path: Path) -> None:
    append_line(tmp_path / RECORDS, done_record("a.ply"))
    index = RecordIndex(tmp_path).read_on()
    known = index.results["a.ply"]
    assert known == DoneResult("k", FILES, "in/a.ply", unmet="too few")
    assert not known.holds(tmp_path, "k")  # there is no file
    (tmp_path / "a.ply").write_bytes(b"abc")
    assert known.holds(tmp_path, "k")
    assert not known.holds(tmp_path, "other")
    (tmp_path / "a.ply").write_bytes(b"abd")
    assert not known.holds(tmp_path, "k")
    assert list(index.paths()) == [os.path.realpath(tmp_path / "a.ply")]


def test_the_index_of_records_reads_new_lines_past_damaged_ones(tmp_path: Path) -> None:
    path = tmp_path / RECORDS
    index = RecordIndex(tmp_path)
    index.read_on()
    append_line(path, done_record("a.ply"))
    append_line(path, record(FAILED, "in/b.ply", "b.ply", error="no"))
    index.read_on()
    assert list(index.results) == ["a.ply"]
    with path.open("ab") as file:
        file.write(b"\x00\x00\n" + b'{"status":"done","output":"c.p')
    index.read_on()
    assert index.end == path.stat().st_size - 30
    append_line(path, done_record("c.ply"))
    append_line(path, done_record("a.ply", key="newer"))
    append_line(path, {"status": "done", "output": "d.ply", "files": "none"})
    append_line(path, record(FAILED, "in/c.ply", "c.ply"))
    index.read_on()
    assert {name: known.key for name, known in index.results.items()} == {"a.ply": "newer", "c.ply": "k"}


WRONG: dict[str, Any] = {
    "a number": 5, "null": None, "a list": [1], "an object": {"a": 1}, "a text": "x", "true": True,
    "a list of lists": [[]], "a huge number": 10**400, "a zero byte": "a\0b", "half a letter": "\ud800",
    "empty": {}, "inf": math.inf,
}  # fmt: skip


def foreign_lines() -> list[bytes]:
    """Return lines that are no records: every entry of one with every odd value, and without it."""
    whole = done_record("a.ply")
    lines = [b"[" * 100_000, b'{"a":' * 100_000, b"9" * 10_000, b"[]", b"{}", b'{"status":"done"}']
    for key in ("status", "scene", "output", "files", "key", "report", "unmet"):
        lines += [json.dumps({**whole, key: value}).encode() for value in WRONG.values()]
        lines.append(json.dumps({name: value for name, value in whole.items() if name != key}).encode())
    for key in whole["report"]:
        lines += [json.dumps({**whole, "report": {**whole["report"], key: v}}).encode() for v in WRONG.values()]
    for key in ("path", "sha256"):
        lines += [json.dumps({**whole, "files": [{**whole["files"][0], key: v}]}).encode() for v in WRONG.values()]
    return lines


def test_a_record_after_any_foreign_line_is_read(tmp_path: Path) -> None:
    path, lines = tmp_path / RECORDS, foreign_lines()
    for line in lines:
        path.write_bytes(line + b"\n" + json.dumps(done_record("b.ply")).encode() + b"\n")
        index = RecordIndex(tmp_path).read_on()
        assert "b.ply" in index.results, line[:200]
        assert os.path.realpath(tmp_path / "b.ply") in list(index.paths())
        assert not any(known.holds(tmp_path, "k") for known in index.results.values())


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
def test_a_pipe_in_place_of_a_result_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.ply")
    assert not DoneResult("k", FILES, "in/a.ply").holds(tmp_path, "k")


def test_an_output_folder_below_a_file_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with refuses(SceneError, "out", *NO_FOLDER, "--output"):
        prepare_folder(tmp_path / "file" / "out")


def test_an_output_folder_is_made_with_its_records(tmp_path: Path) -> None:
    prepare_folder(tmp_path / "new" / "out")
    assert (tmp_path / "new" / "out" / RECORDS).exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes")
def test_a_pipe_in_the_place_of_the_records_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / RECORDS)
    with refuses(SceneError, RECORDS, "pipe"):
        prepare_folder(tmp_path)
