"""What stands in the place of a file is named, whatever the file's ending."""

from __future__ import annotations

import gzip
import io
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from messages import refuses

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras, read_gaussians
from gsmerge.io.bounds import check_file
from gsmerge.io.first_bytes import NO_TEXT

LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 63327587\n"
PAGE = b"\n<!doctype HTML>\n<head><title>\n Virus scan\n warning</title></head>"
SCENES = (".ply", ".spz", ".splat", ".sog", ".ksplat", ".npz", ".glb", ".gsm")


def zipped() -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("scene.ply", b"ply\n")
    return content.getvalue()


def tarred() -> bytes:
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("scene.ply"))
    return content.getvalue()


CONTENTS = (
    (LFS, SCENES, ("LFS", "git lfs pull")),
    (PAGE, SCENES, ("web page", "'Virus scan warning'", "download")),
    (b"", SCENES, ("empty", "download")),
    (b'{"error": "Not found"}', SCENES, ("text", "Not found", "download")),
    (b"404: Not Found", SCENES, ("text", "404: Not Found")),
    (zipped(), (".ply", ".spz", ".splat", ".glb", ".gsm", ".zip"), ("zip", "unpack")),
    (gzip.compress(b"ply\n", mtime=0), (".ply", ".splat", ".sog", ".npz", ".gz"), ("gzip", "unpack")),
    (tarred(), SCENES, ("tar", "unpack")),
    (b"7z\xbc\xaf\x27\x1c\0\4", SCENES, ("7z", "unpack")),
    (b"Rar!\x1a\x07\x01\0", SCENES, ("rar", "unpack")),
    (b"ply\nformat ascii 1.0\n", SCENES[1:], ("PLY", ".ply")),
    (b'{"asset": {"version": "2.0"}}', (".gltf",), ("glTF", ".glb")),
)


@pytest.mark.parametrize(("content", "endings", "found"), CONTENTS, ids=[found[0] for _, _, found in CONTENTS])
def test_what_stands_in_the_place_of_a_scene(
    content: bytes, endings: tuple[str, ...], found: tuple[str, ...], tmp_path: Path
) -> None:
    for ending in endings:
        (tmp_path / f"a{ending}").write_bytes(content)
        with refuses(SceneError, f"a{ending}", *found):
            read_gaussians(tmp_path / f"a{ending}")


def test_what_stands_in_the_place_of_cameras_and_photos(tmp_path: Path) -> None:
    for content, found in ((LFS, "LFS"), (PAGE, "page")):
        (tmp_path / "cameras.json").write_bytes(content)
        with refuses(SceneError, "cameras.json", found):
            read_cameras(tmp_path / "cameras.json")
        (tmp_path / "a.JPG").write_bytes(content)
        with refuses(SceneError, "a.JPG", found):
            check_file(tmp_path / "a.JPG")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.json", b'{"frames": []}'), ("a.txt", b""), ("a.html", PAGE), ("a.ply", b"ply\r\nformat ascii 1.0\r\n"),
        ("a.sog", zipped()), ("a.npz", zipped()), ("a.spz", gzip.compress(b"a", mtime=0)),
        ("a.ppm", b"P3\n1 1\n255\n0 0 0\n"),
    ],
)  # fmt: skip
def test_right_files_are_let_through(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    assert check_file(tmp_path / name) == len(content)


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 2**32 - 1), size=st.floats(1e-3, 1e4))
def test_positions_of_splats_are_no_other_content(
    seed: int, size: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("splats") / "a.splat"
    rows = np.random.default_rng(seed).normal(0, size, (4, 8)).astype("<f4")
    path.write_bytes(rows.tobytes())
    assert check_file(path) == 128
    assert path.suffix in NO_TEXT
