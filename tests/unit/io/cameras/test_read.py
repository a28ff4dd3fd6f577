"""Camera files are told apart; those of single backbones are read."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scenes
from messages import refuses
from program_cameras import HEIGHT, VIEWS, WIDTH, long_lrm, world_mirror
from tiny_scene import Tiny, edited_json, save_json, write_colmap_text, write_inria, write_transforms

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras

C2W = np.linalg.inv(scenes.arc(VIEWS, WIDTH, HEIGHT).viewmats.astype(np.float64))
K = scenes.arc(1, WIDTH, HEIGHT).Ks[0].astype(np.float64)


def write_world_mirror(folder: Path) -> Path:
    return save_json(folder / "camera_params.json", world_mirror(C2W, K))


def write_long_lrm(folder: Path) -> Path:
    return save_json(folder / "scene.json", long_lrm(C2W, K))


def write_ffgs(folder: Path) -> Path:
    """As its example for photos without poses writes them."""
    views = [
        {"index": i, "file": f"{i}.png", "c2w": pose.tolist(), "k_normalized": (K / [[WIDTH], [HEIGHT], [1]]).tolist()}
        for i, pose in enumerate(C2W)
    ]
    return save_json(folder / "cameras.json", {"frame": "model", "image_shape": [HEIGHT, WIDTH], "views": views})


def write_trajectory(folder: Path, columns: int = 16) -> Path:
    path = folder / "camera_poses.txt"
    path.write_text("".join(" ".join(map(repr, m.reshape(-1)[:columns].tolist())) + "\n" for m in C2W))
    (folder / "intrinsic.txt").write_text(f"{K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}\n")
    return path


def write_trajectory_of_12(folder: Path) -> Path:
    return write_trajectory(folder, 12)


def write_trajectory_with_mark(folder: Path) -> Path:
    """A byte order mark first, as some editors of Windows write it."""
    path = write_trajectory(folder)
    path.write_text(path.read_text(), encoding="utf-8-sig")
    return path


WRITERS = (
    write_world_mirror,
    write_long_lrm,
    write_ffgs,
    write_trajectory,
    write_trajectory_of_12,
    write_trajectory_with_mark,
)


@pytest.mark.parametrize("write", WRITERS)
def test_poses_and_intrinsics_are_read(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    actual = read_cameras(write(tmp_path))
    np.testing.assert_allclose(actual.viewmats, np.linalg.inv(C2W), atol=1e-9)
    np.testing.assert_allclose(actual.Ks, np.stack([K] * VIEWS), atol=1e-9)


@pytest.mark.parametrize(
    ("cx", "cy", "size"), [(24, 18, (48, 36)), (24.3, 18, (0, 0)), (-24, 18, (0, 0)), (float("nan"), 18, None)]
)
def test_world_mirror_s_size_is_twice_the_principal_point(
    tmp_path: Path, cx: float, cy: float, size: tuple[int, int] | None
) -> None:
    centred = K.copy()
    centred[:2, 2] = cx, cy
    path = save_json(tmp_path / "camera_params.json", world_mirror(C2W, centred))
    if size is None:
        with pytest.raises(SceneError, match="finite"):
            read_cameras(path)
        return
    actual = read_cameras(path)
    assert set(zip(actual.widths.tolist(), actual.heights.tolist(), strict=True)) == {size}


def test_long_lrm_s_world_is_the_gaussians(tmp_path: Path) -> None:
    """A point of the cameras' world and its image in the Gaussians' are seen in the same direction."""
    path = write_long_lrm(tmp_path)
    move = np.eye(4)
    move[:3, :3], move[:3, 3] = scenes.random_rotation(3), (0.3, -1.0, 2.0)
    (tmp_path / "pos_avg_inv.txt").write_text("\n".join(" ".join(map(str, row)) for row in move))
    (tmp_path / "scene_scale.txt").write_text("1.35")
    (tmp_path / "input_frame_idx.txt").write_text("2 0")
    actual = read_cameras(path)
    point = np.array([0.2, -0.1, 3.0, 1.0])
    moved = np.append(1.35 * (move @ point)[:3], 1.0)
    for view, viewmat in zip((2, 0), actual.viewmats, strict=True):
        seen, truly = (viewmat @ moved)[:3], (np.linalg.inv(C2W)[view] @ point)[:3]
        np.testing.assert_allclose(seen, 1.35 * truly, atol=1e-9)
    assert actual.names == ("view_002", "view_000")


def other_intrinsics(path: Path) -> None:
    with edited_json(path) as document:
        document["intrinsics"][0]["camera_id"] = "elsewhere"


def deep_matrix(path: Path) -> None:
    with edited_json(path) as document:
        document["extrinsics"][0]["matrix"] = [[[1, 2]] * 4] * 4


def set_key(key: str, value: object) -> Callable[[Path], object]:
    return lambda path: save_json(path, json.loads(path.read_text()) | {key: value})


def beside(name: str, text: str) -> Callable[[Path], object]:
    return lambda path: path.with_name(name).write_text(text)


BESIDE_LONG_LRM = [
    ("input_frame_idx.txt", "0 7", "0 to 2", 7),
    ("input_frame_idx.txt", "nan", "NaN"),
    ("input_frame_idx.txt", "0 " * 10_001, 10000, "more"),
    ("pos_avg_inv.txt", "0 " * 16, "inverted"),
    ("pos_avg_inv.txt", "1 " * 15, 16, 15),
    ("scene_scale.txt", "0", "positive"),
    ("scene_scale.txt", "inf", "NaN"),
]


def replace_text(old: str, new: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(path.read_text().replace(old, new, 1))


@pytest.mark.parametrize(
    ("write", "spoil", "named"),
    [
        (write_world_mirror, other_intrinsics, ("camera_params.json", "one for elsewhere")),
        (write_world_mirror, replace_text("matrix", "m"), ("camera_params.json: extrinsics", "'matrix'")),
        (
            write_trajectory,
            lambda path: path.write_text(path.read_text() + "1 2 3\n"),
            ("camera_poses.txt: line 4", "12 or 16", 3),
        ),
        (write_long_lrm, replace_text('"fx"', '"f"'), ("scene.json: view view_000", "'fx'")),
        (write_world_mirror, set_key("extrinsics", None), ("camera_params.json", "'extrinsics'", "list")),
        (write_world_mirror, deep_matrix, ("camera_params.json: extrinsics of view_000", "4x4")),
        (write_ffgs, replace_text('"c2w"', '"w2c"'), ("cameras.json: view 0.png", "'c2w'")),
        (write_ffgs, set_key("image_shape", [36]), ("cameras.json", "'image_shape'")),
        *((write_long_lrm, beside(name, text), (name, *found)) for name, text, *found in BESIDE_LONG_LRM),
        (write_trajectory, beside("intrinsic.txt", ""), ("intrinsic.txt", "3 views", 0)),
        (write_trajectory, beside("intrinsic.txt", "a b c d"), ("intrinsic.txt: line 1", "'a'")),
    ],
)
def test_what_is_wrong_is_named(
    tmp_path: Path, write: Callable[[Path], Path], spoil: Callable[[Path], object], named: tuple[object, ...]
) -> None:
    path = write(tmp_path)
    spoil(path)
    with refuses(SceneError, *named):
        read_cameras(path)


def test_what_is_no_camera_file(tmp_path: Path) -> None:
    for name, text, found in (
        ("none.json", None, "no such file"),
        ("text.json", "hello", "JSON"),
        ("other.json", '{"a": 1}', "'frames'"),
        ("list.json", "[1, 2]", "'frames'"),
        ("cameras.yml", "<a/>", ".npz"),
    ):
        if text is not None:
            (tmp_path / name).write_text(text)
        with refuses(SceneError, name, found):
            read_cameras(tmp_path / name)
    with refuses(SceneError, tmp_path, "results.npz", "none"):
        read_cameras(tmp_path)


def test_the_first_place_wins(tmp_path: Path, tiny: Tiny) -> None:
    write_colmap_text(tmp_path / "sparse/0", tiny)
    write_inria(tmp_path / "cameras.json", tiny)
    assert read_cameras(tmp_path).source == "INRIA cameras.json"
    write_transforms(tmp_path / "transforms.json", tiny)
    assert read_cameras(tmp_path).source == "transforms.json"
    assert read_cameras(tmp_path / "sparse").source == "COLMAP text"
