"""A folder is read as a scene with cameras, photos and pixels, or refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from messages import noted, refuses
from tiny_scene import Tiny, edited_json, frames_of, write_colmap_binary, write_images, write_npz, write_transforms

from gsmerge.errors import SceneError
from gsmerge.reading.read_scene import load_scene, read_scene
from gsmerge.reading.scene_files import scene_title


def rewrite(path: Path, change: Callable[[dict], None]) -> None:
    with edited_json(path) as data:
        change(data)


def name_photos(folder: Path, names: list[str]) -> None:
    """Change the places of photos in a camera file."""
    with edited_json(folder / "transforms.json") as data:
        for frame, name in zip(data["frames"], names, strict=True):
            frame["file_path"] = name


def test_plain_scene_has_its_cameras_photos_and_pixels(tiny_folder: Path, tiny: Tiny) -> None:
    scene = read_scene(tiny_folder)
    assert len(scene) == 3
    assert (scene.cameras.width, scene.cameras.height) == (20, 14)
    assert np.allclose(scene.cameras.viewmats, tiny.w2c)
    assert np.array_equal((scene.images * 255).round(), tiny.images)
    assert scene.pixels.shown.all()
    assert scene.names == tuple(f"images/{n}" for n in tiny.names)
    assert np.allclose(scene.gaussians.means, tiny.gaussians.means)
    loaded = load_scene(tiny_folder / "scene.ply")
    assert loaded.alignment.ok
    assert loaded.info.layout == "17-column export"
    assert loaded.files.images == tiny_folder / "images"
    assert loaded.cameras.source == "transforms.json"
    assert (loaded.notes, tuple(loaded.moves)) == ((), ())


def test_images_of_an_npz_are_the_photos(tmp_path: Path, tiny: Tiny) -> None:
    tiny.save(tmp_path / "gs_ply", cameras=False, images=False)
    (tmp_path / "gs_ply" / "scene.ply").rename(tmp_path / "gs_ply" / "0000.ply")
    write_npz(tmp_path / "exports/npz/results.npz", tiny)
    scene = read_scene(tmp_path / "gs_ply" / "0000.ply")
    assert np.array_equal((scene.images * 255).round(), tiny.images)
    assert scene.names == ("view 0", "view 1", "view 2")
    other = tiny.save(tmp_path / "other", images=False)
    named = read_scene(other, images=tmp_path / "exports/npz/results.npz")
    assert np.array_equal(named.images, scene.images)


@pytest.mark.parametrize("name", ["../other/{}", "{root}/other/{}", "images/../../other/{}"])
def test_photos_outside_the_scene_are_not_read_unless_named(name: str, tmp_path: Path, tiny: Tiny) -> None:
    """Whatever a stranger's camera file names; --images may name them."""
    folder = tiny.save(tmp_path / "scene", images=False)
    write_images(tmp_path / "other", tiny)
    places = [name.format(n, root=tmp_path) for n in tiny.names]
    name_photos(folder, places)
    load = load_scene(folder)
    assert load.scene.images is None
    assert noted(load.doubts, str(tmp_path / "other" / tiny.names[0]), "--images")
    assert np.array_equal((read_scene(folder, images=tmp_path / "other").images * 255).round(), tiny.images)
    shutil.rmtree(tmp_path / "other")
    assert read_scene(folder).images is None  # as on every machine but the one that trained it


def test_photos_beside_a_colmap_scene_are_not_its_own(tmp_path: Path, tiny: Tiny) -> None:
    """Whose model lies in the scene's own folder."""
    folder = tiny.save(tmp_path / "scene", images=False)
    (folder / "transforms.json").unlink()
    write_colmap_binary(folder, tiny)
    write_images(tmp_path, tiny)
    assert read_scene(folder).images is None
    write_images(folder, tiny)
    assert np.array_equal((read_scene(folder).images * 255).round(), tiny.images)


def test_photos_inside_the_scene_are_found_by_any_path(tmp_path: Path, tiny: Tiny) -> None:
    """With their whole paths, through a link to the folder, and with .. that comes back."""
    tiny.save(tmp_path / "scene", images=False)
    write_images(tmp_path / "scene" / "train", tiny)
    (tmp_path / "link").symlink_to("scene")
    for root in (tmp_path / "scene", tmp_path / "link"):
        for place in (root, tmp_path / "scene", "x/.."):
            name_photos(root, [f"{place}/train/{name}" for name in tiny.names])
            assert np.array_equal((read_scene(root).images * 255).round(), tiny.images)


