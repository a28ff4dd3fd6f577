"""What stands in the place of a file is named, whatever the file's ending."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from damage.generic import LFS, OTHER_CONTENT, PAGE
from hypothesis import given, settings
from hypothesis import strategies as st
from messages import refuses

from gsmerge.errors import SceneError
from gsmerge.io import read_gaussians
from gsmerge.io.bounds import check_file
from gsmerge.io.first_bytes import NO_TEXT
from gsmerge.io.jsonl import append_line
from gsmerge.jobs.batch.records import RECORDS, record
from gsmerge.jobs.file_checks import check_content
from gsmerge.runtime.documents import document_head, to_json

ZIP, _ = OTHER_CONTENT["a zip"]
GLTF = {"a glTF": (b'{"asset": {"version": "2.0"}}', ("glTF", ".glb"))}
# Of endings that ``tests/damage`` has no sound files of
CONTENTS = [
    (".zip", "a zip"), (".gz", "a gzip"), (".gltf", "a glTF"),
]  # fmt: skip


@pytest.mark.parametrize(("ending", "name"), CONTENTS)
def test_other_content_in_the_place_of_a_scene_is_named(ending: str, name: str, tmp_path: Path) -> None:
    content, found = (OTHER_CONTENT | GLTF)[name]
    (tmp_path / f"a{ending}").write_bytes(content)
    with refuses(SceneError, f"a{ending}", *found):
        read_gaussians(tmp_path / f"a{ending}")


@pytest.mark.parametrize(("content", "found"), [(LFS, "LFS"), (PAGE, "page")])
def test_other_content_in_the_place_of_a_photo_is_named(content: bytes, found: str, tmp_path: Path) -> None:
    (tmp_path / "a.JPG").write_bytes(content)
    with refuses(SceneError, "a.JPG", found):
        check_file(tmp_path / "a.JPG")


def test_reports_of_gsmerge_are_named(tmp_path: Path) -> None:
    for name, content in (("a.json", to_json(document_head())), ("a.csv", "schema_version,result,psnr\n")):
        (tmp_path / name).write_text(content)
        assert "a report of gsmerge" in check_content(tmp_path / name).problems[0]
    records = tmp_path / RECORDS
    append_line(records, record("done", "a.ply", "b.ply"))
    check_file(records)  # a batch reads it, but it is no scene
    assert "gsmerge batch" in check_content(records).problems[0]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.json", b'{"frames": []}'), ("a.txt", b""), ("a.html", PAGE), ("a.ply", b"ply\r\nformat ascii 1.0\r\n"),
        ("a.sog", ZIP), ("a.npz", ZIP), ("a.spz", gzip.compress(b"a", mtime=0)),
        ("a.ppm", b"P3\n1 1\n255\n0 0 0\n"),
    ],
)  # fmt: skip
def test_files_of_the_right_content_are_accepted(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    assert check_file(tmp_path / name) == len(content)


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 2**32 - 1), size=st.floats(1e-3, 1e4))
def test_positions_of_splats_are_not_taken_for_other_content(
    seed: int, size: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("splats") / "a.splat"
    rows = np.random.default_rng(seed).normal(0, size, (4, 8)).astype("<f4")
    path.write_bytes(rows.tobytes())
    assert check_file(path) == 128
    assert path.suffix in NO_TEXT
