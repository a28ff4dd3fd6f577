"""Files are read as exporters write them, without a word, and every row comes to its own pixel."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exports import export_rows, home, save_export, smooth_scene, turned, with_surface_rotations
from messages import noted
from scripts import load_script
from sweeps import sweep
from tiny_scene import Tiny, edited_json, rotation

from gsmerge.reading.read_scene import load_scene, read_scene


@pytest.fixture(scope="module")
def smooth() -> Tiny:
    """Return three views of 48 x 36 of a smooth surface."""
    return smooth_scene(48, 36)


@pytest.mark.parametrize(("order", "axes"), [("view-fastest", (1, 2, 0)), ("view-major", (0, 1, 2))])
def test_order_of_rows_is_recognised(tmp_path: Path, smooth: Tiny, order: str, axes: tuple[int, int, int]) -> None:
    index = np.arange(3 * smooth.height * smooth.width).reshape(3, smooth.height, smooth.width)
    index = index[:, 1:-1, 1:-1]
    path = save_export(tmp_path, smooth, export_rows(smooth, index.transpose(axes).reshape(-1)))
    loaded = load_scene(path)
    assert loaded.recovery.layout.order == order
    assert home(loaded.scene, smooth) == 1
    assert home(load_scene(path, order=order).scene, smooth) == 1


def test_rows_column_by_column_have_cameras_and_no_pixels(tmp_path: Path, smooth: Tiny) -> None:
    index = np.arange(3 * smooth.height * smooth.width).reshape(3, smooth.height, smooth.width)
    scene = load_scene(save_export(tmp_path, smooth, export_rows(smooth, index.transpose(0, 2, 1).reshape(-1)))).scene
    assert not scene.has_own_pixels
    assert np.allclose(scene.cameras.viewmats, smooth.w2c)
    assert len(scene.photo_views) == 3


@sweep("views", [(0, 2), (0, 1), (1, 2), (2,)])
def test_rows_of_some_views_keep_the_photos_of_all(tmp_path: Path, smooth: Tiny, views: tuple[int, ...]) -> None:
    """Cameras and photos of the others stay."""
    size = smooth.height * smooth.width
    index = np.concatenate([np.arange(size) + view * size for view in views])
    scene = load_scene(save_export(tmp_path, smooth, export_rows(smooth, index))).scene
    assert np.array_equal(np.flatnonzero(scene.pixels.shown), index)
    assert len(scene.photo_views) == 3


@pytest.mark.parametrize("layers", [1, 3])
def test_world_moved_by_any_similarity_is_followed(tmp_path: Path, smooth: Tiny, layers: int) -> None:
    """As the family of pixelSplat moves it; with raw opacities, and one or several Gaussians of a pixel."""
    turn = rotation(1.0, -1.2, 0.6)
    index = np.arange(len(smooth.gaussians)).repeat(layers)
    rows = turned(export_rows(smooth, index), turn, scale=1 / 3, shift=np.array([0.3, 0.1, -0.2]))
    rows["opacity"] = smooth.gaussians.opacities[index]
    loaded = load_scene(save_export(tmp_path, smooth, rows))
    assert home(loaded.scene, smooth) == 1
    assert loaded.recovery.frame.scale == pytest.approx(1 / 3, rel=5e-3)
    assert np.allclose(loaded.scene.cameras.viewmats[:, :3, :3], smooth.w2c[:, :3, :3] @ turn.T, atol=5e-3)
    assert noted(loaded.notes, "cameras", "rotated", "scaled")
    assert len(loaded.scene.gaussians) == layers * len(smooth.gaussians)


def test_a_wrong_camera_costs_its_view_alone(small_scene: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(small_scene, tmp_path / "scene"))
    with edited_json(folder / "transforms.json") as data:
        pose = np.array(data["frames"][1]["transform_matrix"])
        pose[:3, :3] = rotation(0.1, -0.15, 0.1) @ pose[:3, :3]
        data["frames"][1]["transform_matrix"] = pose.tolist()
    scene = load_scene(folder).scene
    right = load_scene(small_scene).scene.cameras.viewmats
    assert np.allclose(scene.cameras.viewmats[[0, -1]], right[[0, -1]])
    assert len(scene.photo_views) == len(right) - 1


def test_rotations_with_w_last(tmp_path: Path, smooth: Tiny) -> None:
    true = with_surface_rotations(smooth)
    rows = export_rows(true)
    w, x, y, z = (rows[f"rot_{i}"].copy() for i in range(4))
    rows["rot_0"], rows["rot_1"], rows["rot_2"], rows["rot_3"] = x, y, z, w
    quats = read_scene(save_export(tmp_path, smooth, rows), quats="xyzw").gaussians.quats
    assert np.abs((quats * true.gaussians.quats).sum(1)).min() > 0.9999


def test_logits_are_read_under_the_name_of_an_exporter_of_raw_opacities(tmp_path: Path, smooth: Tiny) -> None:
    """Versions differ: a later AnySplat writes logits."""
    path = save_export(tmp_path, smooth, export_rows(smooth))
    read = read_scene(path, exporter="noposplat").gaussians.opacities
    assert np.allclose(read, smooth.gaussians.opacities, atol=1e-5)


def test_a_scene_can_be_given_as_unaligned(tmp_path: Path, smooth: Tiny) -> None:
    path = save_export(tmp_path, smooth, export_rows(smooth))
    assert not read_scene(path, order="none").has_own_pixels
    assert not read_scene(path, exporter="volsplat").has_own_pixels


def test_given_scene_scale_is_applied_to_the_cameras(tmp_path: Path, smooth: Tiny) -> None:
    c2w = smooth.c2w.copy()
    c2w[:, :3, 3] *= 2
    path = save_export(tmp_path, replace(smooth, c2w=c2w), export_rows(smooth))
    scene = read_scene(path, scene_scale=0.5)
    assert np.allclose(scene.cameras.viewmats, smooth.w2c)
    assert read_scene(path).has_own_pixels


@pytest.mark.parametrize(
    ("name", "value"), [("order", "spiral"), ("quats", "zyxw"), ("scene_scale", 0.0), ("exporter", "x"), ("magic", 1)]
)
def test_unknown_or_impossible_arguments_are_refused(tmp_path: Path, smooth: Tiny, name: str, value: object) -> None:
    path = save_export(tmp_path, smooth, export_rows(smooth))
    with pytest.raises(ValueError, match="expected"):
        read_scene(path, **{name: value})


def dump_of(tiny: Tiny, folder: Path, root: Path, **changes: Any) -> Path:
    """Write ``views.npz`` beside the Gaussians by the lines of the example."""
    save_export(folder, tiny, export_rows(tiny), cameras=False)
    values = {"c2w": tiny.c2w, "K": np.tile(tiny.K, (3, 1, 1)), "images": tiny.images} | changes
    load_script(root / "examples" / "04_dump_views.py").dump_views(str(folder / "views.npz"), **values)
    return folder


def test_views_dumped_from_a_model_are_read_in_every_form(tmp_path: Path, smooth: Tiny, root: Path) -> None:
    normalised = np.tile(smooth.K / np.array([[smooth.width], [smooth.height], [1.0]]), (3, 1, 1))
    forms: dict[str, dict[str, Any]] = {
        "plain": {},
        "normalised": {"K": normalised},
        "three rows": {"c2w": smooth.c2w[:, :3]},
        "channels first": {"images": smooth.images.transpose(0, 3, 1, 2) / 255},
        "order": {"order": "view-major"},
    }
    for name, changes in forms.items():
        loaded = load_scene(dump_of(smooth, tmp_path / name, root, **changes))
        scene = loaded.scene
        assert home(scene, smooth) == 1, name
        assert loaded.cameras.source == "dump of a model"
        assert np.allclose(scene.cameras.Ks, smooth.K)
        assert np.array_equal((scene.images * 255).round(), smooth.images)
    assert not read_scene(dump_of(smooth, tmp_path / "none", root, order="none")).has_own_pixels
