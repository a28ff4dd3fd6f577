"""Cameras are moved into the frame of Gaussians by the file that nerfstudio leaves beside a scene."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import smooth_scene
from messages import refuses
from sweeps import sweep
from tiny_scene import FLIP, Tiny, frames_of, rotation, write_colmap_text, write_transforms

from gsmerge.errors import SceneError
from gsmerge.io.cameras.dataparser import DATAPARSER
from gsmerge.jobs.content_hash import list_files
from gsmerge.reading.held_out import read_into_frame
from gsmerge.reading.loaded import Loaded
from gsmerge.reading.read_scene import load_scene

SMOOTH = smooth_scene(24, 18)
TURN, SHIFT, SCALE = rotation(0.4, -1.2, 0.7), np.array([1.5, -2.0, 0.5]), 0.3
NOTE = "the cameras are moved into the Gaussians' frame by dataparser_transforms.json"


def save_trained(folder: Path, *, move: bool = True) -> Tiny:
    """Save some Gaussians in random order, moved as nerfstudio does: X' = s (T [X; 1]); with photos beside them."""
    some = np.random.default_rng(0).permutation(1296)[:864]
    gaussians = SMOOTH.gaussians[some]
    if move:
        means = SCALE * (gaussians.means.astype(np.float64) @ TURN.T + SHIFT)
        gaussians = replace(gaussians, means=means.astype(np.float32), scales=SCALE * gaussians.scales)
    scene = replace(SMOOTH, gaussians=gaussians)
    scene.save(folder, cameras=False)
    write_dataparser(folder)
    return scene


def write_dataparser(folder: Path, **changes: object) -> None:
    matrix = np.concatenate([TURN, SHIFT[:, None]], 1).tolist()
    (folder / "dataparser_transforms.json").write_text(json.dumps({"transform": matrix, "scale": SCALE} | changes))


def words(numbers: np.ndarray) -> str:
    return " ".join(map(repr, numbers.reshape(-1).tolist()))


def assert_moved(loaded: Loaded) -> None:
    assert NOTE in loaded.notes
    centres = SCALE * (SMOOTH.c2w[:, :3, 3] @ TURN.T + SHIFT)
    assert np.allclose(loaded.scene.cameras.centres, centres)
    assert np.allclose(loaded.scene.cameras.viewmats[:, :3, :3], SMOOTH.w2c[:, :3, :3] @ TURN.T)
    assert np.array_equal(loaded.cameras.viewmats, loaded.scene.cameras.viewmats)


def test_cameras_of_the_capture_are_moved_into_the_frame_of_gaussians(tmp_path: Path) -> None:
    save_trained(tmp_path)
    write_colmap_text(tmp_path / "sparse", SMOOTH)
    assert_moved(load_scene(tmp_path))


@pytest.mark.parametrize("cycled", [False, True], ids=["as it is", "in nerfstudio's axes"])
def test_cameras_of_metashape_are_moved_by_the_transform_of_its_chunk(tmp_path: Path, cycled: bool) -> None:
    """The photos decide, as the chunk's own axes may be the Gaussians'."""
    save_trained(tmp_path)
    (tmp_path / DATAPARSER).unlink()
    world = np.eye(3)[[2, 0, 1]] if cycled else np.eye(3)
    motion = world.T @ TURN
    move = f"<rotation>{words(motion)}</rotation><translation>{words(SCALE * world.T @ SHIFT)}</translation>"
    text = f"<document><chunk><transform>{move}<scale>{SCALE}</scale></transform>"
    text += f'<sensor id="0"><resolution width="{SMOOTH.width}" height="{SMOOTH.height}"/>'
    text += f"<calibration><f>{SMOOTH.K[0, 0]}</f></calibration></sensor>"
    for name, pose in zip(SMOOTH.names, SMOOTH.c2w, strict=True):
        text += f'<camera sensor_id="0" label="{name}"><transform>{words(pose)}</transform></camera>'
    (tmp_path / "cameras.xml").write_text(f"{text}</chunk></document>")
    loaded = load_scene(tmp_path)
    axes = " and turned from axes x, y, z to z, x, y, as the photos' colours show" if cycled else ""
    assert f"the cameras are moved by the transform of the chunk in cameras.xml{axes}" in loaded.notes
    assert np.allclose(loaded.scene.cameras.centres, SCALE * (SMOOTH.c2w[:, :3, 3] @ TURN.T + SHIFT))


