"""Poses in text are read as DA3-Streaming writes them, with the intrinsics beside them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scenes
from messages import refuses
from program_cameras import HEIGHT, VIEWS, WIDTH

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras
from gsmerge.io.cameras.read_cameras import find_cameras

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
