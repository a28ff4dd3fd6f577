"""Files of each declared layout are read, and what is wrong is named by file, view and key."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from messages import refuses
from program_cameras import C2W, C2W_OPENGL, CX, CY, FORMATS, FX, FY, HEIGHT, K_DIVIDED, NAMES, VIEWS, W2C, WIDTH, K
from tiny_scene import FLIP, edited_json, rotation

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras, to_cameras
from gsmerge.io.cameras.camera_source import CameraSource
from gsmerge.io.cameras.read_cameras import find_cameras, find_other_cameras
from gsmerge.io.cameras.table import CAMERA_FORMATS
from gsmerge.io.cameras.view_layout import PinholeKeys, RotationAndShift, ViewLayout, read_views
from gsmerge.method.geometry.transforms import mean_pose_frame, quat_to_rotmat, rotmat_to_quat
from gsmerge.method.kernels.elementary import arctan2
from gsmerge.method.kernels.matrices import invert, matmul

Change = Callable[[Any], object]
ANGLE = 2 * float(arctan2(0.5, 1.0))  # of view: the focal length is the side's length


def test_every_declared_layout_has_a_case() -> None:
    assert {row.name for row in CAMERA_FORMATS if isinstance(row.read, ViewLayout)} == FORMATS.keys()


@pytest.mark.parametrize("name", FORMATS)
def test_all_views_of_a_layout_are_read(tmp_path: Path, name: str) -> None:
    path = FORMATS[name].write(tmp_path)
    actual = read_cameras(path)
    assert actual.source == name
    np.testing.assert_allclose(actual.viewmats, W2C, atol=1e-9)
    np.testing.assert_allclose(actual.Ks, np.stack([K] * VIEWS), atol=1e-9)
    assert list(zip(actual.widths, actual.heights, strict=True)) == [FORMATS[name].size] * VIEWS
    assert actual.names == FORMATS[name].names
    assert not actual.lenses
    assert (find_cameras(tmp_path) or find_other_cameras(tmp_path)) == path


def test_a_new_layout_is_declared_without_a_function(tmp_path: Path) -> None:
    """It has quaternions, numbers that all views share, and alternative keys."""
    path = tmp_path / "new.json"
    views = [
        {"id": i, "q": rotmat_to_quat(pose[None, :3, :3])[0].tolist(), "t": pose[:3, 3].tolist()}
        for i, pose in enumerate(W2C)
    ]
    path.write_text(json.dumps({"f": FX, "ratio": None, "px": CX, "py": CY, "W": WIDTH, "H": HEIGHT, "cams": views}))
    layout = ViewLayout(
        views="cams",
        name=("file", "id"),
        pose=RotationAndShift("q", "t", quat_to_rotmat),
        K=PinholeKeys(("focal", "f"), "ratio", "px", "py"),
        size=("W", "H"),
        optional=("ratio",),
    )
    stored = read_views(CameraSource(path), layout).views
    np.testing.assert_allclose([view.pose for view in stored], W2C[:, :3], atol=1e-9)
    assert [view.name for view in stored] == ["0", "1", "2"]
    assert all(view.K is not None and view.K.tolist() == [[FX, 0, CX], [0, FX, CY], [0, 0, 1]] for view in stored)
    path.write_text(path.read_text().replace('"f"', '"g"').replace('"t"', '"s"'))
    with refuses(SceneError, "new.json: view 0", "'t'", "'focal' or 'f'"):
        read_views(CameraSource(path), layout)


@pytest.mark.parametrize("by", [np.ravel, lambda pose: pose[:3].ravel(), lambda pose: pose.T.ravel(), np.transpose])
def test_poses_may_be_flat_or_written_column_by_column(tmp_path: Path, by: Callable[[np.ndarray], np.ndarray]) -> None:
    """As scripts of engines write them; one camera may stand at the origin."""
    poses = C2W_OPENGL.copy()
    poses[0, :3, 3] = 0
    path = FORMATS["transforms.json"].write(tmp_path)
    data = json.loads(path.read_text())
    for frame, pose in zip(data["frames"], poses, strict=True):
        frame["transform_matrix"] = by(pose).tolist()
    path.write_text(json.dumps(data))
    np.testing.assert_allclose(invert(read_cameras(path).viewmats), matmul(poses, FLIP), atol=1e-9)


def test_a_path_of_nerfstudios_viewer_is_read_but_no_scene_has_it(tmp_path: Path) -> None:
    path = tmp_path / "camera_path.json"
    fov = float(np.degrees(ANGLE))
    views = [{"camera_to_world": pose.ravel().tolist(), "fov": fov, "aspect": 1.5} for pose in C2W_OPENGL]
    path.write_text(json.dumps({"render_height": HEIGHT, "render_width": WIDTH, "camera_path": views}))
    cameras = read_cameras(path)
    np.testing.assert_allclose(cameras.viewmats, W2C, atol=1e-9)
    np.testing.assert_allclose(cameras.Ks[0], diagonal(HEIGHT, HEIGHT), atol=1e-9)
    assert (cameras.widths == WIDTH).all()
    assert find_other_cameras(tmp_path) is None
    path.write_text(path.read_text().replace('"fov"', '"f"'))
    with refuses(SceneError, "camera_path.json", "'fov'"):
        read_cameras(path)


@pytest.mark.parametrize("beside", [True, False], ids=["beside it", "above the photos"])
def test_cameras_of_ns_export_have_the_intrinsics_of_the_capture(tmp_path: Path, beside: bool) -> None:
    folder = tmp_path / "exports" / "cameras"
    folder.mkdir(parents=True)
    capture = FORMATS["transforms.json"].write(folder if beside else tmp_path / "data")
    views = [
        {"file_path": str(tmp_path / "data" / "images" / name), "transform": pose[:3].tolist()}
        for name, pose in zip(NAMES, C2W_OPENGL, strict=True)
    ]
    path = folder / "transforms_eval.json"
    path.write_text(json.dumps(views))
    cameras = read_cameras(path)
    np.testing.assert_allclose(cameras.viewmats, W2C, atol=1e-9)
    np.testing.assert_allclose(cameras.Ks[0], K)
    capture.unlink()
    with refuses(SceneError, "transforms_eval.json", "transforms.json"):
        read_cameras(path)


def in_views(*drop: str, **values: Any) -> Change:
    """Change the values of each view, or drop keys."""

    def change(data: Any) -> None:
        views = next((data[key] for key in ("frames", "views") if key in data), data)
        for view in views:
            view |= values
            for key in drop:
                del view[key]

    return change


def in_file(*drop: str, **values: Any) -> Change:
    """Change values that all views share."""

    def change(data: Any) -> None:
        shared = data[1]["cameras"]["v2"] if isinstance(data, list) else data
        shared |= values
        for key in drop:
            del shared[key]

    return change


def per_view(data: Any) -> None:
    for i, frame in enumerate(data["frames"]):
        frame |= {"fl_x": 10.0 + i, "fl_y": 20.0, "cx": 3.0, "cy": 4.0, "w": 30 + i, "h": 40}


def flat_matrices(data: Any) -> None:
    for view in data["views"]:
        view |= {key: np.ravel(view[key]).tolist() for key in ("c2w", "intrinsic", "k_normalized") if key in view}


def reversed_numbers(data: Any) -> None:
    """Name the views 10, 9, 8 in the order of the file, which is from the last to the first."""
    for entries in data.values():
        entries.reverse()
        for i, entry in enumerate(entries):
            entry["camera_id"] = 10 - i


def diagonal(fx: float, fy: float, cx: float = WIDTH / 2, cy: float = HEIGHT / 2) -> list[list[float]]:
    return [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]


BARE = ("fl_x", "fl_y", "cx", "cy")
SIZES = [(WIDTH, HEIGHT)] * VIEWS


@pytest.mark.parametrize(
    ("name", "change", "Ks", "sizes"),
    [
        ("transforms.json", per_view, [diagonal(10 + i, 20, 3, 4) for i in range(3)], [(30, 40), (31, 40), (32, 40)]),
        ("transforms.json", in_file(*BARE, camera_angle_x=ANGLE), diagonal(24, 24), SIZES),
        ("transforms.json", in_file(*BARE, camera_angle_y=ANGLE), diagonal(16, 16), SIZES),
        ("transforms.json", in_file(*BARE, camera_angle_x=ANGLE, camera_angle_y=ANGLE), diagonal(24, 16), SIZES),
        ("transforms.json", in_file("w", "h"), K, [(0, 0)] * VIEWS),
        ("transforms.json", in_file("fl_y", w=None, h=None, cx=0), diagonal(FX, FX, 0, CY), [(0, 0)] * VIEWS),
        ("transforms.json", in_file("fl_x", fl_y=0, camera_angle_x=ANGLE), diagonal(24, 24, CX, CY), SIZES),
        ("transforms.json", in_file(camera_model="OPENCV", k1=0.0, p1=0, distortion_params=[0, 0]), K, SIZES),
        ("transforms.json", in_file(applied_transform=np.eye(4)[[0, 2, 1]].tolist(), applied_scale=3), K, SIZES),
        ("transforms.json", in_views(fl_x=None, w=None), K, SIZES),
        ("INRIA cameras.json", in_views("cx", "cy"), diagonal(FX, FY), SIZES),
        ("GlobalSplat cameras.json", in_views(intrinsic=K_DIVIDED.tolist()), K, SIZES),
        ("GlobalSplat cameras.json", flat_matrices, K, SIZES),
        ("ffgs cameras.json", flat_matrices, K, SIZES),
        ("OpenSfM", in_file("focal_x", "focal_y", "c_x", "c_y", focal=0.5), diagonal(12, 12), SIZES),
    ],
)
def test_other_forms_of_a_layout_are_read(
    tmp_path: Path, name: str, change: Change, Ks: np.ndarray, sizes: list[tuple[int, int]]
) -> None:
    path = FORMATS[name].write(tmp_path)
    with edited_json(path) as data:
        change(data)
    actual = read_cameras(path)
    np.testing.assert_allclose(actual.viewmats, W2C, atol=1e-9)
    np.testing.assert_allclose(actual.Ks, np.broadcast_to(Ks, (VIEWS, 3, 3)), atol=1e-9)
    assert list(zip(actual.widths, actual.heights, strict=True)) == sizes
    assert actual.names == NAMES
    assert not actual.lenses


def test_a_missing_size_is_that_of_the_images(tmp_path: Path) -> None:
    path = FORMATS["transforms.json"].write(tmp_path)
    with edited_json(path) as data:
        in_file(*BARE, "w", "h", camera_angle_x=ANGLE)(data)
    with refuses(SceneError, "transforms.json: view 0.png", "'w'", "'h'"):
        read_cameras(path)
    for name in NAMES:
        (tmp_path / name).write_bytes(b"P6\n20 14\n255\n" + bytes(3 * 20 * 14))
    actual = read_cameras(path)
    assert actual.widths.tolist() == [20] * VIEWS
    np.testing.assert_allclose(actual.Ks[0], diagonal(20, 20, 10, 7))


def test_an_angle_of_view_in_degrees_is_refused(tmp_path: Path) -> None:
    path = FORMATS["transforms.json"].write(tmp_path)
    with edited_json(path) as data:
        in_file(*BARE, camera_angle_x=46.2)(data)
    with refuses(SceneError, "transforms.json", "46.2", "in degrees"):
        read_cameras(path)


def test_a_size_that_nothing_needs_may_be_missing(tmp_path: Path) -> None:
    path = FORMATS["transforms.json"].write(tmp_path)
    with edited_json(path) as data:
        in_file("w", "h")(data)
    with refuses(SceneError, "transforms.json", "(w, h)", "none"):
        to_cameras(read_cameras(path))
    assert to_cameras(read_cameras(path), (20, 14)).width == 20


def test_intrinsics_may_be_missing_in_all_views_only(tmp_path: Path) -> None:
    path = FORMATS["frame list"].write(tmp_path)
    with edited_json(path) as data:
        in_views(*BARE, "w", "h")(data)
    actual = read_cameras(path)
    assert not actual.has_intrinsics
    assert actual.convention == ("camera-to-world", "OpenCV")
    with refuses(SceneError, "transforms.json", "(fx, fy, cx, cy)", "none"):
        to_cameras(actual, (20, 14))
    with edited_json(path) as data:
        data[0] |= {"fl_x": 22, "w": 20, "h": 14}
    with refuses(SceneError, "transforms.json: view 1.png", "fl_x, w, h", "in pixels"):
        read_cameras(path)


def test_world_mirror_s_views_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    path = FORMATS["camera_params.json"].write(tmp_path)
    with edited_json(path) as data:
        reversed_numbers(data)
    actual = read_cameras(path)
    assert actual.names == ("8", "9", "10")
    np.testing.assert_allclose(actual.viewmats, W2C, atol=1e-9)


@pytest.mark.parametrize(
    ("cx", "cy", "size"), [(24, 18, (48, 36)), (24.3, 18, (0, 0)), (-24, 18, (0, 0)), (float("nan"), 18, None)]
)
def test_world_mirror_s_size_is_twice_the_principal_point(
    tmp_path: Path, cx: float, cy: float, size: tuple[int, int] | None
) -> None:
    path = FORMATS["camera_params.json"].write(tmp_path)
    with edited_json(path) as data:
        for entry in data["intrinsics"]:
            entry["matrix"] = diagonal(FX, FY, cx, cy)
    if size is None:
        with refuses(SceneError, "camera_params.json: view 0.png", "finite"):
            read_cameras(path)
        return
    actual = read_cameras(path)
    assert set(zip(actual.widths.tolist(), actual.heights.tolist(), strict=True)) == {size}


def test_cameras_of_long_lrm_are_moved_into_the_frame_of_gaussians(tmp_path: Path) -> None:
    """A point of the cameras' world and its image in the Gaussians' are seen in the same direction."""
    path = FORMATS["Long-LRM"].write(tmp_path)
    (tmp_path / "input_frame_idx.txt").write_text("2 0")
    actual = read_cameras(path)
    point, frame = np.array([[0.2, -0.1, 3.0]]), mean_pose_frame(W2C[[2, 0]])
    moved = frame.move_points(point)[0]
    for view, viewmat in zip((2, 0), actual.viewmats, strict=True):
        seen = frame.scale * (W2C[view] @ np.append(point, 1.0))[:3]
        np.testing.assert_allclose((viewmat @ np.append(moved, 1.0))[:3], seen, atol=1e-9)
    assert np.abs(np.linalg.inv(actual.viewmats)[:, :3, 3]).max() == pytest.approx(1)
    assert actual.names == ("2.png", "0.png")


def test_poses_that_instantsplat_optimised_replace_the_first_ones(tmp_path: Path) -> None:
    FORMATS["INRIA cameras.json"].write(tmp_path)
    turn = np.eye(4)
    turn[:3, :3] = rotation(0.02, 0.01, 0)
    optimised = np.linalg.inv(C2W @ turn)
    for name, steps, poses in (("org", 1000, W2C), ("optimized", 1000, optimised), ("org", 900, W2C)):
        folder = tmp_path / f"pose/ours_{steps}"
        folder.mkdir(parents=True, exist_ok=True)
        np.save(folder / f"pose_{name}.npy", poses.astype(np.float32))
    np.save(folder / "pose_optimized.npy", W2C)  # of fewer steps
    np.testing.assert_allclose(read_cameras(tmp_path).viewmats, optimised, atol=1e-5)
    path = tmp_path / "pose/ours_1000/pose_org.npy"
    damaged = path.read_bytes()[:-8]
    for other in (optimised, W2C[:2], np.zeros((3, 4, 4)), damaged):
        path.write_bytes(other) if isinstance(other, bytes) else np.save(path, other)
        np.testing.assert_allclose(read_cameras(tmp_path).viewmats, W2C, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "old", "new", "model", "coefficients"),
    [
        ("transforms.json", '"fl_x"', '"k1": 0.1, "p2": 0.02, "fl_x"', "perspective", (0.1, 0, 0, 0.02, 0)),
        ("transforms.json", '"fl_x"', '"distortion_params": [0.1, 0.2], "fl_x"', "perspective", (0.1, 0.2, 0, 0, 0)),
        ("transforms.json", '"fl_x"', '"distortion_params": [0.1, 0.2, 0.5, 0, 0.3, 0.4], "fl_x"', "perspective",
         (0.1, 0.2, 0.3, 0.4, 0.5)),
        ("transforms.json", '"fl_x"', '"is_fisheye": true, "k1": 0.1, "fl_x"', "fisheye", (0.1, 0, 0, 0)),
        ("transforms.json", '"fl_x"', '"camera_model": "OPENCV_FISHEYE", "fl_x"', "fisheye", (0, 0, 0, 0)),
        ("OpenSfM", '"brown"', '"brown", "k1": 0.1, "k2": 0.2, "k3": 0.3, "p1": 0.01, "p2": 0.02', "perspective",
         (0.1, 0.2, 0.01, 0.02, 0.3)),
        ("OpenSfM", '"brown"', '"fisheye", "k1": 0.1', "fisheye", (0.1, 0, 0, 0)),
        # Metashape's p1 and p2 are OpenCV's p2 and p1
        ("Metashape", "<f>42", "<k1>0.1</k1><k2>0.2</k2><k3>0.3</k3><p1>0.01</p1><p2>0.02</p2><f>42", "perspective",
         (0.1, 0.2, 0.02, 0.01, 0.3)),
        ("Metashape", 'type="frame"', 'type="fisheye"', "fisheye", (0, 0, 0, 0)),
    ],
)  # fmt: skip
def test_lenses_of_a_layout_are_read(
    tmp_path: Path, name: str, old: str, new: str, model: str, coefficients: tuple[float, ...]
) -> None:
    lens = read_cameras(FORMATS[name].write(tmp_path, old, new)).lenses[0]
    assert (lens.model, lens.coefficients) == (model, coefficients)


@pytest.mark.parametrize(
    ("name", "old", "new", "place", "found"),
    [
        ("transforms.json", '"fl_x"', '"camera_model": "EQUIRECTANGULAR", "fl_x"', "EQUIRECTANGULAR", "360-degree"),
        ("transforms.json", '"fl_x"', '"k4": 0.1, "fl_x"', "view 0.png", "k4"),
        ("transforms.json", '"fl_x": 40.0', '"fl_x": -3', "view 0.png", -3),
        ("transforms.json", '"fl_x": 40.0', '"fl_x": "wide"', "expected numbers", "'wide'"),
        ("transforms.json", '"w": 24', '"w": 1e999', "view 0.png", "infinity"),
        ("transforms.json", '"h": 16', '"h": -16', "", "24 x -16"),
        ("transforms.json", '"cx": 13.0', '"cx": NaN', "view 0.png", "NaN"),
        ("transforms.json", '"cx": 13.0', '"cx": 1e9', "view 0.png", "principal point"),
        ("transforms.json", '"fl_x": 40.0', '"fl_x": 1e300', "view 0.png", "1e+300"),
        ("transforms.json", '"fl_x"', '"k1": NaN, "fl_x"', "view 0.png", "k1"),
        ("transforms.json", '"frames": [', '"frames": [], "other": [', "", "camera"),
        ("transforms.json", '"frames": [', '"frames": {"a": 1}, "other": [', "", "'frames'"),
        ("transforms.json", '"transform_matrix"', '"matrix"', "view 0.png", "'transform_matrix'"),
        ("transforms.json", '"transform_matrix": [', '"transform_matrix": [[1]], "m": [', "view 0.png", (1, 1)),
        ("transforms.json", '"transform_matrix": [',
         '"transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0]], "m": [', "view 0.png", "mirrored"),
        ("transforms.json", '"transform_matrix": [',
         '"transform_matrix": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]], "m": [', "view 0.png", "orthonormal"),
        ("INRIA cameras.json", '"rotation"', '"r"', "view 0.png", "'rotation'"),
        ("INRIA cameras.json", '"fy"', '"f"', "view 0.png", "'fy'"),
        ("INRIA cameras.json", '"height": 16', '"height": null', "view 0.png", "'height'"),
        ("Long-LRM", '"fx"', '"f"', "view 0.png", "'fx'"),
        ("GlobalSplat cameras.json", "c2w", "w2c", "view 0.png", "'c2w'"),
        ("ffgs cameras.json", '"c2w": [', '"c2w": [1, 2, 3], "c": [', "view 0.png", "'c2w'"),
        ("ffgs cameras.json", '"image_shape": [16, 24]', '"image_shape": [16]', "", "'image_shape'"),
        ("camera_params.json", '"extrinsics": [', '"extrinsics": null, "e": [', "", "'extrinsics'"),
        ("camera_params.json", '"intrinsics": [{"camera_id": "0.png"', '"intrinsics": [{"camera_id": "elsewhere"', "",
         "one for 0.png"),
        ("camera_params.json", '"matrix"', '"m"', "extrinsics", "'matrix'"),
        ("camera_params.json", "[[40.0", "[[1, 2, 3], [40.0", "view 0.png", "'intrinsics'"),
        ("OpenSfM", "translation", "t", "view 0.png", "'translation'"),
        ("OpenSfM", "focal_x", "f", "view 0.png", "'focal_x' or 'focal'"),
        ("OpenSfM", '"c_x": ', '"c_x": "a", "c": ', "expected numbers", "'c_x'"),
        ("OpenSfM", "brown", "spherical", "view 0.png", "SPHERICAL"),
        ("OpenSfM", '"v2": {', '"v3": {', "", "'v2'"),
        ("OpenSfM", '"cameras": {"v2"', '"cameras": [], "c": {"v2"', "", "'cameras'"),
        ("OpenSfM", '"cameras": {"v2"', '"cameras": {"v2": 3, "v3"', "", "no object"),
        ("Polycam", "t_23", "t", "view 8", "'t_23'"),
        ("Polycam", "{", "[", "", "JSON"),
        ("Isaac Sim", "cameraProjection", "c", "view 0008", "cameraProjection"),
        ("Isaac Sim", "pinhole", "fisheyePolynomial", "view 0008", "fisheyePolynomial"),
        ("Isaac Sim", "[24, 16]", "[24]", "view 0008", "renderProductResolution"),
        ("Metashape", "<document", "<!DOCTYPE a><document", "", "DOCTYPE"),
        ("Metashape", "</document>", "", "", "XML"),
        ("Metashape", "transform", "turn", "", "at least one"),
        ("Metashape", "<calibration", "<c", "", "mismatched"),
        ("Metashape", "<f>42", "<k4>0.1</k4><f>42", "view 0.png", "k4"),
        ("Metashape", "resolution", "r", "", "no resolution"),
        ("Metashape", 'sensor_id="0"', 'sensor_id="7"', "view 0.png", "'7'"),
        ("Metashape", "</transform>", " 1</transform>", "view 0.png", 17),
        ("Metashape", 'type="frame"', 'type="spherical"', "view 0.png", "SPHERICAL"),
    ],
)  # fmt: skip
def test_wrong_values_are_named_by_file_view_and_key(
    tmp_path: Path, name: str, old: str, new: str, place: str, found: object
) -> None:
    path = FORMATS[name].write(tmp_path, old, new)
    file = next(iter(FORMATS[name].files)).split("/")[-1]
    with refuses(SceneError, f"{file}: {place}" if place.startswith("view") else file, found):
        read_cameras(path)


@pytest.mark.parametrize(
    ("name", "text", "found"),
    [
        ("input_frame_idx.txt", "0 7", ("0 to 2", 7)),
        ("input_frame_idx.txt", "nan", ("NaN",)),
        ("input_frame_idx.txt", "0 " * 10_001, (10000, "more")),
        ("input_frame_idx.txt", "1e999", ("infinity",)),
    ],
)
def test_files_beside_long_lrm_s_cameras_are_checked(
    tmp_path: Path, name: str, text: str, found: tuple[object, ...]
) -> None:
    path = FORMATS["Long-LRM"].write(tmp_path)
    (tmp_path / name).write_text(text)
    with refuses(SceneError, name, *found):
        read_cameras(path)
