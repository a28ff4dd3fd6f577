"""Folders and files without Gaussians are refused in one line that says what to do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from messages import names, refuses
from model_files import write_points_glb
from plyfile import PlyData, PlyElement
from tiny_scene import Tiny, write_colmap_binary, write_images, write_npz

from gsmerge.cli import main
from gsmerge.errors import SceneError
from gsmerge.io import write_gaussians
from gsmerge.io.no_gaussians import POINTS_ONLY
from gsmerge.jobs.batch.find import find_scenes
from gsmerge.reading.scene_files import find_scene_files


def write_points(path: Path) -> None:
    """Write a coloured point cloud, as VGGT and MapAnything do into ``sparse/``."""
    columns = [*((name, "f4") for name in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))]
    PlyData([PlyElement.describe(np.zeros(5, columns), "vertex")]).write(str(path))


def leave(folder: Path, tiny: Tiny, name: str) -> None:
    """Leave a file of the kind that its name says."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npz":
        write_npz(path, tiny, depth=None)
    elif path.suffix == ".glb":
        write_points_glb(path)
    elif path.suffix == ".ply":
        write_points(path)
    elif path.suffix == ".bin":
        write_colmap_binary(path.parent, tiny)
    else:
        path.touch()


@pytest.mark.parametrize(
    ("left", "found", "said"),
    [
        (("exports/npz/results.npz", "scene.glb"), "exports/npz/results.npz", ("npz-gs_ply", "infer_gs=True")),
        (("exports/mini_npz/results.npz",), "exports/mini_npz/results.npz", ("npz-gs_ply", "giant")),
        (("scene.glb", "scene.jpg"), "scene.glb", ("Depth Anything 3", "npz-gs_ply")),
        (("results.npz",), "results.npz", ("Depth Anything 3", "npz-gs_ply")),
        (("sparse/cameras.bin", "sparse/points.ply"), "sparse/points.ply", ("MapAnything", "--cameras")),
        (("predictions.npz", "glbscene_50.glb"), "glbscene_50.glb", ("VGGT", "--cameras")),
        (("sparse/0/cameras.bin",), "sparse/0/cameras.bin", ("COLMAP", "--cameras")),
        (("cameras.bin",), "cameras.bin", ("COLMAP", "--cameras")),
        (("cfg.yml", "ckpts/ckpt_29999_rank0.pt"), "ckpts/ckpt_29999_rank0.pt", ("gsplat", "save_ply")),
        (("config.yml", "nerfstudio_models/step-000029999.ckpt"), "nerfstudio_models", ("ns-export",)),
        (("pred.npz",), "pred.npz", ("FLARE",)),
        (("camera_poses.txt", "pcd/0_pcd.ply"), "camera_poses.txt", ("DA3-Streaming", "--cameras")),
        (("output.glb",), "output.glb", ("points", "--cameras")),
        (("scene.gltf", "scene.dat"), "scene.gltf", ("several files", ".glb")),
        (("mesh.ply",), "mesh.ply", ("points", "name")),
        (("notes.txt",), "photos", ("Depth Anything 3", "AnySplat")),
    ],
)
def test_a_folder_without_gaussians_is_refused_with_a_remedy(
    tmp_path: Path, tiny: Tiny, left: tuple[str, ...], found: str, said: tuple[str, ...]
) -> None:
    """As ``compact`` and ``inspect`` say it; ``batch`` has the same remedy for a folder of such folders."""
    folder = tmp_path / "scenes/room"
    write_images(folder / "images", tiny)
    for name in left:
        leave(folder, tiny, name)
    with refuses(SceneError, folder, ".ply", "none", *said) as raised:
        find_scene_files(folder)
    assert found in str(raised.value)
    for command in ("compact", "inspect"):
        assert main([command, str(folder)]) == 3
    with refuses(SceneError, tmp_path / "scenes", "none", *said):
        list(find_scenes([str(tmp_path / "scenes")], tmp_path / "out"))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("results.npz", ("Depth Anything 3", "npz-gs_ply")),
        ("predictions.npz", ("VGGT", "--cameras")),
        ("any.npz", ("points", "--cameras")),
        ("scene.glb", ("Depth Anything 3", "infer_gs=True")),
        ("OUTPUT.GLB", ("points", "--cameras")),
    ],
)
def test_a_file_without_gaussians_is_refused_with_a_remedy(
    tmp_path: Path, tiny: Tiny, name: str, said: tuple[str, ...]
) -> None:
    leave(tmp_path, tiny, name)
    if name.endswith("GLB"):
        write_points_glb(tmp_path / name)
    with refuses(SceneError, name, "Gaussians", *said):
        find_scene_files(tmp_path / name)


@pytest.mark.parametrize("ending", [".spz", ".sog", ".splat", ".glb"])
def test_the_only_file_of_another_format_is_the_scene(tmp_path: Path, tiny: Tiny, ending: str) -> None:
    path = tmp_path / f"room{ending}"
    write_gaussians(path, tiny.gaussians)
    assert find_scene_files(tmp_path).ply == find_scene_files(path).ply == path
    assert list(find_scenes([str(tmp_path)], tmp_path / "out")) == [path]
    write_gaussians(tmp_path / f"other{ending}", tiny.gaussians)
    with refuses(SceneError, tmp_path, f"other{ending}", "name"):
        find_scene_files(tmp_path)
    write_gaussians(tmp_path / "room.ply", tiny.gaussians)
    assert find_scene_files(tmp_path).ply == tmp_path / "room.ply"


def test_every_pattern_of_files_without_gaussians_is_in_one_row() -> None:
    patterns = [pattern for row in POINTS_ONLY for pattern in row.files]
    assert len(set(patterns)) == len(patterns)
    assert all(row.title and row.remedy and not names(row.remedy, "None") for row in POINTS_ONLY)
