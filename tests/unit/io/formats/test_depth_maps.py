"""Depth maps of models without Gaussians are read as one Gaussian for each pixel."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
from messages import refuses
from tiny_scene import Tiny, make_tiny, write_images, write_npz, write_transforms

from gsmerge.errors import SceneError, UsageError
from gsmerge.io import read_gaussians
from gsmerge.io.formats.depth_maps import OPACITY, SIGMA, find_depth_maps, holds_depth_maps, read_images
from gsmerge.io.formats.read import GaussianFile, read_parts
from gsmerge.io.formats.table import estimate_counts, may_hold_gaussians, output_format
from gsmerge.scene.files import find_scene_files
from gsmerge.scene.read import load_scene
from gsmerge.types import SH_C0


def depths_of(tiny: Tiny) -> np.ndarray:
    return np.random.default_rng(1).uniform(1, 3, (3, tiny.height, tiny.width)).astype(np.float32)


def write_frames(folder: Path, tiny: Tiny, **changes: Any) -> list[Path]:
    """Write what DA3-Streaming leaves, its array names and poses as text."""
    place = folder / "results_output"
    place.mkdir(parents=True)
    for view, depth in enumerate(depths_of(tiny)):
        arrays = {"image": tiny.images[view], "depth": depth, "conf": depth, "intrinsics": tiny.K.astype(np.float32)}
        np.savez_compressed(place / f"frame_{view}.npz", **(arrays | changes))
    poses = [" ".join(str(number) for number in pose.reshape(-1)) for pose in tiny.c2w]
    (folder / "camera_poses.txt").write_text("\n".join(poses) + "\n")
    K = tiny.K
    (folder / "intrinsic.txt").write_text(f"{K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}\n" * 3)
    return [place / f"frame_{view}.npz" for view in range(3)]


def check_rows(file: GaussianFile, tiny: Tiny, depths: np.ndarray, *, grey: bool = False) -> None:
    """Check each row against its pixel, one after the other."""
    row = 0
    for view in range(3):
        for y in range(tiny.height):
            for x in range(tiny.width):
                z = float(depths[view, y, x])
                local = z * np.linalg.solve(tiny.K, [x + 0.5, y + 0.5, 1])
                world = tiny.c2w[view, :3, :3] @ local + tiny.c2w[view, :3, 3]
                assert np.allclose(file.gaussians.means[row], world, atol=1e-5)
                assert np.allclose(file.gaussians.scales[row], SIGMA * z / tiny.K[0, 0], rtol=1e-5)
                color = np.full(3, 128) if grey else tiny.images[view, y, x]
                assert np.allclose(0.5 + SH_C0 * file.gaussians.sh0[row, 0], color / 255, atol=1e-5)
                row += 1
    assert row == len(file.gaussians)
    assert file.valid.all()
    assert np.allclose(file.gaussians.opacities, OPACITY)


@pytest.mark.parametrize("kind", ["DA3", "DA3 without images", "VGGT", "dump", "dump, divided by the size"])
def test_all_views_in_one_file(tmp_path: Path, tiny: Tiny, kind: str) -> None:
    path, depths = tmp_path / "results.npz", depths_of(tiny)
    if kind == "VGGT":
        images = (tiny.images.transpose(0, 3, 1, 2) / 255).astype(np.float32)
        arrays = {"images": images, "extrinsic": tiny.w2c[:, :3], "intrinsic": np.tile(tiny.K, (3, 1, 1))}
        np.savez(path, depth=depths[..., None], **arrays)
    elif kind.startswith("dump"):
        K = tiny.K / ([[tiny.width], [tiny.height], [1]] if "divided" in kind else 1)
        np.savez(path, c2w=tiny.c2w, K=np.tile(K, (3, 1, 1)), images=tiny.images, depth=depths)
    else:
        write_npz(path, tiny, depth=depths, image=None if "without" in kind else tiny.images)
    assert holds_depth_maps(path)
    assert may_hold_gaussians(path)
    check_rows(read_gaussians(path), tiny, depths, grey="without" in kind)


def test_frames_and_poses_of_a_long_sequence(tmp_path: Path, tiny: Tiny) -> None:
    frames = write_frames(tmp_path / "out", tiny)
    assert find_depth_maps(tmp_path / "out") == find_depth_maps(tmp_path / "out/results_output") == frames
    check_rows(read_parts(frames), tiny, depths_of(tiny))
    assert np.array_equal(np.stack(list(read_images(frames))), tiny.images)
    files = find_scene_files(tmp_path / "out")
    assert files.plys == tuple(frames)
    assert files.base == tmp_path / "out/scene.ply"
    load = load_scene(tmp_path / "out")
    assert load.scene.has_own_pixels
    assert load.scene.images is not None
    assert np.array_equal(np.rint(load.scene.images * 255), tiny.images)
    assert np.allclose(load.scene.cameras.viewmats, tiny.w2c)
    count, num_rest = estimate_counts(frames)
    assert count > 0
    assert num_rest == 0


def test_photos_color_depth_maps_without_images(tmp_path: Path) -> None:
    tiny = make_tiny(40, 28)
    write_npz(tmp_path / "exports/mini_npz/results.npz", tiny, depth=depths_of(tiny), image=None)
    with refuses(SceneError, "results.npz", "images", "none", "--images"):
        load_scene(tmp_path)
    write_images(tmp_path / "images", tiny)
    load = load_scene(tmp_path)
    assert np.allclose(0.5 + SH_C0 * load.scene.gaussians.sh0[:, 0], tiny.images.reshape(-1, 3) / 255, atol=1e-5)


@pytest.mark.parametrize("frames", [False, True])
def test_cameras_of_the_depth_maps_go_before_others(tmp_path: Path, tiny: Tiny, frames: bool) -> None:
    """Others beside them may be in another world, as COLMAP's are."""
    if frames:
        write_frames(tmp_path, tiny)
    else:
        write_npz(tmp_path / "predictions.npz", tiny, depth=depths_of(tiny))
    write_transforms(tmp_path / "transforms.json", replace(tiny, c2w=tiny.c2w @ np.diag([2.0, 2.0, 2.0, 1.0])))
    files = find_scene_files(tmp_path)
    assert files.cameras == tmp_path / ("camera_poses.txt" if frames else "predictions.npz")
    assert load_scene(tmp_path).scene.images is not None


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_pixel_without_depth_has_no_gaussian(tmp_path: Path, tiny: Tiny, value: float) -> None:
    depths = depths_of(tiny)
    depths[1, 2, 3] = value
    write_npz(tmp_path / "results.npz", tiny, depth=depths)
    file = read_gaussians(tmp_path / "results.npz")
    row = (1 * tiny.height + 2) * tiny.width + 3
    assert np.flatnonzero(~file.valid).tolist() == [row]
    assert file.info.num_nonfinite == 1


