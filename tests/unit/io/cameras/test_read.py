"""Camera files are told apart; those of single backbones are read."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import scenes
from tiny_scene import (
    Tiny,
    edited_json,
    write_colmap_text,
    write_inria,
    write_transforms,
)

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras

VIEWS = 3


@pytest.fixture(scope="module")
def truth() -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera matrices and intrinsics."""
    cameras = scenes.arc(VIEWS, 28, 14)
    return cameras.viewmats.astype(np.float64), cameras.Ks.astype(np.float64)


def assert_equal(path: Path, viewmats: np.ndarray, Ks: np.ndarray) -> None:
    actual = read_cameras(path)
    np.testing.assert_allclose(actual.viewmats, viewmats, atol=1e-9)
    np.testing.assert_allclose(actual.Ks, Ks, atol=1e-9)


def entries(matrices: np.ndarray) -> list[dict[str, object]]:
    return [{"camera_id": f"image_{i:04d}", "matrix": m.tolist()} for i, m in enumerate(matrices)]


def world_mirror(folder: Path, viewmats: np.ndarray, Ks: np.ndarray) -> Path:
    path = folder / "camera_params.json"
    document = {"num_cameras": VIEWS, "extrinsics": entries(np.linalg.inv(viewmats)), "intrinsics": entries(Ks)}
    path.write_text(json.dumps(document))
    return path


def long_lrm(folder: Path, viewmats: np.ndarray, Ks: np.ndarray) -> Path:
    path = folder / "scene.json"
    frames = [
        {"file_path": f"{i}.png", "w2c": m.tolist(), "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2],
         "w": 28, "h": 14}
        for i, (m, K) in enumerate(zip(viewmats, Ks, strict=True))
    ]  # fmt: skip
    path.write_text(json.dumps({"frames": frames}))
    return path


def trajectory(folder: Path, viewmats: np.ndarray, Ks: np.ndarray, *, columns: int = 16) -> Path:
    path = folder / "camera_poses.txt"
    rows = [" ".join(map(repr, map(float, m.reshape(-1)[:columns]))) for m in np.linalg.inv(viewmats)]
    path.write_text("\n".join(rows) + "\n")
    K = Ks[0]
    (folder / "intrinsic.txt").write_text(f"{K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}\n")
    return path


@pytest.mark.parametrize("write", [world_mirror, long_lrm, trajectory])
def test_poses_and_intrinsics_are_read(tmp_path: Path, truth: tuple[np.ndarray, np.ndarray], write) -> None:  # type: ignore[no-untyped-def]
    assert_equal(write(tmp_path, *truth), *truth)


@pytest.mark.parametrize("name", ["camera_params.json", "camera_poses.txt"])
def test_they_are_found_in_a_folder(tmp_path: Path, truth: tuple[np.ndarray, np.ndarray], name: str) -> None:
    (world_mirror if name.endswith("json") else trajectory)(tmp_path, *truth)
    assert read_cameras(tmp_path).path.endswith(name)


def test_twelve_numbers_a_line(tmp_path: Path, truth: tuple[np.ndarray, np.ndarray]) -> None:
    assert_equal(trajectory(tmp_path, *truth, columns=12), *truth)


def test_long_lrm_s_world_is_the_gaussians(tmp_path: Path, truth: tuple[np.ndarray, np.ndarray]) -> None:
    """A point of the cameras' world and its image in the Gaussians' are seen in the same direction."""
    viewmats, Ks = truth
    path = long_lrm(tmp_path, viewmats, Ks)
    move = np.eye(4)
    move[:3, :3], move[:3, 3] = scenes.random_rotation(3), (0.3, -1.0, 2.0)
    (tmp_path / "pos_avg_inv.txt").write_text("\n".join(" ".join(map(str, row)) for row in move))
    (tmp_path / "scene_scale.txt").write_text("1.35")
    (tmp_path / "input_frame_idx.txt").write_text("2 0")
    actual = read_cameras(path)
    point = np.array([0.2, -0.1, 3.0, 1.0])
    moved = np.append(1.35 * (move @ point)[:3], 1.0)
    for view, viewmat in zip((2, 0), actual.viewmats, strict=True):
        seen, truly = (viewmat @ moved)[:3], (viewmats[view] @ point)[:3]
        np.testing.assert_allclose(seen, 1.35 * truly, atol=1e-9)
    assert actual.names == ("2.png", "0.png")


def broken(kind: str, folder: Path, viewmats: np.ndarray, Ks: np.ndarray) -> Path:
    if kind == "another camera":
        path = world_mirror(folder, viewmats, Ks)
        with edited_json(path) as document:
            document["intrinsics"][0]["camera_id"] = "elsewhere"
    elif kind == "no matrix":
        path = world_mirror(folder, viewmats, Ks)
        path.write_text(json.dumps({"extrinsics": [{"camera_id": 1}], "intrinsics": []}))
    elif kind == "ragged":
        path = trajectory(folder, viewmats, Ks)
        path.write_text(path.read_text() + "1 2 3\n")
    elif kind == "no intrinsics":
        path = trajectory(folder, viewmats, Ks)
        (folder / "intrinsic.txt").unlink()
    elif kind == "no focal":
        path = long_lrm(folder, viewmats, Ks)
        path.write_text(path.read_text().replace('"fx"', '"f"'))
    else:
        path = long_lrm(folder, viewmats, Ks)
        (folder / "input_frame_idx.txt").write_text("0 7")
    return path


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("another camera", "the same cameras, found only one for elsewhere"),
        ("no matrix", "expected entries of 'camera_id' and 'matrix'"),
        ("ragged", "line 4: expected 12 or 16 numbers, found 3"),
        ("no intrinsics", "expected the intrinsics next to it in intrinsic.txt"),
        ("no focal", "expected w2c, fx, fy, cx, cy, w, h as numbers"),
        ("a frame too many", "expected frames 0 to 2, found 7"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, truth: tuple[np.ndarray, np.ndarray], kind: str, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        read_cameras(broken(kind, tmp_path, *truth))


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