def test_rows_with_nan_keep_the_order(tmp_path: Path, tiny: Tiny) -> None:
    folder = tiny.save(tmp_path / "scene")
    data = bytearray((folder / "scene.ply").read_bytes())
    start = data.index(b"end_header\n") + 11
    for row in (0, 301):
        data[start + 68 * row : start + 68 * row + 4] = np.float32(np.nan).tobytes()
    (folder / "scene.ply").write_bytes(data)
    before = read_scene(tiny.save(tmp_path / "whole")).gaussians
    scene = read_scene(folder)
    good = scene.pixels.shown.reshape(-1)
    for name, column in vars(before).items():
        assert np.array_equal(getattr(scene.gaussians, name), column[good]), name
    assert scene.pixels.shown.sum() == 3 * 14 * 20 - 2
    assert not scene.pixels.shown[0, 0, 0]
    assert not scene.pixels.shown[1, 1, 1]  # 301 = 280 + 20 + 1


def test_rows_in_the_order_of_the_names_of_views(tiny_folder: Path, tiny: Tiny) -> None:
    """2, 10, 11: numbers, not letters; cameras are in another order."""
    rewrite(tiny_folder / "transforms.json", lambda data: data["frames"].reverse())
    scene = load_scene(tiny_folder).scene
    assert scene.names == tuple(f"images/{n}" for n in tiny.names[::-1])
    assert np.allclose(scene.cameras.viewmats, tiny.w2c[::-1])
    assert np.array_equal((scene.images * 255).round(), tiny.images[::-1])
    assert np.array_equal(scene.gaussians.means.reshape(3, -1), tiny.gaussians.means.reshape(3, -1)[::-1])


def test_cameras_of_a_resized_image_are_scaled(tiny_folder: Path, tiny: Tiny) -> None:
    data = frames_of(tiny)
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        data[key] *= 4
    (tiny_folder / "transforms.json").write_text(json.dumps(data))
    loaded = load_scene(tiny_folder)
    assert np.allclose(loaded.scene.cameras.Ks, tiny.K)
    assert loaded.notes == ("intrinsics scaled from 80 x 56 to the images' 20 x 14",)


# What does not fit


@pytest.mark.slow
def test_cameras_of_another_shape_are_refused(tiny_folder: Path, tiny: Tiny) -> None:
    rewrite(tiny_folder / "transforms.json", lambda data: data.update(w=50))  # no photo shows half of such a view
    with refuses(SceneError, "images", "20 x 14", "50 x 14", "no part"):
        read_scene(tiny_folder, order="view-major", cameras=tiny_folder, images=tiny_folder / "images")
    rewrite(tiny_folder / "transforms.json", lambda data: data.update(w=14, h=20))
    with refuses(SceneError, "transforms.json", "14 x 20", "swapped"):
        read_scene(tiny_folder, order="view-major", cameras=tiny_folder, images=tiny_folder / "images")


def test_swapped_sizes_without_images_are_refused(tmp_path: Path, tiny: Tiny) -> None:
    folder = tiny.save(tmp_path, images=False)
    rewrite(folder / "transforms.json", lambda data: data.update(w=14, h=20))
    with refuses(SceneError, "transforms.json", "median", "cameras"):
        read_scene(folder, order="view-major", cameras=folder)


def test_npz_of_too_few_images_is_refused(tiny_folder: Path, tiny: Tiny, tmp_path: Path) -> None:
    two = {"extrinsics": tiny.w2c[:2], "intrinsics": np.tile(tiny.K, (2, 1, 1)), "depth": None}
    write_npz(tmp_path / "two.npz", tiny, image=tiny.images[:2], **two)
    with refuses(SceneError, "two.npz", "3 images", 2):
        read_scene(tiny_folder, images=tmp_path / "two.npz")


def test_cameras_of_another_scene_are_refused_with_what_was_measured(tiny_folder: Path, tiny: Tiny) -> None:
    strange = tiny.c2w.copy()
    strange[:, :3, 3] += np.array([[0.3], [-0.2], [0.4]])
    write_transforms(tiny_folder / "transforms.json", replace(tiny, c2w=strange))
    with refuses(SceneError, "transforms.json", "median", "1.5 px", "convention"):
        read_scene(tiny_folder, order="view-major", cameras=tiny_folder)


@pytest.mark.parametrize(
    ("path", "title"),
    [
        ("room/scene.ply", "room"),
        ("room/scene.compact.ply", "room"),
        ("room/a.compact.ply", "a"),
        ("room/b.ply", "b"),
        ("room/exports/gs_ply/0000.ply", "room"),
        ("room/gs_ply/0000.ply", "room"),
        ("room/point_cloud/iteration_30000/point_cloud.ply", "room"),
        ("0003/gaussians.ply", "0003"),
        ("/scene.ply", "scene"),
    ],
)
def test_a_scene_is_named_by_its_file_or_its_folder(path: str, title: str) -> None:
    assert scene_title(Path(path)) == title
