"""Files of JSON lines survive being cut anywhere."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsmerge.errors import SceneError
from gsmerge.runtime.jsonl import append_line, each_line


def values(path: Path) -> list[object]:
    return [value for _, value in each_line(path)]


def test_every_way_to_cut_the_last_line(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    append_line(path, {"a": "odd \u2028 line\n"})
    start = path.stat().st_size
    append_line(path, {"b": 2})
    whole = path.read_bytes()
    for length in range(start, len(whole)):
        path.write_bytes(whole[:length])
        assert values(path) == [{"a": "odd \u2028 line\n"}]
        append_line(path, {"b": 2})
        assert path.read_bytes() == whole


def test_a_damaged_line_in_the_middle_costs_that_line_alone(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    path.write_bytes(b'{"a": 1}\n' + b"\x00" * 20 + b"\n" + b"[" * 100_000 + b'\n{"b": 2}\n')
    assert values(path) == [{"a": 1}, None, None, {"b": 2}]


def test_long_lines_are_cut_back_to_the_right_place(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    append_line(path, {"a": 1})
    with path.open("ab") as file:
        file.write(b"x" * 200_000)
    append_line(path, {"b": 2})
    assert values(path) == [{"a": 1}, {"b": 2}]


def test_what_is_no_json_is_refused_and_leaves_the_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    append_line(path, {"a": 1})
    with pytest.raises(ValueError, match="JSON"):
        append_line(path, {"a": float("nan")})
    assert values(path) == [{"a": 1}]


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SceneError, match="cannot be written"):
        append_line(tmp_path / "file" / "lines.jsonl", {})
