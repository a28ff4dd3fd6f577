"""COLMAP models that are written: read back here, and by pycolmap where it is installed."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from messages import refuses
from tiny_scene import Tiny, assert_same

from gsmerge.errors import SceneError
from gsmerge.geometry.transforms import sh0_to_rgb
from gsmerge.io import read_cameras
from gsmerge.io.cameras.colmap_model import POINTS, files_beside, model_files
from gsmerge.types import Cameras

SEEN = (np.array([0, 5, 7]), np.array([], np.int64), np.array([7]))  # of each view


def cameras_of(tiny: Tiny) -> Cameras:
    return Cameras(tiny.w2c, np.repeat(tiny.K[None], 3, 0), tiny.width, tiny.height)


@pytest.fixture
def model(tmp_path: Path, tiny: Tiny) -> Path:
    for name, data in model_files(tiny.gaussians, cameras_of(tiny), tiny.names, SEEN).items():
        (tmp_path / name).write_bytes(data)
    return tmp_path


def test_the_cameras_are_read_back(model: Path, tiny: Tiny) -> None:
    actual = read_cameras(model)
    assert_same(actual, tiny)
    assert actual.names == tiny.names
    assert struct.unpack("<Q", (model / "cameras.bin").read_bytes()[:8]) == (1,)  # which the views share


def test_views_of_several_cameras(tmp_path: Path, tiny: Tiny) -> None:
    Ks = np.stack([tiny.K, tiny.K * [[2], [2], [1]], tiny.K])
    cameras = Cameras(tiny.w2c, Ks, tiny.width, tiny.height)
    for name, data in model_files(tiny.gaussians, cameras, tiny.names, SEEN).items():
        (tmp_path / name).write_bytes(data)
    np.testing.assert_allclose(read_cameras(tmp_path).Ks, Ks)


def test_points_are_the_gaussians_with_what_sees_them(model: Path, tiny: Tiny) -> None:
    data, at, tracks = (model / POINTS).read_bytes(), 8, []
    means, colors = [], []
    for number in range(1, len(tiny.gaussians) + 1):
        point, *mean, r, g, b, error, length = struct.unpack_from("<Q3d3BdQ", data, at)
        assert (point, error) == (number, 0)
        tracks.append(np.frombuffer(data, "<i4", 2 * length, at + 51).reshape(-1, 2).tolist())
        means.append(mean)
        colors.append((r, g, b))
        at += 51 + 8 * length
    assert at == len(data)
    np.testing.assert_array_equal(means, tiny.gaussians.means)
    expected = 255 * sh0_to_rgb(tiny.gaussians.sh0[:, 0])
    np.testing.assert_allclose(colors, expected, atol=0.51)
    assert {i: track for i, track in enumerate(tracks) if track} == {0: [[1, 0]], 5: [[1, 1]], 7: [[1, 2], [3, 0]]}


def test_models_of_colmap_itself_are_not_mixed_with_ours(tmp_path: Path) -> None:
    assert [path.name for path in files_beside(tmp_path / POINTS)] == ["cameras.bin", "images.bin"]
    (tmp_path / "frames.bin").touch()
    with refuses(SceneError, "frames.bin", "another"):
        files_beside(tmp_path / POINTS)


def test_pycolmap_reads_the_same(model: Path, tiny: Tiny) -> None:
    """Its reprojection errors of the tracks are zero only if it reads poses, intrinsics and pixel centres as we do."""
    pycolmap = pytest.importorskip("pycolmap")
    read = pycolmap.Reconstruction(str(model))
    read.update_point_3d_errors()
    assert max(read.points3D[i].error for i in (1, 6, 8)) < 1e-9
    assert [read.images[i].name for i in (1, 2, 3)] == list(tiny.names)
    for i in range(3):
        np.testing.assert_allclose(read.images[i + 1].cam_from_world().matrix(), tiny.w2c[i, :3], atol=1e-12)
    np.testing.assert_allclose(read.cameras[1].calibration_matrix(), tiny.K)
