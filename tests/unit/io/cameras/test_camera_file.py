"""Camera files become cameras of one size, and photos of a lens are undistorted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import smooth_scene
from messages import noted, refuses
from tiny_scene import (
    FLIP,
    Tiny,
    frames_of,
    save_json,
    write_colmap_binary,
    write_colmap_text,
    write_images,
    write_transforms,
)

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras, to_cameras
from gsmerge.io.cameras.camera_file import (
    W2C_OPENCV,
    StoredView,
    make_camera_file,
    make_lens,
    select_views,
    undistort_photos,
)
from gsmerge.jobs.inspect import inspect
from gsmerge.method.kernels import elementary
from gsmerge.reading.read_scene import load_scene


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
    with refuses(SceneError, "transforms.json", "20 x 14", "30 x 14"):
        to_cameras(actual)


def test_opengl_axes_become_those_of_opencv_as_by_hand(tmp_path: Path) -> None:
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


SMOOTH = smooth_scene(60, 45)
K = np.array([[180.0, 0, 96], [0, 170, 77], [0, 0, 1]])


def bent(x: np.ndarray, y: np.ndarray, model: str, c: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Project a point of the plane z = 1 through a lens, by the formulas of COLMAP's and OpenCV's documents."""
    r = np.sqrt(x * x + y * y)
    if model == "fisheye":
        angle = elementary.arctan2(r, 1)
        scale = angle * (1 + sum(k * angle ** (2 * i + 2) for i, k in enumerate(c))) / np.maximum(r, 1e-12)
        return x * scale, y * scale
    k1, k2, p1, p2, k3, k4, k5, k6 = [*c, *[0.0] * (8 - len(c))]
    scale = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    return (x * scale + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2), y * scale + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y)


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("perspective", [0.1]),
        ("perspective", [-0.2, 0.05, 0.01, -0.02]),
        ("perspective", [-0.2, 0.05, 0.01, -0.02, 0.1]),
        ("perspective", [0.1, 0.02, 0, 0.01, 0.01, 0.2, 0.01, 0.02]),
        ("fisheye", []),
        ("fisheye", [0.05, -0.01, 0.004, 0.002]),
    ],
)
def test_undistorted_photos_follow_the_formulas_of_the_lens(model: str, coefficients: list[float]) -> None:
    width, height = 200, 150
    y, x = np.mgrid[:height, :width].astype(np.float64)
    photo = np.stack([x, y, 0 * x], -1).astype(np.uint8)  # every pixel says where it is
    lens = make_lens("A", model, coefficients)
    (straight,) = undistort_photos([photo], K[None], [lens])
    u, v = bent((x + 0.5 - K[0, 2]) / K[0, 0], (y + 0.5 - K[1, 2]) / K[1, 1], model, coefficients)
    expected = np.stack([u * K[0, 0] + K[0, 2] - 0.5, v * K[1, 1] + K[1, 2] - 0.5], -1)
    expected = expected.clip(0, (width - 1, height - 1))  # beyond the photo its border is repeated
    assert np.abs(straight[..., :2] - expected).max() < 0.6


def test_zero_coefficients_are_a_lens_of_a_fisheye_alone() -> None:
    assert make_lens("A", "perspective", [0, 0.0, 0]) is None
    lens = make_lens("B", "fisheye", [0, 0])
    assert lens.coefficients == (0, 0)
    photo = np.zeros((2, 3, 3), np.uint8)
    assert undistort_photos([photo], K[None], [None])[0] is photo


