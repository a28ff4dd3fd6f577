"""Archives are read member by member, within the sizes that they state."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
from messages import refuses

from gsmerge.errors import SceneError
from gsmerge.io.archives import open_archive, read_member

METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)


@pytest.mark.parametrize("method", METHODS)
def test_stored_and_deflated_members_alone_are_read(method: int, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("b", bytes(1000))
    if method > zipfile.ZIP_DEFLATED:
        with refuses(SceneError, "a.npz", "'b'", "stored or deflated", f"method {method}"), open_archive(path):
            pass
        return
    with open_archive(path) as archive:
        assert read_member(archive, archive.getinfo("b")) == bytes(1000)


def test_a_member_is_read_up_to_the_size_that_it_states(tmp_path: Path) -> None:
    """A longer one, whose checksum is that of its start, as ``zipfile`` has it, is read so far."""
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("b", bytes(1 << 24))
        archive.getinfo("b").file_size = 512
        archive.getinfo("b").CRC = 0xB2AA7578
    with open_archive(path) as archive:
        assert read_member(archive, archive.getinfo("b")) == bytes(512)
