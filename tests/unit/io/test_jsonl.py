"""Files of JSON lines stay whole where several processes write, and where a disk is full."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from messages import refuses

from gsmerge.errors import SceneError
from gsmerge.io.jsonl import append_line, each_line


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "lines.jsonl"


APPEND = """
import pathlib, sys
from gsmerge.io.jsonl import append_line
for number in range(25):
    append_line(pathlib.Path(sys.argv[1]), {"name": sys.argv[2], "number": number, "padding": "x" * 5000})
"""


@pytest.mark.slow
def test_lines_of_several_processes_stay_whole(path: Path) -> None:
    path.write_bytes(b'{"torn": ')
    processes = [subprocess.Popen([sys.executable, "-c", APPEND, str(path), name]) for name in "ab"]
    assert [process.wait() for process in processes] == [0, 0]
    lines = [value for _, value in each_line(path) if value is not None]
    assert len(lines) == 50
    for name in "ab":
        assert [line["number"] for line in lines if line["name"] == name] == list(range(25))


def test_lines_can_be_read_from_the_middle(path: Path) -> None:
    assert list(each_line(path)) == []
    for number in range(3):
        append_line(path, {"number": number})
    ends = [end for end, _ in each_line(path)]
    assert [value for _, value in each_line(path, ends[0])] == [{"number": 1}, {"number": 2}]
    assert ends[-1] == path.stat().st_size


def test_a_line_that_does_not_fit_leaves_the_file_as_it_was(path: Path) -> None:
    """A full disk takes the first part of a line: stood in for by the largest size of a file."""
    pytest.importorskip("resource")
    append_line(path, {"number": 0})
    whole = path.read_bytes()
    code = f"""
import resource, pathlib
from gsmerge.errors import SceneError
from gsmerge.io.jsonl import append_line
resource.setrlimit(resource.RLIMIT_FSIZE, ({len(whole) + 20}, {len(whole) + 20}))
try:
    append_line(pathlib.Path({str(path)!r}), {{"text": "x" * 100}})
except SceneError as error:
    print(error)
"""
    message = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "lines.jsonl: cannot be written (" in message
    assert path.read_bytes() == whole


def read_values(path: Path) -> list[object]:
    return [value for _, value in each_line(path)]


def test_a_cut_last_line_is_replaced_by_the_next_one(path: Path) -> None:
    append_line(path, {"a": "odd \u2028 line\n"})
    start = path.stat().st_size
    append_line(path, {"b": 2})
    whole = path.read_bytes()
    for length in range(start, len(whole)):
        path.write_bytes(whole[:length])
        assert read_values(path) == [{"a": "odd \u2028 line\n"}]
        append_line(path, {"b": 2})
        assert path.read_bytes() == whole


def test_a_damaged_line_in_the_middle_costs_that_line_alone(path: Path) -> None:
    path.write_bytes(b'{"a": 1}\n' + b"\x00" * 20 + b"\n" + b"[" * 100_000 + b'\n{"b": 2}\n')
    assert read_values(path) == [{"a": 1}, None, None, {"b": 2}]


def test_a_value_that_is_no_json_is_refused_before_it_is_written(path: Path) -> None:
    append_line(path, {"a": 1})
    with pytest.raises(ValueError, match="JSON"):
        append_line(path, {"a": float("nan")})
    assert read_values(path) == [{"a": 1}]


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with refuses(SceneError, "lines.jsonl", "exists", "--output"):
        append_line(tmp_path / "file" / "lines.jsonl", {})


def test_a_line_of_more_values_than_its_bytes_allow_is_damaged(path: Path) -> None:
    path.write_text('{"a": 1}\n{"b": [' + "[]," * 2_000_000 + "[]]}\n")
    assert [value for _, value in each_line(path)] == [{"a": 1}, None]
