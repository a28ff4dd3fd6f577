"""Cameras, photos and Gaussian grid of different sizes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import Smooth, export_rows, home, save_export, smooth_scene, turned, with_intrinsics
from messages import names, noted, refuses
from model_rows import take_views
from sweeps import sweep
from tiny_scene import Tiny, edited_json, frames_of, write_colmap_text, write_images, write_npz

from gsmerge.alignment.grids import patch_grids, shown_sizes
from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import (
    C2W_OPENGL,
    CONVENTIONS,
    W2C_OPENCV,
    StoredView,
    from_viewmats,
    make_camera_file,
)
from gsmerge.io.photo_files import PhotoTransform, resize_and_crop, resize_to
from gsmerge.scene.read import load_scene
from gsmerge.types import Cameras

SMOOTH = smooth_scene(48, 36)


def write_photos(folder: Path, tiny: Tiny, photos: list[np.ndarray]) -> None:
    for name, photo in zip(tiny.names, photos, strict=True):
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / "images" / name), photo[..., ::-1])


def write_cameras(folder: Path, tiny: Tiny, K: np.ndarray, size: tuple[int, int]) -> None:
    data = frames_of(tiny) | {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    (folder / "transforms.json").write_text(json.dumps(data | {"w": size[0], "h": size[1]}))


def original(tiny: Tiny, mapping: PhotoTransform, size: tuple[int, int]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Intrinsics and photos that the mapping makes the scene's of."""
    matrix = np.array([[mapping.scale_x, 0, -mapping.left], [0, mapping.scale_y, -mapping.top], [0, 0, 1]])
    photos = [
        cv2.warpAffine(image, np.linalg.inv(matrix)[:2], size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for image in tiny.images
    ]
    return np.linalg.inv(matrix) @ tiny.K, photos


@pytest.mark.parametrize(
    ("size", "map_photo", "words"),
    [
        ((96, 72), resize_to, "resized to 48 x 36"),
        ((98, 72), resize_to, "resized to 48 x 36"),
        ((128, 72), resize_and_crop, "resized and centre-cropped to 48 x 36"),
    ],
    ids=["half", "rounded", "cropped"],
)
def test_photos_and_cameras_larger_than_the_grid(tmp_path: Path, size: tuple, map_photo, words: str) -> None:  # type: ignore[no-untyped-def]
    tiny = smooth_scene(48, 40) if map_photo is resize_and_crop else SMOOTH
    to = tiny.width, tiny.height
    K, photos = original(tiny, map_photo(size, to), size)
    tiny.save(tmp_path, images=False)
    write_photos(tmp_path, tiny, photos)
    write_cameras(tmp_path, tiny, K, size)
    loaded = load_scene(tmp_path, order="view-major")
    scene = loaded.pixel_scene()
    assert (scene.cameras.width, scene.cameras.height) == to
    assert np.allclose(scene.cameras.Ks, tiny.K)
    assert loaded.alignment.ok
    if map_photo is resize_to:
        assert np.abs(scene.images * 255 - tiny.images).mean() < 8
    said = words.replace("36", str(tiny.height))
    assert loaded.notes == (f"photos and cameras of {size[0]} x {size[1]} are {said}, the Gaussian grid's size",)


@pytest.mark.slow
def test_photos_larger_than_cameras_and_grid(tmp_path: Path) -> None:
    """An npz at the grid's size, photos as they were taken: stretched or cropped, as their colours say."""
    for name, mapping in (("stretch", resize_to((110, 72), (48, 36))), ("crop", resize_and_crop((110, 72), (48, 36)))):
        _, photos = original(SMOOTH, mapping, (110, 72))
        folder = tmp_path / name
        SMOOTH.save(folder, cameras=False, images=False)
        write_photos(folder, SMOOTH, photos)
        write_npz(folder / "results.npz", SMOOTH, image=None, depth=np.ones((3, 36, 48), np.float32))
        loaded = load_scene(folder, images=folder / "images", order="view-major")
        scene = loaded.pixel_scene()
        assert np.abs(scene.images * 255 - SMOOTH.images).mean() < 8, name
        note = f"photos of 110 x 72 are {mapping.description}, the cameras' and the Gaussian grid's size"
        assert note in loaded.notes


def test_cameras_of_uncropped_pictures(tmp_path: Path) -> None:
    K, _ = original(SMOOTH, resize_and_crop((96, 54), (48, 36)), (96, 54))
    SMOOTH.save(tmp_path)
    write_cameras(tmp_path, SMOOTH, K, (96, 54))
    loaded = load_scene(tmp_path, order="view-major")
    assert np.allclose(loaded.pixel_scene().cameras.Ks, SMOOTH.K)
    assert loaded.notes == ("cameras of 96 x 54 are resized and centre-cropped to 48 x 36, the images' size",)


@pytest.mark.slow
@pytest.mark.parametrize("true", [c for c in CONVENTIONS if c != C2W_OPENGL], ids=" ".join)
def test_larger_photos_and_poses_read_in_another_way(tmp_path: Path, true: tuple[str, str]) -> None:
    K, photos = original(SMOOTH, resize_to((96, 72), (48, 36)), (96, 72))
    SMOOTH.save(tmp_path, images=False)
    write_cameras(tmp_path, SMOOTH, K, (96, 72))
    write_photos(tmp_path, SMOOTH, photos)
    with edited_json(tmp_path / "transforms.json") as data:
        for frame, pose in zip(data["frames"], from_viewmats(SMOOTH.w2c, true), strict=True):
            frame["transform_matrix"] = pose.tolist()
    loaded = load_scene(tmp_path, order="view-major")
    scene = loaded.pixel_scene()
    assert np.allclose(scene.cameras.viewmats, SMOOTH.w2c)
    assert np.allclose(scene.cameras.Ks, SMOOTH.K)
    assert loaded.cameras.convention == true
    assert len(loaded.notes) == 2
    assert "48 x 36" in loaded.notes[0]
    assert names(loaded.notes[1], "poses", *true)


def test_cameras_larger_than_the_grid_and_no_photos(tmp_path: Path) -> None:
    K, _ = original(SMOOTH, resize_to((96, 72), (48, 36)), (96, 72))
    SMOOTH.save(tmp_path, cameras=False, images=False)
    larger = Tiny(SMOOTH.c2w, K, 96, 72, SMOOTH.images, SMOOTH.gaussians, SMOOTH.names)
    write_colmap_text(tmp_path / "sparse", larger)
    loaded = load_scene(tmp_path, order="view-major")
    assert np.allclose(loaded.pixel_scene().cameras.Ks, SMOOTH.K)
    assert loaded.notes == ("cameras of 96 x 72 are resized to 48 x 36, the Gaussian grid's size",)


def trimmed(tiny: Smooth, trim: int) -> np.ndarray:
    """Indices of the inner pixels, view by view."""
    index = np.arange(3 * tiny.height * tiny.width).reshape(3, tiny.height, tiny.width)
    return index[:, trim : tiny.height - trim, trim : tiny.width - trim].reshape(-1)


@sweep("trim", [2, 4, 7, 11])
def test_borders_of_any_width(tmp_path: Path, trim: int) -> None:
    """A resize with another scale and a shift would fit as well, to a fraction of a pixel."""
    tiny = smooth_scene(96, 72)
    rows = turned(export_rows(tiny, trimmed(tiny, trim)), tiny.w2c[0, :3, :3])
    loaded = load_scene(save_export(tmp_path, tiny, rows))
    assert loaded.recovery.best.layout.description.startswith(f"{trim} pixels trimmed")
    assert loaded.recovery.best.frame.kind == "first"
    assert np.array_equal(np.flatnonzero(loaded.pixel_scene().pixels.shown.reshape(-1)), trimmed(tiny, trim))


def test_a_resize_that_looks_like_a_trim(tmp_path: Path) -> None:
    """Photos of 64 x 48 shrunk and cropped to 56 x 40, in another scale: four pixels less at every border."""
    tiny, mapping = smooth_scene(56, 40), resize_and_crop((64, 48), (56, 40))
    K, photos = original(tiny, mapping, (64, 48))
    wide = replace(tiny, K=K, width=64, height=48, images=np.stack(photos))
    rows = turned(export_rows(tiny), np.eye(3), scale=1.7, shift=np.array([0.3, 0.1, -0.2]))
    loaded = load_scene(save_export(tmp_path, wide, rows), order="view-major")
    assert noted(loaded.notes, "64 x 48", "56 x 40")
    assert np.allclose(loaded.pixel_scene().cameras.Ks, tiny.K)


def test_a_trimmed_grid_of_another_size(tmp_path: Path) -> None:
    K, photos = original(SMOOTH, resize_to((96, 72), (48, 36)), (96, 72))
    grid = np.arange(3 * 36 * 48).reshape(3, 36, 48)[:, 8:-8, 8:-8]
    save_export(tmp_path, SMOOTH, export_rows(SMOOTH, grid.reshape(-1)))
    write_photos(tmp_path, SMOOTH, photos)
    write_cameras(tmp_path, SMOOTH, K, (96, 72))
    scene = load_scene(tmp_path).pixel_scene()
    assert scene.pixels.shown.shape == (3, 36, 48)
    assert int(scene.pixels.shown.sum()) == grid.size


@pytest.mark.slow
def test_dropped_pixels_of_a_patched_grid(tmp_path: Path) -> None:
    """Depth Anything 3 beside COLMAP cameras at the photos' own size: 504 pixels, border and far pixels dropped."""
    tiny = smooth_scene(504, 28)
    K, photos = original(tiny, resize_to((1008, 56), (504, 28)), (1008, 56))
    keep = np.ones((3, 28, 504), bool)
    keep[:, :, :15] = keep[:, :, -15:] = False
    keep[:, np.random.default_rng(0).random((28, 504)) > 0.9] = False
    save_export(tmp_path, tiny, export_rows(tiny, np.flatnonzero(keep)), cameras=False)
    write_photos(tmp_path, tiny, photos)
    write_cameras(tmp_path, tiny, K, (1008, 56))
    loaded = load_scene(tmp_path)
    assert loaded.scene.has_own_pixels
    assert (loaded.scene.cameras.width, loaded.scene.cameras.height) == (504, 28)
    assert noted(loaded.notes, "resized", "504 x 28")


@pytest.mark.parametrize("size", [(128, 128), (128, 140)], ids=["four times the grid", "stretched"])
def test_resplat_s_grids(size: tuple[int, int], tmp_path: Path) -> None:
    """A quarter of what photos were stretched to, in the middle camera; grids of other sizes, trimmed, fit as well.

    Takes a second: many sizes have as many pixels, and all are tried.
    """
    tiny = take_views(smooth_scene(32, 32), 2)
    middle = np.linalg.inv(tiny.c2w[1])
    save_export(tmp_path, tiny, turned(export_rows(tiny, rest=45), middle[:3, :3], shift=middle[:3, 3]), cameras=False)
    K, photos = original(tiny, resize_to(size, (32, 32)), size)
    write_photos(tmp_path, tiny, photos)
    write_cameras(tmp_path, tiny, K, size)
    scene = load_scene(tmp_path, order="view-major").pixel_scene()
    assert (scene.cameras.width, scene.cameras.height) == (32, 32)
    assert np.allclose(scene.cameras.Ks, tiny.K, rtol=0.01)
    assert home(scene, tiny) == 1


def test_photos_of_depth_maps_without_images_are_resized(tmp_path: Path) -> None:
    """Grey rows do not tell whether photos were cropped."""
    tiny = smooth_scene(112, 84)
    write_npz(tmp_path / "exports/mini_npz/results.npz", tiny, image=None, depth=tiny.depths)
    size = (240, 176)
    photos = np.stack(original(tiny, resize_to(size, (112, 84)), size)[1])
    photos[:, :, [0, 1, 2, -3, -2, -1]] = 255  # which is far from grey
    write_photos(tmp_path, tiny, list(photos))
    loaded = load_scene(tmp_path, images=tmp_path / "images")
    assert noted(loaded.notes, "photos of 240 x 176 are resized to 112 x 84")


def test_mappings_move_a_point_and_its_photo_alike() -> None:
    photo = np.zeros((60, 100, 3), np.uint8)
    photo[24:36, 64:72] = 255
    for mapping in (resize_to((100, 60), (50, 24)), resize_and_crop((100, 60), (30, 30))):
        (small,) = mapping.photos([photo])
        assert small.shape == (mapping.height, mapping.width, 3)
        y, x = (np.average(np.arange(n) + 0.5, weights=small[..., 0].sum(axis)) for n, axis in
                ((mapping.height, 1), (mapping.width, 0)))  # fmt: skip
        K = np.array([[[1.0, 0, 68], [0, 1, 30], [0, 0, 1]]], np.float64)
        (moved,) = mapping.cameras(Cameras(np.eye(4)[None], K, 100, 60)).Ks
        assert (x, y) == pytest.approx((float(moved[0, 2]), float(moved[1, 2])), abs=0.1)


def test_sizes_of_photos_whose_pixels_may_have_a_shape() -> None:
    actual = [(m.width, m.height) for m in shown_sizes((640, 480), (64, 48))]
    assert actual[0] == (64, 48)
    assert (64 + 16, 48 + 16) in actual
    assert shown_sizes((640, 480), (97, 89)) == []
    assert (256, 256) in [(m.width, m.height) for m in shown_sizes((640, 360), (256, 256))]
    for height in (160, 161):  # half of 320, and of 322, the next multiple of 14
        bordered = 224 - 2 * 7, height - 2 * 5
        assert (224, height) in [(m.width, m.height) for m in shown_sizes((448, 320), bordered)]


def test_sizes_of_patches() -> None:
    descriptions = {m.description for m in patch_grids((4032, 3024))}
    assert "resized to 504 x 378" in descriptions
    assert "resized to 518 x 392" in descriptions
    assert {(m.width, m.height) for m in patch_grids((1920, 1080))} >= {(504, 280), (518, 294), (518, 280)}
    crop = next(m for m in patch_grids((1920, 1080)) if m.top)
    assert (crop.width, crop.height, crop.top) == (504, 280, 2)
    assert list(patch_grids((400, 300))) == []


def test_sizes_that_are_twice_a_principal_point(tmp_path: Path, tiny: Tiny) -> None:
    """They may be a pixel off; intrinsics stay those of the photos."""
    folder = tiny.save(tmp_path / "scene")
    write_cameras(folder, tiny, tiny.K, (tiny.width + 1, tiny.height))
    loaded = load_scene(folder)
    assert np.allclose(loaded.pixel_scene().cameras.Ks, tiny.K)
    assert not noted(loaded.notes, "scaled")


@pytest.mark.slow
def test_sizes_that_are_twice_a_principal_point_out_of_the_middle(tmp_path: Path) -> None:
    """Those of Lyra 2, whose Gaussians are of half the photos' size, show that intrinsics are those of the photos."""
    K = np.array([[55, 0, 24.5], [0, 55, 18], [0, 0, 1.0]])
    scene = with_intrinsics(smooth_scene(48, 36), K)
    save_export(tmp_path, scene, export_rows(scene), cameras=False)
    larger = replace(scene, K=K * [[2], [2], [1]], width=96, height=72, images=scene.images.repeat(2, 1).repeat(2, 2))
    write_cameras(tmp_path, larger, larger.K, (98, 72))
    write_images(tmp_path / "images", larger)
    loaded = load_scene(tmp_path, order="view-major")
    assert np.allclose(loaded.pixel_scene().cameras.Ks, K)
    assert noted(loaded.notes, "96 x 72", "48 x 36")


def test_intrinsics_divided_by_the_size(tmp_path: Path, tiny: Tiny) -> None:
    small = np.diag([1 / tiny.width, 1 / tiny.height, 1]) @ tiny.K
    folder = tiny.save(tmp_path / "scene")
    for size in ((20, 14), (0, 0)):
        write_cameras(folder, tiny, small, size)
        assert np.allclose(load_scene(folder).pixel_scene().cameras.Ks, tiny.K)
    (folder / "transforms.json").unlink()
    (folder / "camera_poses.txt").write_text("\n".join(" ".join(map(str, p.reshape(-1))) for p in tiny.c2w))
    (folder / "intrinsic.txt").write_text(f"{small[0, 0]} {small[1, 1]} {small[0, 2]} {small[1, 2]}")
    assert np.allclose(load_scene(folder).pixel_scene().cameras.Ks, tiny.K)


def test_short_intrinsics_in_pixels_stay() -> None:
    for K, size in (([[9.0, 0, 4], [0, 9, 4], [0, 0, 1]], (8, 8)), ([[50.0, 0, 0.5], [0, 50, 0.5], [0, 0, 1]], (0, 0))):
        read = make_camera_file("x", "x", W2C_OPENCV, [StoredView("a", np.eye(4), np.array(K), size)])
        assert np.array_equal(read.Ks[0], np.array(K))
        assert (int(read.widths[0]), int(read.heights[0])) == size


def test_previews_are_refused(tmp_path: Path) -> None:
    SMOOTH.save(tmp_path, images=False)
    write_photos(tmp_path, SMOOTH, [cv2.resize(image, (24, 18)) for image in SMOOTH.images])
    with refuses(SceneError, "transforms.json", "48 x 36", "24 x 18"):
        load_scene(tmp_path, cameras=tmp_path, images=tmp_path / "images")
    write_photos(tmp_path, SMOOTH, [cv2.resize(image, (44, 33)) for image in SMOOTH.images])
    assert load_scene(tmp_path).pixel_scene().images.shape == (3, 36, 48, 3)


def test_previews_show_rows_in_any_order(tmp_path: Path) -> None:
    """Rows that are no pixels in their order need no photos of a grid's size."""
    order = np.random.default_rng(0).permutation(len(SMOOTH.gaussians))
    replace(SMOOTH, gaussians=SMOOTH.gaussians[order]).save(tmp_path, images=False)
    write_photos(tmp_path, SMOOTH, [cv2.resize(image, (24, 18)) for image in SMOOTH.images])
    scene = load_scene(tmp_path).scene
    assert (scene.cameras.width, scene.cameras.height, len(scene.images)) == (24, 18, 3)
    assert scene.num_gaussians == len(SMOOTH.gaussians)
