from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_scene import (
    FLIP,
    Tiny,
    frames_of,
    write_colmap_binary,
    write_colmap_text,
    write_images,
    write_inria,
    write_npz,
    write_transforms,
)

from gsmerge.errors import SceneError
from gsmerge.io import CameraFile, read_cameras, to_cameras


def assert_same(actual: CameraFile, tiny: Tiny, *, K: np.ndarray | None = None, atol: float = 1e-9) -> None:
    assert actual.viewmats.dtype == actual.Ks.dtype == np.float64
    assert np.allclose(actual.viewmats, tiny.w2c, atol=atol)
    assert np.allclose(actual.Ks, tiny.K if K is None else K, atol=atol * 100)
    assert actual.widths.tolist() == [tiny.width] * 3
    assert actual.heights.tolist() == [tiny.height] * 3
    assert len(actual) == 3


def save_json(path: Path, data: object) -> Path:
    path.write_text(json.dumps(data))
    return path


# transforms.json


def test_transforms_with_global_intrinsics(tmp_path: Path, tiny: Tiny) -> None:
    write_transforms(tmp_path / "transforms.json", tiny)
    actual = read_cameras(tmp_path / "transforms.json")
    assert_same(actual, tiny)
    assert actual.names == tuple(f"images/{n}" for n in tiny.names)
    assert actual.source == "transforms.json"
    assert actual.images is None


def test_transforms_with_intrinsics_of_each_view(tmp_path: Path, tiny: Tiny) -> None:
    data = frames_of(tiny)
    for i, frame in enumerate(data["frames"]):
        frame |= {"fl_x": 10.0 + i, "fl_y": 20.0, "cx": 3.0, "cy": 4.0, "w": 30 + i, "h": 40}
    actual = read_cameras(save_json(tmp_path / "transforms.json", data))
    assert actual.Ks[2].tolist() == [[12, 0, 3], [0, 20, 4], [0, 0, 1]]
    assert actual.widths.tolist() == [30, 31, 32]


def test_transforms_from_the_angle_of_view(tmp_path: Path, tiny: Tiny) -> None:
    data = {"camera_angle_x": 2 * np.arctan(0.5), "w": 20, "h": 14, "frames": frames_of(tiny)["frames"]}
    actual = read_cameras(save_json(tmp_path / "transforms.json", data))
    assert np.allclose(actual.Ks[0], [[20, 0, 10], [0, 20, 7], [0, 0, 1]])
    data |= {"camera_angle_y": 2 * np.arctan(0.25)}
    assert np.allclose(read_cameras(save_json(tmp_path / "t.json", data)).Ks[0, 1, 1], 28)


def test_transforms_without_a_size_take_the_images(tmp_path: Path, tiny: Tiny) -> None:
    write_images(tmp_path / "images", tiny)
    frames = frames_of(tiny)["frames"]
    for frame in frames:
        frame["file_path"] = frame["file_path"].removesuffix(".png")
    data = {"camera_angle_x": 2 * np.arctan(0.5), "frames": frames}
    actual = read_cameras(save_json(tmp_path / "transforms.json", data))
    assert actual.widths.tolist() == [20] * 3
    assert np.allclose(actual.Ks[0], [[20, 0, 10], [0, 20, 7], [0, 0, 1]])
    with pytest.raises(SceneError, match="expected 'w' and 'h', found neither them nor the image"):
        read_cameras(save_json(tmp_path / "images" / "transforms.json", data))


def test_transforms_with_full_intrinsics_need_no_size(tmp_path: Path, tiny: Tiny) -> None:
    data = frames_of(tiny)
    del data["w"], data["h"]
    actual = read_cameras(save_json(tmp_path / "transforms.json", data))
    assert actual.widths.tolist() == [0] * 3
    with pytest.raises(SceneError, match="expected the image size"):
        to_cameras(actual)
    assert to_cameras(actual, (20, 14)).width == 20


def test_applied_transform_is_not_applied(tmp_path: Path, tiny: Tiny) -> None:
    data = frames_of(tiny) | {"applied_transform": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]], "applied_scale": 3}
    assert_same(read_cameras(save_json(tmp_path / "transforms.json", data)), tiny)


