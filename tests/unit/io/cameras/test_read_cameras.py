"""Camera files are told apart and found in folders."""

from __future__ import annotations

from pathlib import Path

from messages import refuses
from program_cameras import FORMATS
from tiny_scene import Tiny, write_colmap_text, write_inria, write_transforms

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras
from gsmerge.io.cameras.read_cameras import find_cameras, find_other_cameras


def test_other_files_are_refused_as_cameras(tmp_path: Path) -> None:
    for name, text, found in (
        ("none.json", None, "no such file"),
        ("text.json", "hello", "JSON"),
        ("other.json", '{"a": 1}', "'frames'"),
        ("list.json", '[{"a": 1}, 2]', "found 2 as entry 2"),
        ("cameras.yml", "<a/>", ".npz"),
    ):
        if text is not None:
            (tmp_path / name).write_text(text)
        with refuses(SceneError, name, found):
            read_cameras(tmp_path / name)
    with refuses(SceneError, tmp_path, "results.npz", "none"):
        read_cameras(tmp_path)


def test_cameras_are_read_from_the_first_of_their_usual_places(tmp_path: Path, tiny: Tiny) -> None:
    write_colmap_text(tmp_path / "sparse/0", tiny)
    write_inria(tmp_path / "cameras.json", tiny)
    assert read_cameras(tmp_path).source == "INRIA cameras.json"
    write_transforms(tmp_path / "transforms.json", tiny)
    assert read_cameras(tmp_path).source == "transforms.json"
    assert read_cameras(tmp_path / "sparse").source == "COLMAP text"


def test_a_file_of_metashape_is_found_under_any_name(tmp_path: Path) -> None:
    path = FORMATS["Metashape"].write(tmp_path).rename(tmp_path / "Chunk 1.xml")
    (tmp_path / "other.xml").write_text("<a/>")
    assert find_cameras(tmp_path) is None
    assert find_other_cameras(tmp_path) == path


def test_xml_of_more_elements_than_its_bytes_allow_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cameras.xml"
    path.write_text("<a>" + "<b/>" * 2_000_000 + "</a>")
    with refuses(SceneError, "cameras.xml", "XML", "MB"):
        read_cameras(path)
