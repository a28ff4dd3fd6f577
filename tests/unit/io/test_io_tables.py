from __future__ import annotations

import sys
from pathlib import Path

import pytest

from gsmerge.errors import SceneError
from gsmerge.io.tables import read_table


def test_json_and_toml(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"steps": 3, "network": {"width": 16}}')
    assert read_table(tmp_path / "a.json") == {"steps": 3, "network": {"width": 16}}
    (tmp_path / "a.toml").write_text("steps = 3\n[network]\nwidth = 16\n")
    if sys.version_info >= (3, 11):
        assert read_table(tmp_path / "a.toml") == {"steps": 3, "network": {"width": 16}}
    else:
        with pytest.raises(SceneError, match="JSON"):
            read_table(tmp_path / "a.toml")


@pytest.mark.parametrize("text", ["[1]", "{", "3", "[" * 100_000, "\x00"])
def test_what_is_no_table_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(SceneError, match="expected") as caught:
        read_table(path)
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe\x00")
    for name in ("nowhere.json", "bytes.json", "."):
        with pytest.raises(SceneError, match="can be read"):
            read_table(tmp_path / name)