def test_a_bare_list_is_opencv_and_lacks_intrinsics(tmp_path: Path, tiny: Tiny) -> None:
    frames = [{"file_path": n, "transform_matrix": m} for n, m in zip(tiny.names, tiny.c2w.tolist(), strict=True)]
    with pytest.raises(SceneError, match=r"expected intrinsics .*found none of fl_x, w, h for view a b/2\.png; add"):
        read_cameras(save_json(tmp_path / "transforms.json", frames))
    common = {k: v for k, v in frames_of(tiny).items() if k != "frames"}
    actual = read_cameras(save_json(tmp_path / "transforms.json", [f | common for f in frames]))
    assert_same(actual, tiny)
    assert actual.convention == ("camera-to-world", "OpenCV")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "found camera model EQUIRECTANGULAR; undistort"),
        ({"k4": 0.1}, "found lens distortion k4, which formats understand differently; undistort"),
        ({"fl_x": -3}, "expected positive focal lengths"),
        ({"fl_x": "wide"}, "expected numbers"),
        ({"w": 1e999}, "expected numbers"),
        ({"h": -14}, "expected a positive image size, found 20 x -14"),
        ({"cx": float("nan")}, "expected finite numbers"),
        ({"frames": []}, "expected at least one camera"),
        ({"frames": {"a": 1}}, "expected 'frames' to be a list"),
        ({"frames": [{"file_path": "a.png"}]}, r"view a\.png: expected 'transform_matrix', found none"),
        ({"frames": [{"transform_matrix": [[1, 0], [0, 1]]}]}, "expected a pose of 3x4 or 4x4"),
        ({"frames": [{"transform_matrix": np.diag([1.0, 1, -1, 1]).tolist()}]}, "found a mirrored"),
        ({"frames": [{"transform_matrix": np.diag([2.0, 2, 2, 1]).tolist()}]}, "axes are not orthonormal"),
    ],
)
def test_transforms_that_are_refused(tmp_path: Path, tiny: Tiny, change: dict, message: str) -> None:
    path = save_json(tmp_path / "transforms.json", frames_of(tiny) | change)
    with pytest.raises(SceneError, match=message):
        read_cameras(path)


def test_zero_distortion_is_a_pinhole(tmp_path: Path, tiny: Tiny) -> None:
    data = frames_of(tiny) | {"camera_model": "OPENCV", "k1": 0.0, "k2": 0, "p1": 0, "distortion_params": [0, 0]}
    assert_same(read_cameras(save_json(tmp_path / "transforms.json", data)), tiny)


# COLMAP


@pytest.mark.parametrize("write", [write_colmap_text, write_colmap_binary])
@pytest.mark.parametrize("place", [".", "sparse/0", "sparse", "colmap/sparse/0", "colmap"])
def test_colmap_models(tmp_path: Path, tiny: Tiny, write: Callable[[Path, Tiny], None], place: str) -> None:
    write(tmp_path / place, tiny)
    actual = read_cameras(tmp_path)
    assert_same(actual, tiny)
    assert actual.names == tiny.names
    assert actual.convention == ("world-to-camera", "OpenCV")


def test_colmap_by_one_of_its_files(tmp_path: Path, tiny: Tiny) -> None:
    write_colmap_binary(tmp_path, tiny)
    assert_same(read_cameras(tmp_path / "images.bin"), tiny)
    (tmp_path / "cameras.bin").unlink()
    with pytest.raises(SceneError, match="expected a COLMAP model with cameras and images"):
        read_cameras(tmp_path / "images.bin")


def test_colmap_models_without_distortion(tmp_path: Path, tiny: Tiny) -> None:
    write_colmap_text(tmp_path / "a", tiny, "OPENCV", " 0 0 0 0")
    assert_same(read_cameras(tmp_path / "a"), tiny)
    write_colmap_binary(tmp_path / "b", tiny, 4, (0.0, 0.0, 0.0, 0.0))
    assert_same(read_cameras(tmp_path / "b"), tiny)
    (tmp_path / "a" / "cameras.txt").write_text("7 SIMPLE_RADIAL 20 14 30 9 8 0\n")
    assert read_cameras(tmp_path / "a").Ks[0].tolist() == [[30, 0, 9], [0, 30, 8], [0, 0, 1]]
    (tmp_path / "a" / "cameras.txt").write_text("7 SIMPLE_PINHOLE 20 14 30 9 8\n")
    assert read_cameras(tmp_path / "a").Ks[0, 1, 1] == 30


