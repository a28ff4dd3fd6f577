"""Cameras in JSON: nerfstudio's, INRIA's, and in another frame than the Gaussians."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import smooth_scene
from messages import refuses
from sweeps import sweep
from tiny_scene import (
    FLIP,
    Tiny,
    assert_same,
    frames_of,
    rotation,
    save_json,
    write_colmap_text,
    write_images,
    write_inria,
    write_transforms,
)

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras, to_cameras
from gsmerge.kernels.elementary import arctan2
from gsmerge.scene.held_out import read_into_frame
from gsmerge.scene.read import load_scene


def test_transforms_with_global_intrinsics(tmp_path: Path, tiny: Tiny) -> None:
    write_transforms(tmp_path / "transforms.json", tiny)
    actual = read_cameras(tmp_path / "transforms.json")
    assert_same(actual, tiny)
    assert actual.names == tuple(f"images/{n}" for n in tiny.names)
    assert actual.source == "transforms.json"
    assert len(actual.images) == 0


def test_transforms_with_intrinsics_of_each_view(tmp_path: Path, tiny: Tiny) -> None:
    data = frames_of(tiny)
    for i, frame in enumerate(data["frames"]):
        frame |= {"fl_x": 10.0 + i, "fl_y": 20.0, "cx": 3.0, "cy": 4.0, "w": 30 + i, "h": 40}
    actual = read_cameras(save_json(tmp_path / "transforms.json", data))
    assert actual.Ks[2].tolist() == [[12, 0, 3], [0, 20, 4], [0, 0, 1]]
    assert actual.widths.tolist() == [30, 31, 32]


def test_transforms_from_the_angle_of_view(tmp_path: Path, tiny: Tiny) -> None:
    data = {"camera_angle_x": 2 * float(arctan2(0.5, 1)), "w": 20, "h": 14, "frames": frames_of(tiny)["frames"]}
    actual = read_cameras(save_json(tmp_path / "transforms.json", data))
    assert np.allclose(actual.Ks[0], [[20, 0, 10], [0, 20, 7], [0, 0, 1]])
    data |= {"camera_angle_y": 2 * float(arctan2(0.25, 1))}
    assert np.allclose(read_cameras(save_json(tmp_path / "t.json", data)).Ks[0, 1, 1], 28)


def test_transforms_without_a_size_take_the_images(tmp_path: Path, tiny: Tiny) -> None:
    write_images(tmp_path / "images", tiny)
    frames = frames_of(tiny)["frames"]
    for frame in frames:
        frame["file_path"] = frame["file_path"].removesuffix(".png")
    data = {"camera_angle_x": 2 * float(arctan2(0.5, 1)), "frames": frames}
    actual = read_cameras(save_json(tmp_path / "transforms.json", data))
    assert actual.widths.tolist() == [20] * 3
    assert np.allclose(actual.Ks[0], [[20, 0, 10], [0, 20, 7], [0, 0, 1]])
    with refuses(SceneError, "transforms.json: view images/a b/2", "'w'", "'h'"):
        read_cameras(save_json(tmp_path / "images" / "transforms.json", data))


def test_transforms_with_full_intrinsics_need_no_size(tmp_path: Path, tiny: Tiny) -> None:
    data = frames_of(tiny)
    del data["w"], data["h"]
    actual = read_cameras(save_json(tmp_path / "transforms.json", data))
    assert actual.widths.tolist() == [0] * 3
    with refuses(SceneError, "transforms.json", "(w, h)", "none"):
        to_cameras(actual)
    assert to_cameras(actual, (20, 14)).width == 20


def test_applied_transform_is_not_applied(tmp_path: Path, tiny: Tiny) -> None:
    data = frames_of(tiny) | {"applied_transform": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]], "applied_scale": 3}
    assert_same(read_cameras(save_json(tmp_path / "transforms.json", data)), tiny)


def test_a_bare_list_is_opencv_and_may_lack_intrinsics(tmp_path: Path, tiny: Tiny) -> None:
    frames = [{"file_path": n, "transform_matrix": m} for n, m in zip(tiny.names, tiny.c2w.tolist(), strict=True)]
    bare = read_cameras(save_json(tmp_path / "transforms.json", frames))
    assert np.allclose(bare.viewmats, tiny.w2c)
    assert bare.focal is None
    with refuses(SceneError, "transforms.json", "(fx, fy, cx, cy)", "none"):
        to_cameras(bare, (20, 14))
    one = [frames[0] | {"fl_x": 22}, *frames[1:]]
    with refuses(SceneError, "transforms.json: view a b/2.png", "'w'", "'h'"):
        read_cameras(save_json(tmp_path / "transforms.json", one))
    common = {k: v for k, v in frames_of(tiny).items() if k != "frames"}
    actual = read_cameras(save_json(tmp_path / "transforms.json", [f | common for f in frames]))
    assert_same(actual, tiny)
    assert actual.convention == ("camera-to-world", "OpenCV")


@pytest.mark.parametrize(
    ("change", "view", "found"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "images/a b/2.png", "EQUIRECTANGULAR"),
        ({"k4": 0.1}, "images/a b/2.png", "k4"),
        ({"fl_x": -3}, "images/a b/2.png", -3), ({"fl_x": "wide"}, "", "'wide'"),
        ({"w": 1e999}, "images/a b/2.png", "infinity"), ({"h": -14}, "", "20 x -14"),
        ({"cx": float("nan")}, "images/a b/2.png", "NaN"), ({"frames": []}, "", "camera"),
        ({"cx": 1e9}, "images/a b/2.png", "principal point"), ({"fl_x": 1e300}, "images/a b/2.png", "1e+300"),
        ({"k1": float("nan"), "camera_model": "OPENCV"}, "images/a b/2.png", "k1"),
        ({"frames": {"a": 1}}, "", "'frames'"),
        ({"frames": [{"file_path": "a.png"}]}, "a.png", "'transform_matrix'"),
        ({"frames": [{"transform_matrix": [[1, 0], [0, 1]]}]}, "view 0", (2, 2)),
        ({"frames": [{"transform_matrix": np.diag([1.0, 1, -1, 1]).tolist()}]}, "view 0", "mirrored"),
        ({"frames": [{"transform_matrix": np.diag([2.0, 2, 2, 1]).tolist()}]}, "view 0", "orthonormal"),
    ],
)  # fmt: skip
def test_transforms_that_are_refused(tmp_path: Path, tiny: Tiny, change: dict, view: str, found: object) -> None:
    path = save_json(tmp_path / "transforms.json", frames_of(tiny) | change)
    with refuses(SceneError, f"{path}: view {view}" if view else path, found):
        read_cameras(path)


def test_zero_distortion_is_a_pinhole(tmp_path: Path, tiny: Tiny) -> None:
    data = frames_of(tiny) | {"camera_model": "OPENCV", "k1": 0.0, "k2": 0, "p1": 0, "distortion_params": [0, 0]}
    assert_same(read_cameras(save_json(tmp_path / "transforms.json", data)), tiny)


def test_inria_cameras(tmp_path: Path, tiny: Tiny) -> None:
    write_inria(tmp_path / "cameras.json", tiny)
    centred = tiny.K.copy()
    centred[:2, 2] = tiny.width / 2, tiny.height / 2
    actual = read_cameras(tmp_path)
    assert_same(actual, tiny, K=centred)
    assert actual.names == ("2", "10", "11")


def test_inria_cameras_with_something_missing(tmp_path: Path) -> None:
    path = save_json(tmp_path / "cameras.json", [{"img_name": "a", "position": [0, 0, 0], "fx": 3}])
    with refuses(SceneError, "cameras.json: view a", "missing", "rotation, fy, width, height"):
        read_cameras(path)


SMOOTH = smooth_scene(24, 18)


TURN, SHIFT, SCALE = rotation(0.4, -1.2, 0.7), np.array([1.5, -2.0, 0.5]), 0.3


NOTE = "the cameras are moved into the Gaussians' frame by dataparser_transforms.json"


def trained(folder: Path, *, move: bool = True) -> Tiny:
    """Some of the Gaussians in no order, where nerfstudio puts them: X' = s (T [X; 1]); photos beside them."""
    some = np.random.default_rng(0).permutation(1296)[:864]
    gaussians = SMOOTH.gaussians[some]
    if move:
        means = SCALE * (gaussians.means.astype(np.float64) @ TURN.T + SHIFT)
        gaussians = replace(gaussians, means=means.astype(np.float32), scales=SCALE * gaussians.scales)
    there = replace(SMOOTH, gaussians=gaussians)
    there.save(folder, cameras=False)
    write_dataparser(folder)
    return there


