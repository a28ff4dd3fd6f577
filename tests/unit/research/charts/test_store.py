"""The results file survives being cut anywhere; keys depend on what was asked for, and on nothing else."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import pytest

import gsmerge
from gsmerge.errors import SceneError
from gsmerge.io.content_hash import content_hash
from gsmerge.research.charts.record import RUNS, SCORES, RunRecord, append_run, experiment_key, read_runs
from gsmerge.runtime.jsonl import append_line, read_lines


def record(key: str, **changes: object) -> RunRecord:
    return replace(
        RunRecord(key, "room", "ab" * 32, "gsmerge", {"k": 2}, None, "gsmerge chart", {"cpu": "x"}), **changes
    )  # type: ignore[arg-type]


def test_records_come_back_as_they_were(tmp_path: Path) -> None:
    first = record("1", psnr_target=24.5, pictures=("a.png",), notes=("odd \u2028 line\n",), stages={"fit": 2.0})
    second = record("2", error='no "room"')
    append_run(tmp_path / "new" / "folder", first)
    append_run(tmp_path / "new" / "folder", second)
    actual, notes = read_runs(tmp_path / "new" / "folder")
    assert list(actual.values()) == [first, second]
    assert notes == ()


def test_the_newest_run_of_a_key_counts(tmp_path: Path) -> None:
    for made in (record("1", count=1), record("2"), record("1", count=2)):
        append_run(tmp_path, made)
    actual, _ = read_runs(tmp_path)
    assert list(actual) == ["2", "1"]
    assert actual["1"].count == 2


def test_every_way_to_cut_the_last_line(tmp_path: Path) -> None:
    path = tmp_path / RUNS
    append_run(tmp_path, record("1", count=10))
    start = path.stat().st_size
    append_run(tmp_path, record("2", count=20))
    whole = path.read_bytes()
    for length in range(start, len(whole)):
        path.write_bytes(whole[:length])
        actual, notes = read_runs(tmp_path)
        assert list(actual) == ["1"]
        assert len(notes) == (length > start)
        append_run(tmp_path, record("2", count=20))
        assert path.read_bytes() == whole


def test_a_damaged_line_in_the_middle_costs_that_line_alone(tmp_path: Path) -> None:
    for key in "123":
        append_run(tmp_path, record(key))
    lines = (tmp_path / RUNS).read_bytes().splitlines(keepends=True)
    lines[1] = b"\x00" * 20 + b"\n"
    (tmp_path / RUNS).write_bytes(b"".join(lines))
    actual, notes = read_runs(tmp_path)
    assert list(actual) == ["1", "3"]
    assert "line 2 is damaged" in notes[0]


def test_lines_of_another_version_are_passed_over(tmp_path: Path) -> None:
    append_run(tmp_path, record("1"))
    append_line(tmp_path / RUNS, record("2").to_dict() | {"schema_version": 99})
    append_line(tmp_path / RUNS, {"schema_version": 1, "key": "3"})
    actual, notes = read_runs(tmp_path)
    assert list(actual) == ["1"]
    assert "2 line(s) of another version" in notes[0]


@pytest.mark.parametrize(
    "odd",
    [{"pictures": None}, {"settings": "k"}, {"stages": {"fit": "long"}}, {"ratio": "4%"}, {"count": True},
     {"scene": 3}, {"notes": [1]}, {"psnr_target": float("inf")}],
    ids=str,
)  # fmt: skip
def test_lines_of_other_kinds_of_values_are_passed_over(odd: dict[str, object], tmp_path: Path) -> None:
    append_run(tmp_path, record("1", psnr_target=20.5, stages={"fit": 2}))
    with (tmp_path / RUNS).open("a") as file:
        file.write(json.dumps(record("2").to_dict() | odd) + "\n")
    actual, notes = read_runs(tmp_path)
    assert list(actual) == ["1"]
    assert "1 line(s) of another version" in notes[0]


def test_long_lines_are_cut_back_to_the_right_place(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    append_line(path, {"a": 1})
    with path.open("ab") as file:
        file.write(b"x" * 200_000)
    append_line(path, {"b": 2})
    assert read_lines(path).values == ({"a": 1}, {"b": 2})


def test_what_is_no_json_is_refused_and_leaves_the_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    append_line(path, {"a": 1})
    with pytest.raises(ValueError, match="JSON"):
        append_line(path, {"a": float("nan")})
    assert read_lines(path).values == ({"a": 1},)


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SceneError, match="cannot be written"):
        append_line(tmp_path / "file" / RUNS, {})


def test_keys_do_not_depend_on_order_and_do_on_everything_else(monkeypatch: pytest.MonkeyPatch) -> None:
    key = experiment_key("aa", "gsmerge", {"k": 2, "budget": "1%"}, 3)
    assert key == experiment_key("aa", "gsmerge", {"budget": "1%", "k": 2}, 3)
    assert len(key) == 64
    others = {
        experiment_key("ab", "gsmerge", {"k": 2, "budget": "1%"}, 3),
        experiment_key("aa", "voxel", {"k": 2, "budget": "1%"}, 3),
        experiment_key("aa", "gsmerge", {"k": 1, "budget": "1%"}, 3),
        experiment_key("aa", "gsmerge", {"k": 2, "budget": "1%"}, None),
    }
    monkeypatch.setattr("gsmerge.research.charts.record.__version__", gsmerge.__version__ + ".1")
    others.add(experiment_key("aa", "gsmerge", {"k": 2, "budget": "1%"}, 3))
    assert len(others | {key}) == 6


def test_a_key_stays_the_same_from_version_to_version_of_python(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsmerge.research.charts.record.__version__", "1.0")
    text = b'{"method":"gsmerge","scene":"aa","schema_version":1,"settings":{"k":2},"tool_version":"1.0","views":null}'
    assert experiment_key("aa", "gsmerge", {"k": 2}, None) == hashlib.sha256(text).hexdigest()


def test_content_is_names_and_bytes(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    (folder / "a.png").write_bytes(b"1")
    (folder / "b.png").write_bytes(b"2")
    before = content_hash([folder])
    assert before == content_hash([folder])
    (folder / "b.png").rename(folder / "c.png")
    renamed = content_hash([folder])
    (folder / "a.png").write_bytes(b"3")
    assert len({before, renamed, content_hash([folder])}) == 3
    with pytest.raises(SceneError, match="cannot be read"):
        content_hash([tmp_path / "nothing"])


def test_scores_are_fields() -> None:
    made = record("1", **{name: float(i) for i, name in enumerate(SCORES)})
    assert [made.score(name) for name in SCORES] == list(range(16))
    assert json.loads(json.dumps(made.to_dict()))["lpips_alex_target_visible"] == 15
    with pytest.raises(ValueError, match="expected one of"):
        made.score("count")


@pytest.mark.parametrize("field", ["key", "settings", "views_asked", "count", "seconds", "stages", "pictures", "error"])
def test_lines_of_odd_types_are_passed_over(field: str, tmp_path: Path) -> None:
    append_run(tmp_path, record("good"))
    whole = (tmp_path / RUNS).read_text()
    odd = [10**400, [1], {"a": [1]}, True, "\0", [[]], float("inf")]
    lines = [json.dumps({**record("odd").to_dict(), field: value}) for value in odd]
    (tmp_path / RUNS).write_text("\n".join(["[" * 100_000, *lines, whole]))
    records, notes = read_runs(tmp_path)
    assert "good" in records
    assert notes