def test_unknown_colmap_models_are_refused(tmp_path: Path, tiny: Tiny) -> None:
    for name, model, extra in (("a", 7, (0.1,)), ("b", 10, (0.0,) * 8), ("c", 99, ())):
        write_colmap_binary(tmp_path / name, tiny, model, extra)
        with pytest.raises(SceneError, match=r"camera 7: expected a pinhole, .* found (FOV|THIN|model 99).*undistort"):
            read_cameras(tmp_path / name)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_truncated_colmap_files_are_named(tmp_path: Path, tiny: Tiny, name: str) -> None:
    write_colmap_binary(tmp_path, tiny)
    data = (tmp_path / name).read_bytes()
    for length in (3, 20, len(data) - 5):
        (tmp_path / name).write_bytes(data[:length])
        with pytest.raises(SceneError, match=r"found damaged cameras or images\.bin"):
            read_cameras(tmp_path)


def test_damaged_colmap_text(tmp_path: Path, tiny: Tiny) -> None:
    write_colmap_text(tmp_path, tiny)
    (tmp_path / "images.txt").write_text("1 0.5 0.5 nonsense\n\n")
    with pytest.raises(SceneError, match=r"found damaged cameras or images\.txt"):
        read_cameras(tmp_path)
    write_colmap_text(tmp_path, tiny)
    (tmp_path / "cameras.txt").write_text("8 PINHOLE 20 14 1 1 1 1\n")
    with pytest.raises(SceneError, match=r"view a b/2\.png: its camera is not in cameras\.txt"):
        read_cameras(tmp_path)


# INRIA


def test_inria_cameras(tmp_path: Path, tiny: Tiny) -> None:
    write_inria(tmp_path / "cameras.json", tiny)
    centred = tiny.K.copy()
    centred[:2, 2] = tiny.width / 2, tiny.height / 2
    actual = read_cameras(tmp_path)
    assert_same(actual, tiny, K=centred)
    assert actual.names == ("2", "10", "11")


def test_inria_cameras_with_something_missing(tmp_path: Path) -> None:
    path = save_json(tmp_path / "cameras.json", [{"img_name": "a", "position": [0, 0, 0], "fx": 3}])
    with pytest.raises(SceneError, match="view a: missing rotation, fy, width, height"):
        read_cameras(path)


# Depth Anything 3


def test_npz_with_images(tmp_path: Path, tiny: Tiny) -> None:
    write_npz(tmp_path / "exports/npz/results.npz", tiny)
    actual = read_cameras(tmp_path)
    assert_same(actual, tiny, atol=1e-6)
    assert np.array_equal(actual.images, tiny.images)
    assert actual.names == ("view 0", "view 1", "view 2")


def test_npz_forms(tmp_path: Path, tiny: Tiny) -> None:
    write_npz(tmp_path / "a.npz", tiny, extrinsics=tiny.w2c, image=None)
    actual = read_cameras(tmp_path / "a.npz")
    assert_same(actual, tiny, atol=1e-6)
    assert actual.images is None
    centred = np.tile(np.array([[22.0, 0, 10], [0, 22, 7], [0, 0, 1]]), (3, 1, 1))
    write_npz(tmp_path / "b.npz", tiny, intrinsics=centred, image=None, depth=None)
    assert_same(read_cameras(tmp_path / "b.npz"), tiny, K=centred, atol=1e-6)
    write_npz(tmp_path / "c.npz", tiny, image=(tiny.images / 255).astype(np.float32).transpose(0, 3, 1, 2))
    assert np.array_equal(read_cameras(tmp_path / "c.npz").images, tiny.images)


def test_npz_intrinsics_of_another_size_are_scaled(tmp_path: Path, tiny: Tiny) -> None:
    centred = np.array([[22.0, 0, 10], [0, 21, 7], [0, 0, 1]])
    original = centred * np.array([[8.1], [8.0], [1]])
    write_npz(tmp_path / "a.npz", tiny, intrinsics=np.tile(original, (3, 1, 1)))
    assert_same(read_cameras(tmp_path / "a.npz"), tiny, K=centred, atol=1e-6)
    normalised = centred / np.array([[20], [14], [1]])
    write_npz(tmp_path / "b.npz", tiny, intrinsics=np.tile(normalised, (3, 1, 1)))
    assert_same(read_cameras(tmp_path / "b.npz"), tiny, K=centred, atol=1e-6)


