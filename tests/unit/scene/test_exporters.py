"""Files as exporters write them: each is read without a word, and every row comes to its own pixel."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exports import (
    da3_rows,
    depth_map_mask,
    export_rows,
    home,
    of_pixels,
    save_export,
    smooth_scene,
    turned,
    with_surface_rotations,
)
from messages import noted, refuses
from scripts import load_script
from sweeps import sweep
from tiny_scene import Tiny, rotation, write_npz

from gsmerge.errors import SceneError
from gsmerge.io import read_ply
from gsmerge.scene.read import load_scene, read_scene


@pytest.fixture(scope="module")
def smooth() -> Tiny:
    """Three views of 48 x 36 of a smooth surface."""
    return smooth_scene(48, 36)


def test_depthsplat(tmp_path: Path) -> None:
    smooth = smooth_scene(64, 48)
    h, w = smooth.height, smooth.width
    inner = np.arange(3 * h * w).reshape(3, h, w)[:, 8:-8, 8:-8].reshape(3, -1)
    rows = export_rows(smooth, inner.T.reshape(-1))
    turn = smooth.w2c[0, :3, :3]
    loaded = load_scene(save_export(tmp_path, smooth, turned(rows, turn)))
    scene = loaded.pixel_scene()
    assert home(scene, smooth) == 1
    assert [d.name for d in loaded.exporters] == ["depthsplat"]
    assert loaded.recovery.best.frame.kind == "first"
    assert scene.num_gaussians == int(scene.pixels.shown.sum()) == inner.size
    assert int((~scene.pixels.shown).sum()) == 3 * h * w - inner.size
    # the Gaussians stay where the file has them, and the cameras are moved
    assert np.array_equal(scene.gaussians.means[0], read_ply(tmp_path / "scene.ply").gaussians.means[0])
    assert np.allclose(scene.cameras.viewmats[0, :3, :3], np.eye(3), atol=1e-6)
    assert np.isfinite(scene.gaussians.means).all()


@pytest.mark.parametrize(("nested", "ties"), [(1.7, False), (1.0, True)])
def test_depth_anything(tmp_path: Path, nested: float, ties: bool) -> None:
    tiny = smooth_scene(48, 36)
    depths = tiny.depths.copy()
    if ties:
        depths[:, :7] = depths.max()  # a sky of one depth, more than a tenth of the view: kept
    kept = da3_rows(tiny, depths)
    rows = export_rows(tiny, kept)
    save_export(tmp_path / "gs_ply", tiny, rows, cameras=False, name="0000.ply")
    w2c = tiny.w2c[:, :3].astype(np.float32)
    w2c[:, :, 3] *= nested
    write_npz(tmp_path / "exports/mini_npz/results.npz", tiny, extrinsics=w2c,
              depth=(depths * nested).astype(np.float32), image=tiny.images)  # fmt: skip
    loaded = load_scene(tmp_path / "gs_ply" / "0000.ply")
    assert loaded.recovery.best.layout.kind in (("box", "box+depth") if ties else ("box+depth",))
    assert loaded.recovery.best.frame.scale == pytest.approx(1 / nested, rel=1e-3)
    assert [d.name for d in loaded.exporters] == ["da3"]
    scene = loaded.pixel_scene()
    assert home(scene, tiny, kept) == 1
    assert scene.num_gaussians == len(kept)
    sky = np.isin(np.arange(2 * 48 + 1, 3 * 48 - 1), kept)
    assert ties == bool(sky.all())
    if not ties:  # what was dropped is put back where the depth maps have it
        assert scene.pixels.shown.all()
        error = np.linalg.norm(of_pixels(scene, "means") - tiny.gaussians.means, axis=1)
        assert error.max() < 0.1
        assert np.abs(of_pixels(scene, "sh0") - tiny.gaussians.sh0).max() < 1e-4


def test_depth_anything_every_other_view(tmp_path: Path) -> None:
    tiny = smooth_scene(48, 36)
    kept = [np.flatnonzero(depth_map_mask(d)) + i * d.size for i, d in enumerate(tiny.depths)]
    save_export(tmp_path / "gs_ply", tiny, export_rows(tiny, np.concatenate(kept[::2])), cameras=False, name="0000.ply")
    write_npz(tmp_path / "exports/npz/results.npz", tiny, depth=tiny.depths, image=tiny.images)
    loaded = load_scene(tmp_path / "gs_ply" / "0000.ply")
    assert loaded.scene.names == ("view 0", "view 2")
    assert noted(loaded.notes, "2 of 3")


@pytest.mark.parametrize(
    ("order", "axes"), [("view-fastest", (1, 2, 0)), ("column-major", (0, 2, 1)), ("view-major", (0, 1, 2))]
)
def test_orders(tmp_path: Path, smooth: Tiny, order: str, axes: tuple[int, int, int]) -> None:
    index = np.arange(3 * smooth.height * smooth.width).reshape(3, smooth.height, smooth.width)
    path = save_export(tmp_path, smooth, export_rows(smooth, index.transpose(axes).reshape(-1)))
    loaded = load_scene(path)
    assert loaded.recovery.best.layout.order == order
    assert home(loaded.pixel_scene(), smooth) == 1
    assert home(load_scene(path, order=order).pixel_scene(), smooth) == 1


@sweep("views", [(0, 2), (0, 1), (1, 2), (2,)])
def test_some_of_the_views(tmp_path: Path, smooth: Tiny, views: tuple[int, ...]) -> None:
    size = smooth.height * smooth.width
    index = np.concatenate([np.arange(size) + view * size for view in views])
    scene = load_scene(save_export(tmp_path, smooth, export_rows(smooth, index))).pixel_scene()
    assert scene.names == tuple(f"images/{smooth.names[view]}" for view in views)


def test_the_pixelsplat_world(tmp_path: Path, smooth: Tiny) -> None:
    """Recentred, divided, upright from the first camera; raw opacities; camera-frame rotations, turned as well."""
    world, g = rotation(1.0, -1.2, 0.6), smooth.gaussians
    c2w = np.concatenate([world @ smooth.c2w[:, :3], smooth.c2w[:, 3:]], 1)
    smooth = replace(smooth, c2w=c2w, gaussians=replace(g, means=(g.means @ world.T).astype(np.float32)))
    tiny = with_surface_rotations(smooth, relative_to_camera=True)
    half = np.sqrt(0.5)
    upright = np.array([[half, half, 0], [-half, half, 0], [0, 0, 1]]) @ np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    rows = turned(export_rows(tiny), upright @ tiny.w2c[0, :3, :3], scale=1 / 3, shift=np.array([0.3, 0.1, -0.2]))
    rows["opacity"] = tiny.gaussians.opacities
    loaded = load_scene(save_export(tmp_path, tiny, rows))
    assert loaded.recovery.best.frame.kind == "upright"
    assert "pixelsplat" in [d.name for d in loaded.exporters]
    assert noted(loaded.notes, "relative", "camera")
    assert home(loaded.pixel_scene(), tiny) == 1
    true = turned(export_rows(with_surface_rotations(smooth)), upright @ tiny.w2c[0, :3, :3])
    agree = sum(loaded.scene.gaussians.quats[:, i] * true[f"rot_{i}"] for i in range(4))
    assert np.abs(agree).min() > 0.9999


@pytest.mark.parametrize("stored", ["wxyz", "xyzw", "camera"])
def test_rotations(tmp_path: Path, smooth: Tiny, stored: str) -> None:
    true = with_surface_rotations(smooth)
    rows = export_rows(with_surface_rotations(smooth, relative_to_camera=stored == "camera"))
    if stored == "xyzw":
        w, x, y, z = (rows[f"rot_{i}"].copy() for i in range(4))
        rows["rot_0"], rows["rot_1"], rows["rot_2"], rows["rot_3"] = x, y, z, w
    path = save_export(tmp_path, smooth, rows)
    # the cameras differ by a few degrees only: not enough to tell from the surface
    for hints in (stored,) if stored == "camera" else ("auto", stored):
        quats = read_scene(path, quats=hints).gaussians.quats
        agree = np.abs((quats * true.gaussians.quats).sum(1))
        assert agree.min() > 0.9999
    loaded = load_scene(path)
    assert noted(loaded.notes, "rotations") == (stored == "xyzw")


def test_raw_opacities(tmp_path: Path, smooth: Tiny) -> None:
    rows = export_rows(smooth)
    rows["opacity"] = smooth.gaussians.opacities
    path = save_export(tmp_path, smooth, rows)
    assert home(read_scene(path), smooth) == 1
    logit = read_scene(path, exporter="splatter-image", order="view-major").gaussians.opacities
    assert np.allclose(logit, 1 / (1 + np.exp(-smooth.gaussians.opacities)), atol=1e-5)


def test_logits_under_the_name_of_an_exporter_of_raw_opacities(tmp_path: Path, smooth: Tiny) -> None:
    """Versions differ: a later AnySplat writes logits."""
    path = save_export(tmp_path, smooth, export_rows(smooth))
    read = read_scene(path, exporter="noposplat").gaussians.opacities
    assert np.allclose(read, smooth.gaussians.opacities, atol=1e-5)


def test_infinite_opacities_and_nan_scales(tmp_path: Path) -> None:
    smooth = smooth_scene(64, 48)
    h, w = smooth.height, smooth.width
    rows = export_rows(smooth, np.arange(3 * h * w).reshape(3, h, w)[:, 8:-8, 8:-8].transpose(1, 2, 0).reshape(-1))
    rows["opacity"][0], rows["opacity"][1] = np.inf, -np.inf
    rows["scale_1"][3:6] = np.nan
    scene = load_scene(save_export(tmp_path, smooth, rows)).pixel_scene()
    assert of_pixels(scene, "opacities").reshape(3, h, w)[0, 8, 8] == 1
    assert not scene.pixels.shown[1, 8, 8]  # nothing draws it
    assert not scene.pixels.shown[:, 8, 9].any()
    assert int(scene.pixels.shown.sum()) == scene.num_gaussians == len(rows) - 4


def test_byte_normals_are_long_lrm(tmp_path: Path, smooth: Tiny) -> None:
    rows = export_rows(smooth, rest=45, normals="u1")
    loaded = load_scene(save_export(tmp_path, smooth, rows))
    assert [d.name for d in loaded.exporters] == ["longlrm"]
    assert home(loaded.pixel_scene(), smooth) == 1


def test_a_scene_can_be_given_as_unaligned(tmp_path: Path, smooth: Tiny) -> None:
    path = save_export(tmp_path, smooth, export_rows(smooth))
    assert not read_scene(path, order="none").has_own_pixels
    assert not read_scene(path, exporter="volsplat").has_own_pixels


def test_a_given_scale(tmp_path: Path, smooth: Tiny) -> None:
    c2w = smooth.c2w.copy()
    c2w[:, :3, 3] *= 2
    path = save_export(tmp_path, replace(smooth, c2w=c2w), export_rows(smooth))
    scene = read_scene(path, scene_scale=0.5)
    assert np.allclose(scene.cameras.viewmats, smooth.w2c)
    assert read_scene(path).has_own_pixels


@pytest.mark.parametrize(
    ("name", "value"), [("order", "spiral"), ("quats", "zyxw"), ("scene_scale", 0.0), ("exporter", "x"), ("magic", 1)]
)
def test_wrong_arguments(tmp_path: Path, smooth: Tiny, name: str, value: object) -> None:
    path = save_export(tmp_path, smooth, export_rows(smooth))
    with pytest.raises(ValueError, match="expected"):
        read_scene(path, **{name: value})


def dump_of(tiny: Tiny, folder: Path, root: Path, **changes: Any) -> Path:
    """``views.npz`` beside the Gaussians, written by the lines of the example."""
    save_export(folder, tiny, export_rows(tiny), cameras=False)
    values = {"c2w": tiny.c2w, "K": np.tile(tiny.K, (3, 1, 1)), "images": tiny.images} | changes
    load_script(root / "examples" / "04_dump_views.py").dump_views(str(folder / "views.npz"), **values)
    return folder


def test_views_dumped_from_a_model(tmp_path: Path, smooth: Tiny, root: Path) -> None:
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
        scene = loaded.pixel_scene()
        assert home(scene, smooth) == 1, name
        assert loaded.cameras.source == "dump of a model"
        assert np.allclose(scene.cameras.Ks, smooth.K)
        assert np.array_equal((scene.images * 255).round(), smooth.images)
    assert not read_scene(dump_of(smooth, tmp_path / "none", root, order="none")).has_own_pixels


def test_a_damaged_dump(tmp_path: Path, smooth: Tiny, root: Path) -> None:
    with refuses(SceneError, "views.npz", "'order'", "magic"):
        read_scene(dump_of(smooth, tmp_path / "order", root, order="magic"), cameras=tmp_path / "order")
    with refuses(SceneError, "views.npz", "[v,4,4]", (3, 4, 4)):
        read_scene(dump_of(smooth, tmp_path / "K", root, K=smooth.K), cameras=tmp_path / "K")
