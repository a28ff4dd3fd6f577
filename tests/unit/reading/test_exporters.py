"""Files are read as exporters write them, also what would break a naive reader, and rows come to their own pixels."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from exports import (
    Smooth,
    da3_rows,
    export_rows,
    home,
    of_pixels,
    save_export,
    smooth_scene,
    turned,
    with_intrinsics,
    with_surface_rotations,
)
from messages import noted, refuses
from PIL import Image
from scripts import load_script
from sharp_files import write_elements
from sweeps import sweep
from tiny_scene import Tiny, edited_json, rotation, save_json, write_colmap_text, write_images, write_inria, write_npz

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras, read_ply
from gsmerge.io.cameras.camera_file import select_views
from gsmerge.reading.read_scene import load_scene, read_scene


@pytest.fixture(scope="module")
def smooth() -> Tiny:
    """Return three views of 48 x 36 of a smooth surface."""
    return smooth_scene(48, 36)


@pytest.mark.parametrize(("order", "axes"), [("view-fastest", (1, 2, 0)), ("view-major", (0, 1, 2))])
def test_order_of_rows_without_their_borders_is_recognised(
    tmp_path: Path, smooth: Tiny, order: str, axes: tuple[int, int, int]
) -> None:
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


@pytest.mark.slow
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


def test_rotations_with_w_last_are_read_where_a_hint_says_so(tmp_path: Path, smooth: Tiny) -> None:
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


SMOOTH = smooth_scene(48, 36)
ROWS = np.arange(3 * 36 * 48).reshape(3, 36, 48)


# Depth Anything 3


@pytest.mark.parametrize("aligned", [True, False])
def test_gaussians_in_a_predicted_world_follow_the_user_s_cameras(tmp_path: Path, aligned: bool) -> None:
    """Cameras and depths in the user's world, Gaussians in the predicted one: any similarity, and a mask."""
    tiny = smooth_scene(96, 72)
    turn, shift, scale = rotation(0.5, -0.8, 0.3), np.array([2.0, -1, 4]), 1.9
    rows = turned(export_rows(tiny, da3_rows(tiny)), tiny.w2c[0, :3, :3] if aligned else turn, scale=1 / scale,
                  shift=tiny.w2c[0, :3, 3] / scale if aligned else shift)  # fmt: skip
    save_export(tmp_path / "gs_ply", tiny, rows, cameras=False, name="0000.ply")
    write_npz(tmp_path / "exports/npz/results.npz", tiny, depth=tiny.depths.astype(np.float32))
    loaded = load_scene(tmp_path / "gs_ply/0000.ply")
    scene = loaded.scene
    same = np.abs(of_pixels(scene, "opacities") - tiny.gaussians.opacities) < 1e-5
    assert same[da3_rows(tiny)].mean() > 0.99
    assert loaded.alignment.worst_px < 0.5


def test_depth_maps_that_are_not_used_are_named(tmp_path: Path) -> None:
    """Maps of another size, another number or another kind; the views may be chosen in another order."""
    tiny = smooth_scene(96, 72)
    save_export(tmp_path / "gs_ply", tiny, export_rows(tiny), cameras=False, name="0000.ply")
    path = tmp_path / "exports/npz/results.npz"
    maps = tiny.depths.astype(np.float32)
    others = {"[3, 36, 48]": maps[:, ::2, ::2], "[2, 72, 96]": maps[:2], "uint16": (1000 * maps).astype(np.uint16)}
    for found, depth in others.items():
        write_npz(path, tiny, depth=depth)
        loaded = load_scene(tmp_path)
        assert loaded.scene.depths is None
        assert noted(loaded.notes, path, found, "[3, 72, 96]")
        select_views(read_cameras(path), [2, 0])  # raises nothing
    write_npz(path, tiny, depth=maps)
    loaded = load_scene(tmp_path)
    assert loaded.scene.depths is not None
    assert not noted(loaded.notes, path, "[3, 72, 96]")


def test_arrays_as_the_demo_names_them_are_cameras_and_photos(tmp_path: Path) -> None:
    K = np.array([[52.8, 0, 24], [0, 54, 18], [0, 0, 1]])
    tiny = with_intrinsics(SMOOTH, K)
    tiny.save(tmp_path, cameras=False, images=False)
    np.savez(tmp_path / "predictions.npz", images=tiny.images.transpose(0, 3, 1, 2) / 255.0, depths=tiny.depths,
             conf=tiny.depths, extrinsics=tiny.w2c[:, :3], intrinsics=np.tile(K, (3, 1, 1)))  # fmt: skip
    loaded = load_scene(tmp_path, cameras=tmp_path / "predictions.npz")
    assert home(loaded.scene, tiny) == 1
    assert loaded.scene.images is not None


