"""Archives: what may be packed in them, and their checksums."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
from messages import refuses

from gsmerge.errors import SceneError
from gsmerge.io.archives import damaged_member, open_archive, read_member

METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)


@pytest.mark.parametrize("method", METHODS)
def test_stored_and_deflated_members_alone_are_read(method: int, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("b", bytes(1000))
    if method > zipfile.ZIP_DEFLATED:
        with refuses(SceneError, "a.npz", "'b'", "stored or deflated", f"method {method}"), open_archive(path):
            pass
        assert f"method {method}" in (damaged_member(path) or "")
        return
    with open_archive(path) as archive:
        assert read_member(archive, archive.getinfo("b")) == bytes(1000)
    assert damaged_member(path) is None


def test_a_member_unpacks_to_what_it_promises(tmp_path: Path) -> None:
    """A longer one, whose checksum is that of its start, as ``zipfile`` has it, is read so far."""
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("b", bytes(1 << 24))
        archive.getinfo("b").file_size = 512
        archive.getinfo("b").CRC = 0xB2AA7578
    with open_archive(path) as archive:
        assert read_member(archive, archive.getinfo("b")) == bytes(512)


def test_checksums_of_more_than_the_file_may_unpack_to_are_not_read(tmp_path: Path) -> None:
    """The same packed bytes, 131 kB, by 40 names."""
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("b", bytes(1 << 27))
        archive.filelist *= 40
    assert "found 327,680" in (damaged_member(path) or "")