def test_npz_that_are_refused(tmp_path: Path, tiny: Tiny) -> None:
    write_npz(tmp_path / "a.npz", tiny, extrinsics=None, intrinsics=None)
    with pytest.raises(SceneError, match="missing arrays extrinsics, intrinsics, found"):
        read_cameras(tmp_path / "a.npz")
    write_npz(tmp_path / "b.npz", tiny, intrinsics=np.eye(3))
    with pytest.raises(SceneError, match=r"expected extrinsics \[c,3,4\]"):
        read_cameras(tmp_path / "b.npz")
    write_npz(tmp_path / "c.npz", tiny, image=tiny.images[:2])
    with pytest.raises(SceneError, match=r"expected images \[3,h,w,3\], found \[2, 14, 20, 3\]"):
        read_cameras(tmp_path / "c.npz")
    (tmp_path / "d.npz").write_bytes(b"no archive")
    with pytest.raises(SceneError, match=r"readable \.npz file, found something else"):
        read_cameras(tmp_path / "d.npz")
    write_npz(tmp_path / "e.npz", tiny)
    data = bytearray((tmp_path / "e.npz").read_bytes())
    data[200:240] = bytes(40)  # in the first array: its checksum no longer fits
    (tmp_path / "e.npz").write_bytes(data)
    with pytest.raises(SceneError, match=r"readable \.npz file, found a damaged one"):
        read_cameras(tmp_path / "e.npz")


# Telling them apart


def test_what_is_no_camera_file(tmp_path: Path) -> None:
    for name, text, message in (
        ("none.json", None, "no such file or folder"),
        ("text.json", "hello", "expected JSON"),
        ("other.json", '{"a": 1}', "expected 'frames' .* or a list of cameras"),
        ("list.json", "[1, 2]", "expected 'frames' .* or a list of cameras"),
        ("cameras.xml", "<a/>", "expected cameras as"),
    ):
        if text is not None:
            (tmp_path / name).write_text(text)
        with pytest.raises(SceneError, match=message):
            read_cameras(tmp_path / name)
    with pytest.raises(SceneError, match=r"expected transforms\.json, .* found none"):
        read_cameras(tmp_path)


def test_the_first_place_wins(tmp_path: Path, tiny: Tiny) -> None:
    write_colmap_text(tmp_path / "sparse/0", tiny)
    write_inria(tmp_path / "cameras.json", tiny)
    assert read_cameras(tmp_path).source == "INRIA cameras.json"
    write_transforms(tmp_path / "transforms.json", tiny)
    assert read_cameras(tmp_path).source == "transforms.json"
    assert read_cameras(tmp_path / "sparse").source == "COLMAP text"


# One size for all


def test_to_cameras_scales_each_axis(tmp_path: Path, tiny: Tiny) -> None:
    write_transforms(tmp_path / "transforms.json", tiny)
    actual = read_cameras(tmp_path)
    assert np.allclose(to_cameras(actual).Ks, tiny.K)
    scaled = to_cameras(actual, (40, 21))
    assert (scaled.width, scaled.height) == (40, 21)
    assert np.allclose(scaled.Ks, tiny.K * np.array([[2], [1.5], [1]]))
    assert np.allclose(scaled.centres, tiny.c2w[:, :3, 3])


def test_to_cameras_needs_one_size(tmp_path: Path, tiny: Tiny) -> None:
    data = frames_of(tiny)
    data["frames"][1]["w"] = 30
    actual = read_cameras(save_json(tmp_path / "transforms.json", data))
    with pytest.raises(SceneError, match="expected cameras of one image size, found 20 x 14 and 30 x 14"):
        to_cameras(actual)


def test_axes_by_hand(tmp_path: Path) -> None:
    """A camera at (0, 0, 5) that looks down the world's -z: an OpenGL identity rotation."""
    pose = np.eye(4)
    pose[2, 3] = 5
    frame = {"file_path": "a", "transform_matrix": pose.tolist()}
    data = {"fl_x": 10, "cx": 5, "cy": 5, "w": 10, "h": 10, "frames": [frame]}
    cameras = to_cameras(read_cameras(save_json(tmp_path / "transforms.json", data)))
    point = cameras.viewmats[0] @ np.array([1.0, 2.0, 0.0, 1.0], np.float64)
    assert point.tolist() == [1.0, -2.0, 5.0, 1.0]  # right stays right, up becomes -y, 5 in front
    assert np.allclose(cameras.viewmats[0], FLIP @ np.linalg.inv(pose))
    assert cv2.Rodrigues(cameras.viewmats[0, :3, :3])[0][0, 0] == pytest.approx(np.pi)