@pytest.mark.parametrize("place", ["data/desk", "outputs/desk/splatfacto/2026-01-02_030405"])
@pytest.mark.parametrize("named", ["data/desk", "data/desk/colmap/sparse/0"])
def test_the_dataparser_file_is_found_where_nerfstudio_leaves_it(tmp_path: Path, place: str, named: str) -> None:
    """It keeps exports, captures and outputs apart; of several outputs, the one that fits is taken."""
    save_trained(tmp_path / "exports" / "splat")
    (tmp_path / "data" / "desk").mkdir(parents=True)
    (tmp_path / "exports" / "splat" / "images").rename(tmp_path / "data" / "desk" / "images")
    write_transforms(tmp_path / "data" / "desk" / "transforms.json", SMOOTH)
    write_colmap_text(tmp_path / "data" / "desk" / "colmap" / "sparse" / "0", SMOOTH)
    folders = [tmp_path / place] if place.startswith("data") else [tmp_path / place, tmp_path / f"{place}9"]
    for folder, scale in zip(folders, (SCALE, 2.0), strict=False):
        folder.mkdir(parents=True, exist_ok=True)
        write_dataparser(folder, scale=scale)
    (tmp_path / "exports" / "splat" / DATAPARSER).unlink()
    loaded = load_scene(tmp_path / "exports" / "splat", cameras=tmp_path / named)
    assert_moved(loaded)
    assert set(folders) <= {path.parent for path in list_files(loaded.files)}


def test_cameras_of_a_path_are_moved_as_those_of_the_capture(tmp_path: Path) -> None:
    """Held-out views, or those of a path, are in the capture's world and share no view with the scene."""
    save_trained(tmp_path)
    write_colmap_text(tmp_path / "sparse", SMOOTH)
    write_transforms(tmp_path / "path.json", replace(SMOOTH, names=("x.png", "y.png", "z.png")))
    placed, shared = read_into_frame(load_scene(tmp_path), tmp_path / "path.json")
    assert shared == {}
    expected = SMOOTH.w2c
    expected[:, :3, :3] = expected[:, :3, :3] @ TURN.T
    centres = SCALE * (SMOOTH.c2w[:, :3, 3] @ TURN.T + SHIFT)
    expected[:, :3, 3] = -(expected[:, :3, :3] * centres[:, None]).sum(-1)
    np.testing.assert_allclose(placed.viewmats, expected, atol=1e-6)


def test_a_path_of_nerfstudios_viewer_is_in_the_world_of_the_gaussians(tmp_path: Path) -> None:
    save_trained(tmp_path)
    write_colmap_text(tmp_path / "sparse", SMOOTH)
    views = [{"camera_to_world": pose.ravel().tolist(), "fov": 50} for pose in SMOOTH.c2w @ FLIP]
    data = {"render_height": 20, "render_width": 30, "camera_path": views}
    (path := tmp_path / "path.json").write_text(json.dumps(data))
    placed, shared = read_into_frame(load_scene(tmp_path), path)
    assert shared == {}
    np.testing.assert_allclose(placed.viewmats, SMOOTH.w2c, atol=1e-6)


def test_poses_with_an_applied_transform_are_moved_by_the_rest(tmp_path: Path) -> None:
    """The poses are in the world after ``applied_transform``, but ``transform`` starts from the world before it."""
    save_trained(tmp_path)
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
    assert_moved(load_scene(tmp_path))


def test_a_dataparser_file_that_does_not_help_is_not_applied(tmp_path: Path) -> None:
    save_trained(tmp_path, move=False)
    write_colmap_text(tmp_path / "sparse", SMOOTH)
    loaded = load_scene(tmp_path)
    assert NOTE not in loaded.notes
    assert np.allclose(loaded.scene.cameras.viewmats, SMOOTH.w2c)


@pytest.mark.slow
def test_cameras_of_the_capture_are_refused_without_the_dataparser_file(tmp_path: Path) -> None:
    save_trained(tmp_path)
    write_colmap_text(tmp_path / "sparse", SMOOTH)
    (tmp_path / "dataparser_transforms.json").unlink()
    with refuses(SceneError, "scene.ply", 1296, 864, tmp_path):
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
def test_a_damaged_dataparser_file_is_refused(tmp_path: Path, text: str, found: object) -> None:
    save_trained(tmp_path)
    write_colmap_text(tmp_path / "sparse", SMOOTH)
    (tmp_path / "dataparser_transforms.json").write_text(text)
    with refuses(SceneError, "dataparser_transforms.json", found):
        load_scene(tmp_path, cameras=tmp_path / "sparse")