def write_dataparser(folder: Path, **changes: object) -> None:
    matrix = np.concatenate([TURN, SHIFT[:, None]], 1).tolist()
    (folder / "dataparser_transforms.json").write_text(json.dumps({"transform": matrix, "scale": SCALE} | changes))


def assert_moved(folder: Path) -> None:
    loaded = load_scene(folder)
    assert NOTE in loaded.notes
    centres = SCALE * (SMOOTH.c2w[:, :3, 3] @ TURN.T + SHIFT)
    assert np.allclose(loaded.scene.cameras.centres, centres)
    assert np.allclose(loaded.scene.cameras.viewmats[:, :3, :3], SMOOTH.w2c[:, :3, :3] @ TURN.T)
    assert np.array_equal(loaded.cameras.viewmats, loaded.scene.cameras.viewmats)


def test_cameras_of_the_capture_are_moved(tmp_path: Path) -> None:
    trained(tmp_path)
    write_colmap_text(tmp_path / "sparse", SMOOTH)
    assert_moved(tmp_path)


def test_other_cameras_of_the_capture_are_moved_with_them(tmp_path: Path) -> None:
    """Held-out views, or those of a path, are in the capture's world and share no view with the scene."""
    trained(tmp_path)
    write_colmap_text(tmp_path / "sparse", SMOOTH)
    write_transforms(tmp_path / "path.json", replace(SMOOTH, names=("x.png", "y.png", "z.png")))
    placed, shared = read_into_frame(load_scene(tmp_path), tmp_path / "path.json")
    assert shared == {}
    expected = SMOOTH.w2c
    expected[:, :3, :3] = expected[:, :3, :3] @ TURN.T
    centres = SCALE * (SMOOTH.c2w[:, :3, 3] @ TURN.T + SHIFT)
    expected[:, :3, 3] = -(expected[:, :3, :3] * centres[:, None]).sum(-1)
    np.testing.assert_allclose(placed.viewmats, expected, atol=1e-6)


