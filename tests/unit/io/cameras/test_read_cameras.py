"""Camera files are told apart and found in folders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scenes
from messages import refuses
from program_cameras import FORMATS, HEIGHT, VIEWS, WIDTH
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


W2C = scenes.arc(VIEWS, WIDTH, HEIGHT).viewmats.astype(np.float64)
C2W = np.linalg.inv(W2C)
K = np.array([[40.0, 0, 25], [0, 42, 16], [0, 0, 1]])
FOCAL = "40 42 25 16\n"


def write_poses(folder: Path, rows: int, intrinsics: str) -> Path:
    """Write so many rows of each pose a line, after a byte order mark, and the intrinsics beside them."""
    lines = (" ".join(map(repr, pose[:rows].reshape(-1).tolist())) for pose in C2W)
    (folder / "intrinsic.txt").write_text(intrinsics)
    (folder / "camera_poses.txt").write_text("\ufeff" + "\n\n".join(lines), encoding="utf-8")
    return folder / "camera_poses.txt"


@pytest.mark.parametrize(("rows", "intrinsics"), [(3, FOCAL), (4, FOCAL * VIEWS)])
def test_poses_are_read_with_the_intrinsics_beside_them(tmp_path: Path, rows: int, intrinsics: str) -> None:
    assert find_cameras(tmp_path) is None
    assert write_poses(tmp_path, rows, intrinsics) == find_cameras(tmp_path)
    actual = read_cameras(tmp_path)
    np.testing.assert_allclose(actual.viewmats, W2C, atol=1e-6)
    np.testing.assert_allclose(actual.Ks, np.stack([K] * VIEWS), atol=1e-6)
    assert actual.names[1] == "000001"


@pytest.mark.parametrize(
    ("file", "content", "named"),
    [
        ("camera_poses.txt", f"{'1 ' * 12}\n1 2 3\n", ("camera_poses.txt: line 2", "12 or 16", "found 3")),
        ("intrinsic.txt", FOCAL * 2, ("intrinsic.txt", "3 views, found 2")),
        ("intrinsic.txt", "", ("intrinsic.txt", "3 views, found 0")),
        ("intrinsic.txt", "a b c d", ("intrinsic.txt: line 1", "'a'")),
    ],
)
def test_wrong_lines_are_named_by_file_with_what_was_found(
    tmp_path: Path, file: str, content: str, named: tuple[str, ...]
) -> None:
    path = write_poses(tmp_path, 4, FOCAL)
    (tmp_path / file).write_text(content)
    with refuses(SceneError, *named):
        read_cameras(path)
