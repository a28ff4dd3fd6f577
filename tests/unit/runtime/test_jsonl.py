"""Files of JSON lines stay whole where several processes write, and where a disk is full."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from gsmerge.runtime.jsonl import append_line, each_line, read_lines

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
    lines = read_lines(path)
    assert lines.notes == ()
    for name in "ab":
        assert [line["number"] for line in lines.values if line["name"] == name] == list(range(25))


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
