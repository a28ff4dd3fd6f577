"""Held-out views are known from others, and come in the frame of the Gaussians."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from messages import refuses
from sweeps import sweep
from tiny_scene import FLIP, Tiny, edited_json, make_tiny, rotation

from gsmerge.errors import SceneError
from gsmerge.method.geometry.transforms import fit_similarity
from gsmerge.reading import larger_photos as scene_views
from gsmerge.reading.held_out import read_held_out
from gsmerge.reading.read_scene import Loaded, load_scene
from gsmerge.types import Scene


@pytest.fixture(scope="module")
def tiny() -> Tiny:
    return make_tiny(32, 24)


@pytest.fixture(scope="module")
def load(tmp_path_factory: pytest.TempPathFactory) -> Loaded:
    """Return the tiny scene, read. Read only."""
    return load_scene(make_tiny(32, 24).save(tmp_path_factory.mktemp("held-out") / "scene"))


def write_views(folder: Path, poses: dict[str, np.ndarray], tiny: Tiny, size: tuple[int, int] = (32, 24)) -> Path:
    """Write ``transforms.json`` and a photo for each pose (camera to world, OpenCV)."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    scale = size[0] / tiny.width
    frames = []
    for i, (name, pose) in enumerate(poses.items()):
        cv2.imwrite(str(folder / "images" / f"{name}.png"), np.full((size[1], size[0], 3), 10 * i, np.uint8))
        frames.append({"file_path": f"images/{name}.png", "transform_matrix": (pose @ FLIP).tolist()})
    intrinsics = {"fl_x": tiny.K[0, 0], "fl_y": tiny.K[1, 1], "cx": tiny.K[0, 2], "cy": tiny.K[1, 2]}
    document = {name: value * scale for name, value in intrinsics.items()}
    document |= {"w": size[0], "h": size[1], "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder / "transforms.json"


def between(tiny: Tiny) -> np.ndarray:
    """Return a pose that is none of the scene's."""
    pose = tiny.c2w[0].copy()
    pose[:3, 3] = tiny.c2w[:2, :3, 3].mean(0)
    return pose


def stems(tiny: Tiny) -> list[str]:
    return [Path(name).stem for name in tiny.names]


def test_targets_are_the_other_views_of_the_file_in_its_order(tiny: Tiny, load: Loaded, tmp_path: Path) -> None:
    a, b, c = stems(tiny)
    poses = {a: tiny.c2w[0], "held": between(tiny), b: tiny.c2w[1], c: tiny.c2w[2]}
    targets = read_held_out(load, write_views(tmp_path / "all", poses, tiny))
    assert targets.names == ("images/held.png",)
    assert (targets.places, targets.context_places) == ((1,), (0, 2, 3))
    assert np.allclose(np.linalg.inv(targets.cameras.viewmats[0]), between(tiny), atol=1e-9)
    assert np.allclose(targets.images[0], 10 / 255)


def test_a_world_of_its_own_is_brought_to_the_scene_s(tiny: Tiny, load: Loaded, tmp_path: Path) -> None:
    turn, factor, shift = rotation(0.4, -1.0, 0.3), 7.5, np.array([10.0, -4.0, 2.0])

    def elsewhere(pose: np.ndarray) -> np.ndarray:
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = turn @ pose[:3, :3], factor * turn @ pose[:3, 3] + shift
        return out

    poses = {stem: elsewhere(pose) for stem, pose in zip(stems(tiny), tiny.c2w, strict=True)}
    poses["held"] = elsewhere(between(tiny))
    targets = read_held_out(load, write_views(tmp_path / "all", poses, tiny))
    assert targets.names == ("images/held.png",)
    assert np.allclose(np.linalg.inv(targets.cameras.viewmats[0]), between(tiny), atol=1e-6)


def test_equal_names_of_other_views_mean_nothing(tiny: Tiny, load: Loaded, tmp_path: Path) -> None:
    targets = read_held_out(load, write_views(tmp_path / "held", {stems(tiny)[0]: between(tiny)}, tiny))
    assert len(targets) == 1
    assert targets.context_places is None
    assert np.allclose(np.linalg.inv(targets.cameras.viewmats[0]), between(tiny), atol=1e-9)


@sweep("all_views", [False, True])
def test_poses_in_the_convention_that_the_scene_s_own_are_in(all_views: bool, tiny: Tiny, tmp_path: Path) -> None:
    folder = tiny.save(tmp_path / "scene")
    flip_poses(folder / "transforms.json")
    load = load_scene(folder, order="view-major")
    assert any("OpenCV axes" in note for note in load.notes)
    views = dict(zip(stems(tiny), tiny.c2w, strict=True)) if all_views else {}
    path = write_views(tmp_path / "all", views | {"held": between(tiny)}, tiny)
    if all_views:  # by the book, and the shared views say so
        assert_between(read_held_out(load, path).cameras.viewmats[0], tiny)
    flip_poses(path)
    assert_between(read_held_out(load, path).cameras.viewmats[0], tiny)


def flip_poses(path: Path) -> None:
    """Write poses with OpenCV axes in place of the format's."""
    with edited_json(path) as document:
        for frame in document["frames"]:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ FLIP).tolist()