def bent_photos(tiny: Tiny, coefficients: list[float]) -> Tiny:
    """Make the photos that a lens with these coefficients takes of the scene."""
    y, x = np.mgrid[: tiny.height, : tiny.width].astype(np.float32)
    centred = tiny.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    points = np.stack([x, y], -1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(points, centred, np.array(coefficients), P=centred).reshape(*x.shape, 2)
    images = [cv2.remap(i, straight, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE) for i in tiny.images]
    return replace(tiny, images=np.stack(images))


def as_transforms(folder: Path, tiny: Tiny, coefficients: list[float]) -> None:
    write_transforms(folder / "transforms.json", tiny)
    data = json.loads((folder / "transforms.json").read_text())
    keys = dict(zip(("k1", "k2", "p1", "p2"), coefficients, strict=True))
    (folder / "transforms.json").write_text(json.dumps(data | keys | {"camera_model": "OPENCV"}))


@pytest.mark.parametrize("kind", ["colmap text", "colmap binary", "transforms"])
def test_photos_of_a_lens_are_undistorted_with_a_note(tmp_path: Path, kind: str) -> None:
    coefficients = [-0.3, 0.08, 0.01, -0.01]
    taken = bent_photos(SMOOTH, coefficients)
    taken.save(tmp_path, cameras=False)
    if kind == "transforms":
        as_transforms(tmp_path, SMOOTH, coefficients)
    elif kind == "colmap text":
        write_colmap_text(tmp_path / "sparse", SMOOTH, "OPENCV", "".join(f" {c}" for c in coefficients))
    else:
        write_colmap_binary(tmp_path / "sparse", SMOOTH, 4, tuple(coefficients))
    loaded = load_scene(tmp_path)
    scene = loaded.scene
    assert loaded.notes == ("the photos are undistorted (OPENCV); the intrinsics stay",)
    assert np.allclose(scene.cameras.Ks, SMOOTH.K)
    inner = np.s_[:, 6:-6, 6:-6]
    before = np.abs(taken.images[inner].astype(float) - SMOOTH.images[inner]).mean()
    after = np.abs(scene.images[inner] * 255 - SMOOTH.images[inner]).mean()
    assert after < 0.4 * before


def test_photos_that_are_undistorted_already_stay(tmp_path: Path) -> None:
    SMOOTH.save(tmp_path, cameras=False)
    as_transforms(tmp_path, SMOOTH, [-0.3, 0.08, 0.01, -0.01])
    loaded = load_scene(tmp_path)
    assert noted(loaded.notes, "transforms.json", "without their lens")
    np.testing.assert_allclose(loaded.scene.images * 255, SMOOTH.images, atol=2)


def test_cameras_with_a_lens_are_refused_without_their_photos(tmp_path: Path) -> None:
    SMOOTH.save(tmp_path, cameras=False, images=False)
    as_transforms(tmp_path, SMOOTH, [0.1, 0, 0, 0])
    with refuses(SceneError, "transforms.json", "OPENCV", "--images"):
        load_scene(tmp_path, cameras=tmp_path)
    assert "no images" in inspect(tmp_path, cameras=tmp_path)["alignment_problem"]
    with refuses(SceneError, "transforms.json: view images/a b/2.png", "OPENCV"):
        to_cameras(read_cameras(tmp_path))
    write_images(tmp_path / "images", replace(SMOOTH, images=SMOOTH.images[:, :, :25]))
    with refuses(SceneError, "transforms.json", "60 x 45", "OPENCV", "25 x 45"):
        load_scene(tmp_path, cameras=tmp_path, images=tmp_path / "images")


@pytest.mark.parametrize(
    ("model", "params", "expected"),
    [
        ("SIMPLE_RADIAL", "30 9 8 0.1", ("perspective", (0.1,))),
        ("RADIAL", "30 9 8 0.1 0.2", ("perspective", (0.1, 0.2))),
        ("OPENCV", "30 31 9 8 0.1 0.2 0.3 0.4", ("perspective", (0.1, 0.2, 0.3, 0.4))),
        ("FULL_OPENCV", "30 31 9 8 .1 .2 .3 .4 .5 .6 .7 .8", ("perspective", (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8))),
        ("OPENCV_FISHEYE", "30 31 9 8 0 0 0 0", ("fisheye", (0, 0, 0, 0))),
        ("SIMPLE_RADIAL_FISHEYE", "30 9 8 0.1", ("fisheye", (0.1,))),
        ("RADIAL_FISHEYE", "30 9 8 0.1 0.2", ("fisheye", (0.1, 0.2))),
    ],
)
def test_colmap_models_with_distortion_have_a_lens(
    tmp_path: Path, tiny: Tiny, model: str, params: str, expected: tuple
) -> None:
    write_colmap_text(tmp_path, tiny)
    (tmp_path / "cameras.txt").write_text(f"7 {model} 20 14 {params}\n")
    actual = read_cameras(tmp_path)
    assert [(lens.name, lens.model, lens.coefficients) for lens in actual.lenses if lens] == [(model, *expected)] * 3
    assert actual.Ks[0, :2, 2].tolist() == [9, 8]
    assert len(select_views(actual, [1]).lenses) == 1


def test_a_lens_among_pinholes_belongs_to_its_view_alone(tmp_path: Path, tiny: Tiny) -> None:
    data = frames_of(tiny)
    data["frames"][1]["k1"] = 0.1
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    actual = read_cameras(tmp_path)
    assert [lens is None for lens in actual.lenses] == [True, False, True]
    assert select_views(actual, [0, 2]).lenses == ()
    with refuses(SceneError, "transforms.json: view images/a b/10.png", "OPENCV"):
        to_cameras(actual)
    assert to_cameras(select_views(actual, [0, 2])).width == 20


@pytest.mark.parametrize(
    ("K", "size"), [([[9.0, 0, 4], [0, 9, 4], [0, 0, 1]], (8, 8)), ([[50.0, 0, 0.5], [0, 50, 0.5], [0, 0, 1]], (0, 0))]
)
def test_small_intrinsics_in_pixels_are_not_scaled(K: list[list[float]], size: tuple[int, int]) -> None:
    read = make_camera_file("x", "x", W2C_OPENCV, [StoredView("a", np.eye(4), np.array(K), size)])
    assert np.array_equal(read.Ks[0], np.array(K))
    assert (int(read.widths[0]), int(read.heights[0])) == size