# The family of pixelSplat


# Columns


def test_harmonics_are_read_in_any_order_of_columns(tmp_path: Path) -> None:
    """``f_rest_10`` comes before ``f_rest_2`` where names were sorted as text; all columns may be anywhere."""
    rng = np.random.default_rng(0)
    rows = export_rows(SMOOTH, rest=45)
    for i in range(45):
        rows[f"f_rest_{i}"] = rng.normal(size=len(rows))
    usual = read_ply(save_export(tmp_path / "a", SMOOTH, rows, cameras=False) / "scene.ply")
    for name, names in (("text", sorted(rows.dtype.names)), ("any", rng.permutation(rows.dtype.names).tolist())):
        other = np.empty(len(rows), [(column, "<f4") for column in names])
        for column in names:
            other[column] = rows[column]
        actual = read_ply(save_export(tmp_path / name, SMOOTH, other, cameras=False) / "scene.ply")
        for field in ("means", "quats", "scales", "opacities", "sh0", "shN"):
            assert np.array_equal(getattr(actual.gaussians, field), getattr(usual.gaussians, field)), field


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_of_long_lrm_are_read_from_the_first_columns(tmp_path: Path, degree: int) -> None:
    """45 columns whatever the degree: those of a lower one stand side by side in the first columns."""
    rng, higher = np.random.default_rng(0), (degree + 1) ** 2 - 1
    shN = rng.normal(size=(ROWS.size, higher, 3)).astype(np.float32)
    rows = export_rows(SMOOTH, rest=45, normals="u1")
    for i in range(3 * higher):
        rows[f"f_rest_{i}"] = shN[:, i % higher, i // higher]
    actual = read_ply(save_export(tmp_path, SMOOTH, rows, cameras=False) / "scene.ply").gaussians.shN
    assert np.array_equal(actual[:, :higher], shN)
    assert not actual[:, higher:].any()


# SHARP


def sharp_rows(square: Smooth) -> np.ndarray:
    """Return two layers seen by a camera at the origin."""
    one = np.arange(36 * 36)
    rows = turned(export_rows(square, np.concatenate([one, one]), normals=""), square.w2c[0, :3, :3],
                  shift=square.w2c[0, :3, 3])  # fmt: skip
    rows["opacity"][36 * 36 :] = -2
    return rows


@pytest.mark.parametrize("legacy", [False, True])
def test_elements_of_sharp_give_its_camera_and_photo(tmp_path: Path, legacy: bool) -> None:
    size = (48, 36)
    (tmp_path / "images").mkdir()
    square = with_intrinsics(smooth_scene(36, 36), np.array([[39.6, 0, 18], [0, 54, 18], [0, 0, 1]]))
    cv2.imwrite(str(tmp_path / "images" / "photo.png"), cv2.resize(square.images[0], size)[..., ::-1])
    K = square.K * np.array([[size[0] / 36], [size[1] / 36], [1.0]])
    rows = sharp_rows(square)
    pose = square.w2c[1]
    rows = turned(rows, pose[:3, :3].T, shift=-pose[:3, :3].T @ pose[:3, 3])
    if legacy:
        numbers = np.concatenate([pose[:3, :3].T, pose[:3, 3:]], 1).reshape(-1)
        write_elements(tmp_path / "photo.ply", rows, numbers, [K[0, 0], K[1, 1], *size], None)
    else:
        write_elements(tmp_path / "photo.ply", rows, pose.reshape(-1), K.reshape(-1), size)
    loaded = load_scene(tmp_path / "photo.ply")
    scene = loaded.scene
    assert scene.pixels.shown.shape == (1, 36, 36)
    assert np.allclose(scene.cameras.Ks[0], square.K, atol=1e-4)
    assert np.allclose(scene.cameras.viewmats, pose, atol=1e-6)
    assert set(loaded.info.extra_elements) >= {"frame", "disparity", "color_space", "version"}
    assert "version" not in loaded.info.columns
    assert [d.name for d in loaded.exporters] == ["sharp"]
    assert scene.images.shape == (1, 36, 36, 3)
    assert np.allclose(scene.gaussians.opacities[1::2], 1 / (1 + np.exp(2)))  # those behind, of each pixel


@pytest.mark.parametrize("tag", [1, 3, 6, 8])
def test_sharp_turns_photos_upright(tmp_path: Path, tag: int) -> None:
    """As their orientation tag says, as no other model does; its camera is that of the upright photo."""
    size = (48, 64)
    square = with_intrinsics(smooth_scene(36, 36), np.array([[60.0, 0, 18], [0, 45, 18], [0, 0, 1]]))
    K = square.K * np.array([[size[0] / 36], [size[1] / 36], [1.0]])
    write_elements(tmp_path / "photo.ply", sharp_rows(square), np.eye(4).reshape(-1), K.reshape(-1), size)
    upright = cv2.resize(square.images[0], size)
    turns = {1: 0, 3: 2, 6: 1, 8: 3}[tag]  # of the pixels, which the tag undoes
    exif = Image.Exif()
    exif[274] = tag
    Image.fromarray(np.rot90(upright, turns).copy()).save(tmp_path / "photo.jpg", quality=100, subsampling=0, exif=exif)
    scene = load_scene(tmp_path / "photo.ply").scene
    small = cv2.resize(upright, (36, 36), interpolation=cv2.INTER_AREA)
    assert np.abs(scene.images[0] * 255 - small).mean() < 1.5
    large = scene.large_photos
    assert (large.width, large.height) == size
    assert np.abs(large.read(large.ids[0]).astype(int) - upright).mean() < 1.5
    # a photo that was turned already, whose tag was left as it was
    if tag in (6, 8):
        Image.fromarray(upright).save(tmp_path / "photo.jpg", quality=100, subsampling=0, exif=exif)
        again = load_scene(tmp_path / "photo.ply").scene
        assert np.abs(again.images[0] * 255 - small).mean() < 1.5


# Cameras


def test_rows_follow_names_of_images_and_not_their_ids(tmp_path: Path) -> None:
    """COLMAP numbers images as it pleases, and writes them in any order; the rows follow the names."""
    SMOOTH.save(tmp_path, cameras=False)
    write_colmap_text(tmp_path / "sparse", SMOOTH)
    lines = (tmp_path / "sparse/images.txt").read_text().splitlines()
    entries = [lines[i : i + 2] for i in range(2, 8, 2)]
    for number, entry in zip((12, 3, 9), entries, strict=True):
        entry[0] = " ".join([str(number), *entry[0].split(" ")[1:]])
    (tmp_path / "sparse/images.txt").write_text("\n".join(line for i in (1, 2, 0) for line in entries[i]) + "\n")
    scene = load_scene(tmp_path).scene
    order = [SMOOTH.names.index(name) for name in scene.names]
    assert np.allclose(scene.cameras.viewmats, SMOOTH.w2c[order], atol=1e-6)
    assert np.array_equal((scene.images * 255).round(), SMOOTH.images[order])
    opacities = of_pixels(scene, "opacities").reshape(3, -1)
    assert np.allclose(opacities, SMOOTH.gaussians.opacities.reshape(3, -1)[order], atol=1e-5)


def test_rows_in_the_order_of_names_sorted_as_text_are_recognised(tmp_path: Path) -> None:
    """Exporters sort names as text: 10, 11, 2."""
    rows = export_rows(SMOOTH, ROWS[[1, 2, 0]].reshape(-1))
    scene = load_scene(save_export(tmp_path, SMOOTH, rows)).scene
    assert np.allclose(scene.cameras.viewmats, SMOOTH.w2c)
    assert np.array_equal((scene.images * 255).round(), SMOOTH.images)


def test_inria_s_test_cameras_come_first(tmp_path: Path) -> None:
    """Names lack their extension, the file is not in the order of the names; each camera keeps its own photo."""
    centred = with_intrinsics(SMOOTH, np.array([[52.8, 0, 24], [0, 54, 18], [0, 0, 1]]))
    some = np.random.default_rng(0).permutation(ROWS.size)[:2999]
    save_export(tmp_path, centred, export_rows(centred, some, rest=45))
    (tmp_path / "transforms.json").unlink()
    write_inria(tmp_path / "cameras.json", centred)
    entries = json.loads((tmp_path / "cameras.json").read_text())
    (tmp_path / "cameras.json").write_text(json.dumps([entries[2], *entries[:2]]))
    loaded = load_scene(tmp_path)
    assert loaded.scene.names == ("11", "2", "10")
    assert np.array_equal((loaded.scene.images * 255).round(), centred.images[[2, 0, 1]])
    assert np.allclose(loaded.scene.cameras.viewmats, centred.w2c[[2, 0, 1]])
    assert "inria" in [d.name for d in loaded.exporters]


def save_world_mirror(folder: Path, scene: Smooth, photos: np.ndarray, ids: Sequence[object] = range(3)) -> None:
    """Save rows of no pixels, photos under their own names, and ``camera_params.json`` with cameras in reverse."""
    scene = replace(scene, names=tuple(f"image_{i:04d}.png" for i in range(3)))
    some = np.random.default_rng(0).permutation(len(scene.gaussians))[len(scene.gaussians) // 9 + 1 :]
    save_export(folder, scene, export_rows(scene, some), cameras=False)
    write_images(folder / "images", replace(scene, images=photos))
    matrices = {"extrinsics": scene.c2w, "intrinsics": np.tile(scene.K, (3, 1, 1))}
    lists = {
        key: [{"camera_id": i, "matrix": m.tolist()} for i, m in zip(ids, values, strict=True)][::-1]
        for key, values in matrices.items()
    }
    save_json(folder / "camera_params.json", lists)


@sweep("ids", [(0, 1, 2), ("image_0000", "image_0001", "image_0002"), ("0", "1", "2")])
def test_cameras_of_world_mirror_name_photos_by_number_or_stem(tmp_path: Path, ids: tuple) -> None:
    save_world_mirror(tmp_path, SMOOTH, SMOOTH.images, ids)
    scene = load_scene(tmp_path).scene
    order = [0, 1, 2] if str(ids[0]).isdecimal() else [2, 1, 0]
    assert np.array_equal((scene.images * 255).round(), SMOOTH.images[order])
    assert np.allclose(scene.cameras.viewmats, SMOOTH.w2c[order])
    assert (scene.cameras.width, scene.cameras.height) == (48, 36)


@pytest.mark.slow
@pytest.mark.parametrize("shown", [True, False])
def test_photos_of_rows_without_pixels_are_cropped_as_the_model_did(tmp_path: Path, shown: bool) -> None:
    """WorldMirror and its relatives crop upright photos to squares; the colours confirm it."""
    square = smooth_scene(48, 48, np.array([[60.0, 0, 24], [0, 60, 24], [0, 0, 1]]))
    images = square.images if shown else np.random.default_rng(1).integers(0, 256, square.images.shape, np.uint8)
    save_world_mirror(tmp_path, square, np.pad(images, ((0, 0), (16, 16), (0, 0), (0, 0))))
    if shown:
        assert np.array_equal((load_scene(tmp_path).scene.images * 255).round(), square.images)
    else:
        with refuses(SceneError, "images", "no part"):
            load_scene(tmp_path, cameras=tmp_path, images=tmp_path / "images")


@pytest.mark.parametrize(("middle", "size", "factor"), [
    ((28.4, 20.7), (56, 42), 1),  # near the middle of the processed size, multiples of 14
    ((28.4, 20.7), (56, 42), 2),
    ((24.0, 18.0), (48, 36), 3),  # in the middle of it
    ((24.0, 18.0), (48, 36), 0),  # no photos
])  # fmt: skip
def test_cameras_of_world_mirror_are_scaled_to_the_photos(
    tmp_path: Path, middle: tuple[float, float], size: tuple[int, int], factor: int
) -> None:
    """Its intrinsics are of the processed size, which the principal point shows."""
    K = np.array([[60.0, 0, middle[0]], [0, 61, middle[1]], [0, 0, 1]])
    scene, times = smooth_scene(*size, K), max(1, factor)
    save_world_mirror(tmp_path, scene, scene.images.repeat(times, 1).repeat(times, 2))
    if not factor:
        shutil.rmtree(tmp_path / "images")
    cameras = load_scene(tmp_path).scene.cameras
    assert (cameras.width, cameras.height) == (size[0] * times, size[1] * times)
    assert np.allclose(cameras.Ks, K * np.array([[times], [times], [1]]))


@pytest.mark.parametrize("width", [48, 96])  # of another shape than the views, and of theirs but not about the middle
def test_photos_that_were_cropped_later_are_refused_with_the_cause(tmp_path: Path, width: int) -> None:
    """Names and order propose none of them, and they do not show the views."""
    tiny = smooth_scene(96, 72)
    save_export(tmp_path / "gs_ply", tiny, export_rows(tiny), cameras=False, name="0000.ply")
    write_npz(tmp_path / "exports/npz/results.npz", tiny, depth=tiny.depths.astype(np.float32))
    for view in range(4):  # one more than there are views
        noise = np.random.default_rng(view).integers(0, 256, (72, width, 3), np.uint8)
        (tmp_path / "cut").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / f"cut/shot_{view}.png"), noise)
    sizes = ["96 x 72"] if width == 96 else ["96 x 72", f"{width} x 72"]
    with refuses(SceneError, tmp_path / "cut", *sizes, "cropped", "--images", "--cameras"):
        load_scene(tmp_path, images=tmp_path / "cut")
