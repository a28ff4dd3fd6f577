"""Hashes of what is read."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsmerge.errors import SceneError
from gsmerge.io.content_hash import content_hash


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