def assert_between(viewmat: np.ndarray, tiny: Tiny) -> None:
    assert np.allclose(np.linalg.inv(viewmat), between(tiny), atol=1e-6)


def test_views_of_other_names_that_stand_in_the_same_place_are_no_targets(
    tiny: Tiny, load: Loaded, tmp_path: Path
) -> None:
    poses = {"p": tiny.c2w[0], "q": between(tiny), "r": tiny.c2w[1]}
    assert read_held_out(load, write_views(tmp_path / "all", poses, tiny)).names == ("images/q.png",)
    with refuses(SceneError, "transforms.json", "held-out views", "only views"):
        read_held_out(load, write_views(tmp_path / "none", {"p": tiny.c2w[0]}, tiny))


def test_photos_of_another_size_bring_their_intrinsics(tiny: Tiny, load: Loaded, tmp_path: Path) -> None:
    targets = read_held_out(load, write_views(tmp_path / "held", {"q": between(tiny)}, tiny, (64, 48)))
    assert tuple(targets.images.shape) == (1, 48, 64, 3)
    assert np.allclose(targets.cameras.Ks[0][:2], 2 * tiny.K[:2])


def test_photos_of_another_shape_than_their_cameras_are_doubted(tiny: Tiny, load: Loaded, tmp_path: Path) -> None:
    cameras = write_views(tmp_path / "held", {"q": between(tiny)}, tiny, (64, 48))
    assert not read_held_out(load, cameras).notes
    with edited_json(cameras) as document:
        document["w"] = 80
    (note,) = read_held_out(load, cameras).notes
    assert "80 x 48 are stretched to the held-out photos, 64 x 48" in note


def test_photos_of_targets_elsewhere_have_to_be_named(tiny: Tiny, load: Loaded, tmp_path: Path) -> None:
    cameras = write_views(tmp_path / "held", {"q": between(tiny)}, tiny)
    shutil.move(str(tmp_path / "held" / "images"), str(tmp_path / "photos"))
    with pytest.raises(SceneError, match="--target-images"):
        read_held_out(load, cameras)
    assert len(read_held_out(load, cameras, tmp_path / "photos")) == 1
    with pytest.raises(SceneError, match="folder"):
        read_held_out(load, cameras, tmp_path / "nowhere")


def test_the_photo_that_is_missing_is_named(tiny: Tiny, load: Loaded, tmp_path: Path) -> None:
    path = write_views(tmp_path / "held", {"q": between(tiny), "r": between(tiny)}, tiny)
    (path.parent / "images" / "r.png").unlink()
    with refuses(SceneError, "transforms.json", "images/r.png", "--target-images"):
        read_held_out(load, path)


def test_targets_of_a_scene_without_views_share_no_place_with_it(tiny: Tiny, load: Loaded, tmp_path: Path) -> None:
    bare = replace(load, scene=Scene(load.scene.gaussians, load.scene.cameras[[]], None, None, ()))
    targets = read_held_out(bare, write_views(tmp_path / "held", {"q": between(tiny)}, tiny))
    assert (len(targets), targets.context_places) == (1, None)


def test_similarity_of_cameras_in_one_place_keeps_the_scale(tiny: Tiny) -> None:
    theirs = np.tile(np.eye(4), (2, 1, 1))
    ours = theirs.copy()
    ours[:, 0, 3] = -5.0
    frame = fit_similarity(theirs, ours, 3.0)
    assert frame.scale == 3.0
    assert np.allclose(frame.move_viewmats(theirs), ours)


@pytest.mark.parametrize("factor", [1e-4, 1.0, 1e4])
def test_view_beside_a_single_input_view_is_a_target_in_any_unit(factor: float, tiny: Tiny, tmp_path: Path) -> None:
    c2w = tiny.c2w.copy()
    c2w[:, :3, 3] *= factor
    gaussians = replace(tiny.gaussians, means=tiny.gaussians.means * factor, scales=tiny.gaussians.scales * factor)
    size = tiny.width * tiny.height
    one = replace(tiny, c2w=c2w[:1], images=tiny.images[:1], gaussians=gaussians[:size], names=tiny.names[:1])
    load = load_scene(one.save(tmp_path / "scene"))
    beside = c2w[0].copy()
    beside[0, 3] += 0.05 * factor
    targets = read_held_out(load, write_views(tmp_path / "held", {"p": c2w[0], "q": beside}, tiny))
    assert targets.names == ("images/q.png",)


def test_photos_beyond_all_memory_are_made_smaller(
    tiny: Tiny, load: Loaded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras = write_views(tmp_path / "held", {"q": between(tiny)}, tiny, (1600, 1200))
    assert read_held_out(load, cameras).images.shape[2] == 1600
    monkeypatch.setattr(scene_views, "_MAX_BYTES", 1 << 20)
    targets = read_held_out(load, cameras)
    assert targets.images.shape[2] == targets.cameras.width == 1200
    assert np.allclose(targets.cameras.Ks[0][:2], 1200 / tiny.width * tiny.K[:2])
    assert "1600 x 1200" in targets.notes[0]
