"""Cameras in the comments of a ``.ply``: what is written is read again, by us alone, and skipped by others."""

from __future__ import annotations

import base64
import zlib
from pathlib import Path

import numpy as np
import pytest
from former_formats import compressed_bytes
from plyfile import PlyData
from saved_cameras import camera_comments
from tiny_scene import make_tiny

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras, read_ply, write_gaussians
from gsmerge.io.cameras.embedded import EMBEDDED, PREFIX, holds_cameras
from gsmerge.types import Cameras

TINY = make_tiny()
CAMERAS = Cameras(TINY.w2c, np.tile(TINY.K, (3, 1, 1)), TINY.width, TINY.height)


def write(path: Path, comments: list[str]) -> Path:
    comments = ["SplatRenderMode: mip", *comments]
    if path.name.endswith(".compressed.ply"):
        path.write_bytes(compressed_bytes(TINY.gaussians, comments))
    else:
        write_gaussians(path, TINY.gaussians, comments=comments)
    return path


@pytest.mark.parametrize("name", ["scene.ply", "scene.compressed.ply"])
def test_cameras_come_back(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / name, camera_comments(CAMERAS, TINY.names))
    assert holds_cameras(path)
    actual = read_cameras(path)
    assert (actual.names, actual.source) == (TINY.names, EMBEDDED)
    assert (actual.widths.tolist(), actual.heights.tolist()) == ([TINY.width] * 3, [TINY.height] * 3)
    np.testing.assert_allclose(actual.viewmats, CAMERAS.viewmats, atol=1e-8)
    np.testing.assert_allclose(actual.Ks, CAMERAS.Ks, rtol=1e-9)


def test_other_readers_see_the_same_gaussians(tmp_path: Path) -> None:
    """One element, as many columns, all lines short: the header differs in comments, the rows in nothing."""
    plain, own = write(tmp_path / "a.ply", []), write(tmp_path / "b.ply", camera_comments(CAMERAS, TINY.names))
    one, other = (PlyData.read(str(path)) for path in (plain, own))
    assert [element.name for element in other.elements] == ["vertex"]
    assert np.array_equal(one["vertex"].data, other["vertex"].data)
    heads = [path.read_bytes().partition(b"end_header\n") for path in (plain, own)]
    assert heads[0][2] == heads[1][2]
    lines = [[line for line in head.splitlines() if not line.startswith(b"comment ")] for head, *_ in heads]
    assert lines[0] == lines[1]
    assert max(map(len, heads[1][0].splitlines())) < 1024
    assert read_ply(own).info.columns == read_ply(plain).info.columns


def test_a_file_without_cameras_has_none(tmp_path: Path) -> None:
    path = write(tmp_path / "a.ply", [])
    assert not holds_cameras(path)
    with pytest.raises(SceneError, match="cameras inside it"):
        read_cameras(path)


def wrap(content: bytes) -> list[str]:
    text = base64.b64encode(content).decode()
    return [PREFIX + text[i : i + 900] for i in range(0, len(text), 900)]


@pytest.mark.parametrize(
    "comments",
    [
        [PREFIX + "no base64!"],
        wrap(b"not deflated"),
        wrap(zlib.compress(b"no JSON")),
        wrap(zlib.compress(b"[1, 2]")),
        wrap(zlib.compress(b'{"frames": 3}')),
        wrap(zlib.compress(b'{"frames": []}')),
        wrap(zlib.compress(b"[" * 100_000)),
        wrap(zlib.compress(b" " * (32 << 20))),
        camera_comments(CAMERAS, TINY.names)[:-1] or [PREFIX + camera_comments(CAMERAS, TINY.names)[0][-100:]],
    ],
    ids=["letters", "packed", "text", "list", "number", "none", "deep", "bomb", "cut"],
)
def test_damaged_cameras_are_refused_in_one_line(tmp_path: Path, comments: list[str]) -> None:
    path = write(tmp_path / "a.ply", comments)
    assert holds_cameras(path)
    with pytest.raises(SceneError) as caught:
        read_cameras(path)
    assert str(path) in str(caught.value)
