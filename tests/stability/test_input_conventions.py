"""Cameras and images that nearly fit: the message says what would."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsmerge.errors import SceneError
from gsmerge.io import load_scene, read_scene

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture
def scene_copy(small_scene: Path, tmp_path: Path) -> Path:
    """A copy that a test may change, of 5 views of 48 x 32: all readings of the cameras are tried on every pixel."""
    return Path(shutil.copytree(small_scene, tmp_path / "scene"))


def with_poses(folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Rewrite transforms.json; ``change`` gets the camera-to-world matrix with OpenGL axes."""
    path = folder / "transforms.json"
    data = json.loads(path.read_text())
    for frame in data["frames"]:
        frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
    path.write_text(json.dumps(data))


def with_values(folder: Path, change: Callable[[dict], dict]) -> None:
    """Rewrite the intrinsics of transforms.json, global and per view."""
    path = folder / "transforms.json"
    data = json.loads(path.read_text())
    data |= change(data) if "w" in data else {}
    for frame in data["frames"]:
        frame |= change(frame) if "w" in frame else {}
    path.write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("change", "hints"),
    [
        (lambda m: m @ FLIP, "camera-to-world matrices with OpenCV axes"),
        (lambda m: FLIP @ np.linalg.inv(m), "world-to-camera matrices with OpenCV axes"),
        (np.linalg.inv, "world-to-camera matrices with OpenGL axes"),
    ],
)
def test_a_swapped_convention_is_read_and_named(
    scene_copy: Path, change: Callable[[np.ndarray], np.ndarray], hints: str
) -> None:
    # world-to-camera with OpenCV axes is FLIP inv(c2w OpenGL); the made scene's own is camera-to-world with OpenGL axes
    usual = read_scene(scene_copy).cameras.viewmats
    with_poses(scene_copy, change)
    loaded = load_scene(scene_copy)
    assert np.allclose(loaded.scene.cameras.viewmats, usual)
    assert any(f"the poses fit when read as {hints}" in note for note in loaded.notes)


def test_wrong_poses_are_measured(scene_copy: Path) -> None:
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.2, 0.0]))[0]
    with_poses(scene_copy, lambda m: m @ turn)
    with pytest.raises(SceneError, match=r"found a median of up to [0-9]+\.[0-9] px .* no other convention fits"):
        read_scene(scene_copy)


def test_swapped_width_and_height(scene_copy: Path) -> None:
    with_values(scene_copy, lambda v: {"w": v["h"], "h": v["w"]})
    with pytest.raises(SceneError, match="found 32 x 48; width and height are swapped"):
        read_scene(scene_copy)


def test_cameras_of_the_original_photos(scene_copy: Path) -> None:
    before = read_scene(scene_copy).cameras
    with_values(scene_copy, lambda v: {k: 3 * v[k] for k in ("w", "h", "fl_x", "fl_y", "cx", "cy") if k in v})
    loaded = load_scene(scene_copy)
    assert np.allclose(loaded.scene.cameras.Ks, before.Ks)
    assert loaded.notes == ("intrinsics scaled from 144 x 96 to the images' 48 x 32",)


@pytest.mark.parametrize("size", [(96, 64), (42, 28), (48, 30)])
def test_images_of_another_size_are_brought_to_the_grid(scene_copy: Path, size: tuple[int, int]) -> None:
    usual = read_scene(scene_copy).images
    for path in (scene_copy / "images").iterdir():
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), size))
    loaded = load_scene(scene_copy)
    assert np.abs(loaded.scene.images - usual).mean() < 0.05
    assert loaded.notes == (
        f"photos of {size[0]} x {size[1]} are resized to 48 x 32, the cameras' and the Gaussian grid's size",
    )


def test_previews_name_both_sizes(scene_copy: Path) -> None:
    for path in (scene_copy / "images").iterdir():
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (24, 16)))
    with pytest.raises(SceneError, match="Gaussian grid's size 48 x 32 or larger, found 24 x 16"):
        read_scene(scene_copy)


def test_fewer_cameras_than_views(scene_copy: Path) -> None:
    path = scene_copy / "transforms.json"
    data = json.loads(path.read_text())
    data["frames"] = data["frames"][:3]
    path.write_text(json.dumps(data))
    expected = "3 x 32 x 48 = 4608 .views x height x width., found 7680; that is 5 views of this size"
    with pytest.raises(SceneError, match=expected):
        read_scene(scene_copy)


def test_oblong_pixels_and_a_shifted_principal_point(scene_copy: Path) -> None:
    """A crop that the cameras do not know of is found out."""
    assert read_scene(scene_copy) is not None
    with_values(scene_copy, lambda v: {"cx": v["cx"] + 5} if "cx" in v else {})
    with pytest.raises(SceneError, match=r"found a median of up to [45]\.[0-9] px and 100 % in front"):
        read_scene(scene_copy)
