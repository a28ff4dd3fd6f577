"""A folder as DA3-Streaming leaves it, depth maps in the place of Gaussians, is a scene for every command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gsmerge
from gsmerge.geometry import camera_depths


@pytest.fixture(scope="module")
def frames(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The depths, photos and poses of the small scene as frames. Read only."""
    scene = gsmerge.read_scene(small_scene)
    assert scene.images is not None
    views, folder = len(scene), tmp_path_factory.mktemp("depths") / "walk"
    (folder / "results_output").mkdir(parents=True)
    means = scene.gaussians.means.reshape(views, -1, 3)
    size = scene.cameras.height, scene.cameras.width
    for view, points in enumerate(means):
        viewmats = np.broadcast_to(scene.cameras.viewmats[view], (len(points), 4, 4))
        depth = camera_depths(points.astype(np.float64), viewmats).reshape(size).astype(np.float32)
        image, K = np.rint(255 * scene.images[view]).astype(np.uint8), scene.cameras.Ks[view]
        np.savez_compressed(folder / f"results_output/frame_{view}.npz", image=image, depth=depth, intrinsics=K)
    poses = np.linalg.inv(scene.cameras.viewmats).reshape(views, 16)
    np.savetxt(folder / "camera_poses.txt", poses)
    np.savetxt(folder / "intrinsic.txt", scene.cameras.Ks[:, [0, 1, 0, 1], [0, 1, 2, 2]])
    return folder


def test_commands_take_depth_maps(frames: Path, small_scene: Path, tmp_path: Path, run: Any) -> None:
    """The result is as good from held-out views as that of an export with the same depths; two are made and scored."""
    scores = []
    for name, scene in (("depths.ply", frames), ("export.ply", small_scene)):
        run("compact", scene, "-o", tmp_path / name, "--budget", "768", "--effort", "draft", "-q", code=0)
        held_out = small_scene / "targets/transforms.json"
        done = run(
            "evaluate", scene, tmp_path / name, "--targets", held_out, "--json", "--quiet", "--lpips", "none", code=0
        )
        scores.append(json.loads(done.out)["results"][-1]["mean"]["target"]["psnr"])
    print(scores)
    assert scores[0] > max(29.0, scores[1] - 1), scores
    for more in ((), (small_scene,)):
        assert "depth maps" in run("inspect", frames, *more, code=0).out


def test_a_batch_finds_depth_maps(frames: Path, tmp_path: Path, run: Any) -> None:
    out = run("batch", frames.parent, "-o", tmp_path, "--dry-run", "--json", code=0).out
    document = json.loads(out)
    assert [scene["scene"] for scene in document["scenes"]] == [str(frames)]
    assert document["scenes"][0]["num_gaussians"] > 0


def test_converting_depth_maps_without_images_says_that_they_are_grey(tmp_path: Path, run: Any) -> None:
    poses, K = np.tile(np.eye(4)[:3], (2, 1, 1)), np.array([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]])
    arrays = {"depth": np.ones((2, 12, 16), np.float32), "extrinsics": poses, "intrinsics": np.tile(K, (2, 1, 1))}
    np.savez(tmp_path / "results.npz", **arrays)
    message = run("convert", tmp_path / "results.npz", tmp_path / "a.ply", code=0).err
    assert "results.npz: depth maps without images: all Gaussians are grey" in message
    np.savez(tmp_path / "results.npz", image=np.full((2, 12, 16, 3), 9, np.uint8), **arrays)
    assert "grey" not in run("convert", tmp_path / "results.npz", tmp_path / "b.ply", code=0).err