def test_poses_that_are_moved_already(tmp_path: Path) -> None:
    """``transform`` starts from the world before ``applied_transform``, in which the poses no longer are."""
    trained(tmp_path)
    applied = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0.25], [0, 0, 0, 1]])
    data = frames_of(SMOOTH)
    poses = applied @ SMOOTH.c2w @ FLIP
    poses[:, :3, 3] *= 2
    for frame, pose in zip(data["frames"], poses, strict=True):
        frame["transform_matrix"] = pose.tolist()
    data |= {"applied_transform": applied[:3].tolist(), "applied_scale": 2.0}
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    own = np.eye(4)  # from the saved poses to where nerfstudio puts them, but for its scale of SCALE / 2
    own[:3, :3] = TURN @ applied[:3, :3].T
    own[:3, 3] = 2 * (SHIFT - own[:3, :3] @ applied[:3, 3])
    write_dataparser(tmp_path, transform=(own @ applied)[:3].tolist(), scale=SCALE / 2 * 2)
    assert_moved(tmp_path)


def test_it_is_left_alone_where_it_does_not_help(tmp_path: Path) -> None:
    trained(tmp_path, move=False)
    write_colmap_text(tmp_path / "sparse", SMOOTH)
    loaded = load_scene(tmp_path)
    assert NOTE not in loaded.notes
    assert np.allclose(loaded.scene.cameras.viewmats, SMOOTH.w2c)


def test_without_it_the_cameras_do_not_see_the_gaussians(tmp_path: Path) -> None:
    trained(tmp_path)
    write_colmap_text(tmp_path / "sparse", SMOOTH)
    (tmp_path / "dataparser_transforms.json").unlink()
    with refuses(SceneError, "scene.ply", 1296, 864):
        load_scene(tmp_path, cameras=tmp_path / "sparse")


@sweep(
    ("text", "found"),
    [
        ("{}", "'scale'"),
        ("no", "JSON"),
        (json.dumps({"transform": [[1, 2], [3, 4]], "scale": 1}), [2, 2]),
        (json.dumps({"transform": np.eye(4).tolist(), "scale": -1}), "another map"),
        (json.dumps({"transform": (2 * np.eye(4)).tolist(), "scale": 1}), "another map"),
    ],
    often=1,
)
def test_a_damaged_file(tmp_path: Path, text: str, found: object) -> None:
    trained(tmp_path)
    write_colmap_text(tmp_path / "sparse", SMOOTH)
    (tmp_path / "dataparser_transforms.json").write_text(text)
    with refuses(SceneError, "dataparser_transforms.json", found):
        load_scene(tmp_path, cameras=tmp_path / "sparse")


def test_poses_that_instantsplat_optimised(tmp_path: Path, tiny: Tiny) -> None:
    write_inria(tmp_path / "cameras.json", tiny)
    turn = np.eye(4)
    turn[:3, :3] = rotation(0.02, 0.01, 0)
    optimised = replace(tiny, c2w=tiny.c2w @ turn)
    for name, steps, poses in (("org", 1000, tiny), ("optimized", 1000, optimised), ("org", 900, tiny)):
        folder = tmp_path / f"pose/ours_{steps}"
        folder.mkdir(parents=True, exist_ok=True)
        np.save(folder / f"pose_{name}.npy", poses.w2c.astype(np.float32))
    np.save(folder / "pose_optimized.npy", tiny.w2c)  # of fewer steps
    assert np.allclose(read_cameras(tmp_path).viewmats, optimised.w2c, atol=1e-5)
    path = tmp_path / "pose/ours_1000/pose_org.npy"
    damaged = path.read_bytes()[:-8]
    for other in (optimised.w2c, tiny.w2c[:2], np.zeros((3, 4, 4)), damaged):
        path.write_bytes(other) if isinstance(other, bytes) else np.save(path, other)
        assert np.allclose(read_cameras(tmp_path).viewmats, tiny.w2c)
