"""Poses in text are read as data sets and programs write them, with the intrinsics beside them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scenes
from messages import refuses
from program_cameras import HEIGHT, VIEWS, WIDTH

from gsmerge.errors import SceneError
from gsmerge.geometry import rotmat_to_quat
from gsmerge.io import read_cameras
from gsmerge.io.cameras.read import find_cameras, find_other_cameras

W2C = scenes.arc(VIEWS, WIDTH, HEIGHT).viewmats.astype(np.float64)
C2W = np.linalg.inv(W2C)
K = np.array([[40.0, 0, 25], [0, 42, 16], [0, 0, 1]])
K4 = np.pad(K, (0, 1)) + np.diag([0, 0, 0, 1])
QUATS = rotmat_to_quat(C2W[:, :3, :3])[:, [1, 2, 3, 0]]


def text(*numbers: object) -> str:
    return " ".join(repr(float(number)) for number in np.concatenate([np.ravel(part) for part in numbers]))


def rows(matrix: np.ndarray) -> str:
    return "".join(f"{text(row)}\n" for row in matrix)


def lines(of: Callable[[int], str]) -> str:
    return "".join(f"{of(i)}\n" for i in range(VIEWS))


def each(of: Callable[[int], str], name: str = "pose/{}.txt") -> dict[str, str]:
    return {name.format(i): of(i) for i in range(VIEWS)}


FOCAL = text([40, 42, 25, 16])
TUM = lines(lambda i: f"{100 + i / 10:.6f} {text(C2W[i, :3, 3], QUATS[i])}")
RE10K = lines(lambda i: f"{100 * i} {text([40 / WIDTH, 42 / HEIGHT, 25 / WIDTH, 16 / HEIGHT, 0, 0], W2C[i, :3])}")
SRN = f"{text([40, 25, 16, 0])}\n0. 0. 0.\n1.\n{HEIGHT} {WIDTH}\n"
LAYOUTS: dict[str, tuple[str, dict[str, str]]] = {  # place of the poses, and all files
    "KITTI": ("poses.txt", {"poses.txt": lines(lambda i: text(C2W[i, :3])), "intrinsics.txt": FOCAL}),
    "DA3-Streaming": ("camera_poses.txt", {"camera_poses.txt": lines(lambda i: text(C2W[i])), "intrinsic.txt": FOCAL}),
    "a byte order mark": ("poses.txt", {"poses.txt": "\ufeff" + lines(lambda i: text(C2W[i])), "intrinsic.txt": FOCAL}),
    "TUM": ("KeyFrameTrajectory.txt", {"KeyFrameTrajectory.txt": f"# time tx ty tz\n{TUM}", "intrinsic.txt": FOCAL}),
    "MonST3R": ("pred_traj.txt", {"pred_traj.txt": TUM, "pred_intrinsics.txt": lines(lambda i: text(K))}),
    "RealEstate10K": ("0a1b.txt", {"0a1b.txt": f"https://www.youtube.com/watch?v=a\n{RE10K}"}),
    "Tanks and Temples": ("Barn.log", {"Barn.log": lines(lambda i: f"{i} {i} 0\n{rows(C2W[i])}"),
                                       "intrinsic.txt": rows(K)}),
    "ScanNet": ("pose", each(lambda i: rows(C2W[i])) | {"intrinsic/intrinsic_color.txt": rows(K4)}),
    "SRN": ("pose", each(lambda i: text(C2W[i])) | {"intrinsics.txt": SRN}),
    "NeRF++": ("poses", each(lambda i: text(C2W[i]), "poses/{}.txt") | each(lambda i: text(K4), "intrinsics/{}.txt")),
}  # fmt: skip


def write(folder: Path, name: str) -> Path:
    place, files = LAYOUTS[name]
    for file, content in files.items():
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content, encoding="utf-8")
    return folder / place


@pytest.mark.parametrize("name", LAYOUTS)
def test_poses_and_intrinsics_are_read(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, name)
    assert (find_cameras(tmp_path) or find_other_cameras(tmp_path)) == path
    actual = read_cameras(tmp_path)
    np.testing.assert_allclose(actual.viewmats, W2C, atol=1e-6)
    one_focal = np.array([[40.0, 0, 25], [0, 40, 16], [0, 0, 1]])
    stored = {"RealEstate10K": K / [[WIDTH], [HEIGHT], [1]], "SRN": one_focal}.get(name, K)
    np.testing.assert_allclose(actual.Ks, np.stack([stored] * VIEWS), atol=1e-6)
    expected = {"TUM": "100.100000", "MonST3R": "100.100000", "RealEstate10K": "100"}
    assert actual.names[1] == expected.get(name, "1" if name in ("ScanNet", "SRN", "NeRF++") else "000001")


def test_a_view_without_a_pose_is_left_out(tmp_path: Path) -> None:
    path = write(tmp_path, "ScanNet")
    (path / "1.txt").write_text("-inf -inf -inf -inf\n" * 3 + "0 0 0 1\n")
    assert read_cameras(path).names == ("0", "2")


@pytest.mark.parametrize(
    ("name", "file", "content", "named"),
    [
        ("KITTI", "poses.txt", f"{text(C2W[0, :3])}\n1 2 3\n", ("poses.txt: line 2", "12 or 16")),
        ("TUM", "KeyFrameTrajectory.txt", f"# a\n{TUM}1 2\n", ("KeyFrameTrajectory.txt: line 5", "found 2")),
        ("Tanks and Temples", "Barn.log", f"0 0 0\n{rows(C2W[0])}1 1 0\n{rows(C2W[1])[:-20]}", ("Barn.log",)),
        ("Tanks and Temples", "intrinsic.txt", f"1 2\n{rows(K)}", ("intrinsic.txt", "3 lines of 3")),
        ("MonST3R", "pred_intrinsics.txt", f"{text(K)}\n{text(K)}\n", ("pred_intrinsics.txt", "3 views, found 2")),
        ("SRN", "intrinsics.txt", "1 2\n", ("intrinsics.txt", "fx, fy, cx, cy")),
        ("SRN", "pose/1.txt", "a b c d\n", ("pose: line 2", "found 4")),
        ("KITTI", "intrinsics.txt", "", ("intrinsics.txt", "3 views, found 0")),
        ("KITTI", "intrinsics.txt", "a b c d", ("intrinsics.txt: line 1", "'a'")),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(tmp_path: Path, name: str, file: str, content: str, named: tuple[str, ...]) -> None:
    path = write(tmp_path, name)
    (tmp_path / file).write_text(content)
    with refuses(SceneError, *named):
        read_cameras(path)
