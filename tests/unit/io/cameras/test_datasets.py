"""Cameras of KITTI, Replica, RealEstate10K and EasyVolcap are read, and what is wrong is named by file and line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from messages import refuses
from program_cameras import C2W, CX, CY, FX, FY, HEIGHT, VIEWS, W2C, WIDTH, K

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras
from gsmerge.io.cameras.read_cameras import find_cameras, find_other_cameras
from gsmerge.method.geometry.transforms import motion_vectors
from gsmerge.method.kernels.matrices import invert, matmul

Write = Callable[[Path], Path]


def in_lines(poses: np.ndarray) -> str:
    return "".join(" ".join(map(repr, pose[:3].reshape(-1).tolist())) + "\n" for pose in poses)


def write_kitti(folder: Path, baseline: float = 0.0, camera: int = 2) -> Path:
    """Write poses of camera 0, from which the camera whose photos are there stands ``baseline`` to the right."""
    (folder / f"image_{camera}").mkdir()
    offset = np.eye(4)
    offset[0, 3] = -baseline
    (folder / "poses.txt").write_text(in_lines(matmul(C2W, offset)))
    shift = matmul(K, offset[:3, 3:])
    projections = {i: np.c_[K, shift if i == camera else np.zeros(3)] for i in range(4)}
    text = "".join(f"P{i}: {' '.join(map(repr, p.reshape(-1).tolist()))}\n" for i, p in projections.items())
    (folder / "calib.txt").write_text(f"{text}Tr: {' '.join(['0'] * 12)}\n")
    (folder / "times.txt").write_text("0.0\n0.1\n0.2\n")
    return folder / "poses.txt"


def write_replica(folder: Path) -> Path:
    (folder / "traj.txt").write_text("".join(" ".join(map(repr, pose.reshape(-1).tolist())) + "\n" for pose in C2W))
    camera = {"fx": FX, "fy": FY, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT, "scale": 6553.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return folder / "traj.txt"


def write_realestate(folder: Path) -> Path:
    lens = f"{FX / WIDTH!r} {FY / HEIGHT!r} {CX / WIDTH!r} {CY / HEIGHT!r} 0.0 0.0"
    lines = (f"{1000 + i} {lens} {line}" for i, line in enumerate(in_lines(W2C).splitlines()))
    (folder / "0a1b.txt").write_text("https://www.youtube.com/watch?v=a\n" + "\n".join(lines) + "\n")
    return folder / "0a1b.txt"


def opencv_matrix(name: str, values: np.ndarray) -> str:
    rows, columns = values.shape
    numbers = ", ".join(map(repr, values.reshape(-1).tolist()))
    return f"{name}: !!opencv-matrix\n  rows: {rows}\n  cols: {columns}\n  dt: d\n  data: [ {numbers} ]\n"


def write_easyvolcap(folder: Path, vectors: bool = False, lens: str = "D", k1: float = 0.0) -> Path:
    """Write both files; poses are rotations, or the vectors alone."""
    motions = motion_vectors(np.tile(np.eye(4), (VIEWS, 1, 1)), W2C)
    intri = extri = '%YAML:1.0\n---\nnames:\n  - "00"\n  - "01"\n  - "02"\n'
    for i, (pose, motion) in enumerate(zip(W2C, motions, strict=True)):
        intri += opencv_matrix(f"K_{i:02d}", K) + f"W_{i:02d}: {WIDTH}.\nH_{i:02d}: 1.6e+01\n"
        intri += opencv_matrix(f"{lens}_{i:02d}", np.array([[k1, 0, 0, 0, 0]]))
        rotation = opencv_matrix(f"Rot_{i:02d}", pose[:3, :3])
        extri += opencv_matrix(f"R_{i:02d}", motion[:3, None]) + opencv_matrix(f"T_{i:02d}", pose[:3, 3:])
        extri += "" if vectors else rotation
    (folder / "intri.yml").write_text(intri)
    (folder / "extri.yml").write_text(extri)
    return folder / "extri.yml"


@pytest.mark.parametrize(
    ("write", "source", "size", "name"),
    [
        (write_kitti, "pose list", (0, 0), "000001"),
        (lambda folder: write_kitti(folder, baseline=0.5, camera=3), "pose list", (0, 0), "000001"),
        (write_replica, "pose list", (WIDTH, HEIGHT), "frame000001"),
        (write_easyvolcap, "EasyVolcap", (WIDTH, HEIGHT), "01"),
        (lambda folder: write_easyvolcap(folder, vectors=True), "EasyVolcap", (WIDTH, HEIGHT), "01"),
    ],
)
def test_cameras_of_data_sets_are_read(
    tmp_path: Path, write: Write, source: str, size: tuple[int, int], name: str
) -> None:
    path = write(tmp_path)
    assert find_cameras(tmp_path) == path
    actual = read_cameras(tmp_path)
    assert actual.source == source
    np.testing.assert_allclose(actual.viewmats, W2C, atol=1e-6)
    np.testing.assert_allclose(actual.Ks, np.stack([K] * VIEWS), atol=1e-6)
    assert (actual.widths[0], actual.heights[0]) == size
    assert actual.names[1] == name
    assert not any(actual.lenses)


def test_cameras_of_realestate_are_relative_to_the_size(tmp_path: Path) -> None:
    assert find_other_cameras(tmp_path) is None
    assert write_realestate(tmp_path) == find_other_cameras(tmp_path)
    actual = read_cameras(tmp_path)
    assert actual.source == "RealEstate10K"
    np.testing.assert_allclose(actual.viewmats, W2C, atol=1e-6)
    np.testing.assert_allclose(actual.Ks[0], K / [[WIDTH], [HEIGHT], [1]], atol=1e-9)
    assert actual.names == ("1000", "1001", "1002")


def test_the_camera_of_all_rooms_of_replica_lies_above_them(tmp_path: Path) -> None:
    room = tmp_path / "room0"
    room.mkdir()
    write_replica(room)
    (room / "cam_params.json").rename(tmp_path / "cam_params.json")
    np.testing.assert_allclose(read_cameras(room).Ks[0], K, atol=1e-9)


def test_a_camera_of_easyvolcap_has_the_first_photo_of_its_folder_and_its_lens(tmp_path: Path) -> None:
    write_easyvolcap(tmp_path, lens="dist", k1=-0.1)
    for frame in ("000010", "000002"):
        photo = tmp_path / "images" / "01" / f"{frame}.jpg"
        photo.parent.mkdir(parents=True, exist_ok=True)
        photo.touch()
    actual = read_cameras(tmp_path / "intri.yml")
    assert actual.names == ("00", "01/000002", "02")
    lens = actual.lenses[1]
    assert lens is not None
    assert lens.coefficients[0] == -0.1
    assert np.allclose(invert(actual.viewmats), C2W, atol=1e-6)


@pytest.mark.parametrize(
    ("write", "file", "old", "new", "named"),
    [
        (write_kitti, "calib.txt", "P", "Q", ("calib.txt", "P2")),
        (write_kitti, "calib.txt", "P2: 40.0", "P2: a", ("calib.txt: P2", "'a'")),
        (write_kitti, "calib.txt", "P2: 40.0", "P2: nan", ("poses.txt",)),
        (write_replica, "cam_params.json", "camera", "lens", ("cam_params.json", "'camera'")),
        (write_replica, "cam_params.json", '"w": 24', '"w": true', ("cam_params.json", "true")),
        (write_realestate, "0a1b.txt", "1001 ", "", ("0a1b.txt: line 3", "19 numbers")),
        (write_realestate, "0a1b.txt", "1001 ", "1001 1 ", ("0a1b.txt: line 3", "19 numbers")),
        (write_realestate, "0a1b.txt", " 0.0 0.0 ", " a b ", ("0a1b.txt: line 2", "'a'")),
        (write_easyvolcap, "extri.yml", "T_01", "t_01", ("extri.yml: camera 01", "T_01", "found none", "intri.yml")),
        (write_easyvolcap, "extri.yml", "rows: 3", "rows: 2", ("extri.yml: R_00",)),
        (write_easyvolcap, "intri.yml", "rows: 3", "rows: 9", ("intri.yml: K_00", "9 x 3")),
        (write_easyvolcap, "intri.yml", "K_0", "k_0", ("extri.yml", "at least one")),
    ],
)
def test_what_is_wrong_is_named_by_file_and_line(
    tmp_path: Path, write: Write, file: str, old: str, new: str, named: tuple[str, ...]
) -> None:
    path = write(tmp_path)
    text = (tmp_path / file).read_text()
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new))
    with refuses(SceneError, *named):
        read_cameras(path)
