"""COLMAP models are read as text or binary, and damaged ones are refused."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from messages import refuses
from tiny_scene import Tiny, assert_same, write_colmap_binary, write_colmap_text

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras
from gsmerge.io.cameras import colmap


@pytest.mark.parametrize("write", [write_colmap_text, write_colmap_binary])
@pytest.mark.parametrize("place", [".", "sparse/0", "sparse", "colmap/sparse/0", "colmap"])
def test_colmap_models_are_found_in_every_usual_folder(
    tmp_path: Path, tiny: Tiny, write: Callable[[Path, Tiny], None], place: str
) -> None:
    write(tmp_path / place, tiny)
    actual = read_cameras(tmp_path)
    assert_same(actual, tiny)
    assert actual.names == tiny.names
    assert actual.convention == ("world-to-camera", "OpenCV")


def test_a_colmap_model_is_read_by_the_name_of_one_file(tmp_path: Path, tiny: Tiny) -> None:
    write_colmap_binary(tmp_path, tiny)
    assert_same(read_cameras(tmp_path / "images.bin"), tiny)
    (tmp_path / "cameras.bin").unlink()
    with refuses(SceneError, "images.bin", "COLMAP", "pair"):
        read_cameras(tmp_path / "images.bin")


@pytest.mark.parametrize(("centre", "size"), [((20, 14), (40, 28)), ((20, 24), (80, 56)), ((20.3, 14.2), (80, 56))])
def test_sizes_of_photos_become_those_of_the_intrinsics(
    tmp_path: Path, tiny: Tiny, centre: tuple[float, float], size: tuple[int, int]
) -> None:
    """WorldMirror 1 writes them: twice the principal point is whole and has the photos' shape."""
    K = np.array([[30, 0, centre[0]], [0, 30, centre[1]], [0, 0, 1.0]])
    write_colmap_text(tmp_path, replace(tiny, K=K, width=80, height=56))
    cameras = read_cameras(tmp_path)
    assert (cameras.widths[0], cameras.heights[0]) == size


def test_colmap_models_of_zero_distortion_are_pinholes(tmp_path: Path, tiny: Tiny) -> None:
    write_colmap_text(tmp_path / "a", tiny, "OPENCV", " 0 0 0 0")
    assert_same(read_cameras(tmp_path / "a"), tiny)
    write_colmap_binary(tmp_path / "b", tiny, 4, (0.0, 0.0, 0.0, 0.0))
    assert_same(read_cameras(tmp_path / "b"), tiny)
    (tmp_path / "a" / "cameras.txt").write_text("7 SIMPLE_RADIAL 20 14 30 9 8 0\n")
    assert read_cameras(tmp_path / "a").Ks[0].tolist() == [[30, 0, 9], [0, 30, 8], [0, 0, 1]]
    (tmp_path / "a" / "cameras.txt").write_text("7 SIMPLE_PINHOLE 20 14 30 9 8\n")
    assert read_cameras(tmp_path / "a").Ks[0, 1, 1] == 30


@pytest.mark.parametrize(
    ("name", "model", "extra", "found"),
    [("a", 7, (0.1,), "FOV"), ("b", 10, (0.0,) * 8, "THIN_PRISM_FISHEYE"), ("c", 99, (), "model 99")],
)
def test_unknown_colmap_models_are_refused(
    name: str, model: int, extra: tuple[float, ...], found: str, tmp_path: Path, tiny: Tiny
) -> None:
    write_colmap_binary(tmp_path / name, tiny, model, extra)
    with refuses(SceneError, "cameras.bin: camera 7", found):
        read_cameras(tmp_path / name)


def test_cameras_of_panoramas_in_a_colmap_model_are_refused_with_their_own_remedy(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 EQUIRECTANGULAR 2000 1000\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.jpg\n\n")
    with refuses(SceneError, "cameras.txt: camera 1", "cube faces"):
        read_cameras(tmp_path)


def test_a_colmap_model_that_shrinks_while_it_is_read_is_refused(
    tmp_path: Path, tiny: Tiny, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message is one line. Reading mapped pages beyond the end would end the process by a signal."""
    write_colmap_binary(tmp_path, tiny)
    path, make_pose = tmp_path / "images.bin", colmap._make_pose
    data = path.read_bytes()
    end = data.index(b"\0", 72) + 1  # of the first image's name; points follow it
    path.write_bytes(data[:end] + struct.pack("<Q", 50_000) + bytes(24 * 50_000) + data[end + 8 :])

    def pose_then_cut(numbers: list[float]) -> np.ndarray:
        os.truncate(path, 4096)
        return make_pose(numbers)

    monkeypatch.setattr(colmap, "_make_pose", pose_then_cut)
    with refuses(SceneError, tmp_path, "damaged", "images.bin"):
        read_cameras(tmp_path)


@pytest.mark.parametrize("kept", ["none", "all but empty ones", "the empty ones"])
def test_colmap_text_is_read_without_the_lines_of_points(tmp_path: Path, tiny: Tiny, kept: str) -> None:
    write_colmap_text(tmp_path, tiny)
    lines = (tmp_path / "images.txt").read_text().splitlines()
    if kept != "all but empty ones":
        lines = [line for line in lines if not line.startswith("10.5")]
    if kept != "the empty ones":
        lines = [line for line in lines if line]
    (tmp_path / "images.txt").write_text("\n".join(lines))
    actual = read_cameras(tmp_path)
    assert_same(actual, tiny)
    assert actual.names == tiny.names


def test_points_of_whole_numbers_are_not_taken_for_an_image(tmp_path: Path, tiny: Tiny) -> None:
    write_colmap_text(tmp_path, tiny)
    lines = (tmp_path / "images.txt").read_text().replace("10.5 3.5 -1 4.0 4.0 12 ", "10 3 7 4 4 7 5 6 7 1 1 7 ")
    (tmp_path / "images.txt").write_text(lines)
    assert read_cameras(tmp_path).names == tiny.names
