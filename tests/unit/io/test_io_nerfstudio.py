"""Scenes that nerfstudio trained: the cameras' file is in another frame than the Gaussians."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import smooth_scene
from tiny_scene import FLIP, Tiny, frames_of, rotation, write_colmap_text

from gsmerge.errors import SceneError
from gsmerge.io import load_scene

SMOOTH = smooth_scene(40, 30)
TURN, SHIFT, SCALE = rotation(0.4, -1.2, 0.7), np.array([1.5, -2.0, 0.5]), 0.3
NOTE = "the cameras are moved into the Gaussians' frame by dataparser_transforms.json"


def trained(folder: Path, *, move: bool = True) -> Tiny:
    """Some of the Gaussians in no order, where nerfstudio puts them: X' = s (T [X; 1]); photos beside them."""
    some = np.random.default_rng(0).permutation(3600)[:2400]
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
    assert not loaded.scene.aligned
    assert NOTE in loaded.notes
    centres = SCALE * (SMOOTH.c2w[:, :3, 3] @ TURN.T + SHIFT)
    assert np.allclose(loaded.scene.cameras.centres, centres)
    assert np.allclose(loaded.scene.cameras.viewmats[:, :3, :3], SMOOTH.w2c[:, :3, :3] @ TURN.T)
    assert np.array_equal(loaded.cameras.viewmats, loaded.scene.cameras.viewmats)


def test_cameras_of_the_capture_are_moved(tmp_path: Path) -> None:
    trained(tmp_path)
    write_colmap_text(tmp_path / "sparse", SMOOTH)
    assert_moved(tmp_path)


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
    with pytest.raises(SceneError, match="the cameras see"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("no", "dataparser_transforms.json: expected JSON"),
        ("{}", "expected 'transform' of 3x4 numbers and 'scale'"),
        (json.dumps({"transform": [[1, 2], [3, 4]], "scale": 1}), r"found shape \[2, 2\]"),
        (json.dumps({"transform": np.eye(4).tolist(), "scale": -1}), "found another map"),
        (json.dumps({"transform": (2 * np.eye(4)).tolist(), "scale": 1}), "found another map"),
    ],
)
def test_a_damaged_file(tmp_path: Path, text: str, message: str) -> None:
    trained(tmp_path)
    write_colmap_text(tmp_path / "sparse", SMOOTH)
    (tmp_path / "dataparser_transforms.json").write_text(text)
    with pytest.raises(SceneError, match=message):
        load_scene(tmp_path)
