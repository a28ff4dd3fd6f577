"""Lock files change nothing in the place to which a link leads."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import pytest

from gsmerge.errors import SceneError
from gsmerge.io.jsonl import LOCK, append_line
from gsmerge.io.locks import lock_file
from gsmerge.jobs.batch.records import RECORDS, prepare_folder


@pytest.mark.skipif(os.name == "nt", reason="links as POSIX has them")
@pytest.mark.parametrize("name", ["a.lock", LOCK, RECORDS])
def test_a_link_in_the_place_of_a_lock_or_record_is_not_followed(tmp_path: Path, name: str) -> None:
    """Who can write into the output folder cannot let a batch change files elsewhere."""
    kept, folder = tmp_path / "kept.txt", tmp_path / "out"
    kept.write_text("precious\n" * 100)
    folder.mkdir()
    (folder / name).symlink_to(kept)
    with suppress(SceneError), lock_file(folder / "a.lock"):
        pass
    with suppress(SceneError):
        prepare_folder(folder)
        append_line(folder / RECORDS, {"output": "a.ply"})
    assert kept.read_text() == "precious\n" * 100