@pytest.mark.slow
def test_small_files_of_many_pixels(tmp_path: Path, tiny: Tiny) -> None:
    """Depths of 16 bits with images take 3.8 bytes a pixel; frames that pack to nothing may not take more together."""
    path, (views, height, width) = tmp_path / "results.npz", (4, 700, 800)
    image = np.random.default_rng(0).integers(0, 256, (views, height, width, 3), np.uint8)
    depth = np.tile(np.linspace(1, 2, width, dtype=np.float16), (views, height, 1))
    poses, K = np.tile(np.eye(4), (views, 1, 1)), np.array([[800, 0, 400], [0, 800, 350], [0, 0, 1]], np.float64)
    np.savez_compressed(path, extrinsics=poses, intrinsics=np.tile(K, (views, 1, 1)), depth=depth, image=image)
    assert len(read_gaussians(path).gaussians) == views * height * width
    large = {"depth": np.ones((height, width), np.float32), "image": np.zeros((height, width, 3), np.uint8)}
    frames = write_frames(tmp_path / "out", tiny, **large)
    assert len(read_gaussians(frames[0]).gaussians) == height * width
    with refuses(SceneError, "results_output", "memory"):
        read_parts(frames)


def test_frames_that_are_not_all_there(tmp_path: Path, tiny: Tiny) -> None:
    frames = write_frames(tmp_path, tiny)
    poses = tmp_path / "camera_poses.txt"
    lines = poses.read_text().splitlines()
    poses.write_text("\n".join(lines[:2]))
    with refuses(SceneError, poses.name, "3 poses"):
        read_parts(frames)
    poses.write_text("\n".join((*lines[:2], "1 2 3")))
    with refuses(SceneError, poses.name, "line 3", "12 or 16"):
        read_gaussians(frames[2])
    with refuses(SceneError, "frame_2.npz", "a single frame", "results_output"):
        find_scene_files(frames[2])
    frames[1].unlink()
    with refuses(SceneError, "results_output", "number 1"):
        find_scene_files(tmp_path)


@pytest.mark.parametrize("name", ["results.npz", "a.compressed.ply", "meta.json"])
def test_what_is_only_read_is_not_written(name: str) -> None:
    with refuses(UsageError, name, "can be read but not written", "a name that ends in"):
        output_format(name)


BOTH = "the inverse matrices and OpenGL's axes"


@pytest.mark.parametrize("kind", ["", "the inverse matrices", "OpenGL's axes", BOTH])
def test_poses_of_another_convention_are_refused(tmp_path: Path, kind: str) -> None:
    """Of a wall of two planes at a right angle, seen from an arc."""
    w2c = scenes.arc(6, 48, 32).viewmats.astype(np.float64)
    c2w, K = np.linalg.inv(w2c), np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]])
    y, x = np.mgrid[:32, :48] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(K).T
    world = np.einsum("vij,hwj->vhwi", c2w[:, :3, :3], rays)
    normals = c2w[:, :3, 2].mean(0) + np.array([[0.4, 0.2, 0], [-0.4, 0.3, 0.1]])
    middle = c2w[:, :3, 3].mean(0) + 3 * c2w[:, :3, 2].mean(0)
    depths = [((middle - c2w[:, :3, 3]) @ n)[:, None, None] / (world @ n) for n in normals]
    axes = np.diag([1.0, -1, -1, 1])
    stored = {"": c2w, BOTH: axes @ w2c, "the inverse matrices": w2c, "OpenGL's axes": c2w @ axes}[kind]
    images = np.zeros((6, 32, 48, 3), np.uint8)
    np.savez(tmp_path / "views.npz", depth=np.max(depths, 0), c2w=stored, K=np.tile(K, (6, 1, 1)), images=images)
    with refuses(SceneError, "views.npz", f"with {kind}") if kind else nullcontext():
        assert len(read_gaussians(tmp_path / "views.npz").gaussians)
