"""Photos may be larger or smaller than the grid of the rows, of several shapes, and are read when they are needed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import Smooth, export_rows, save_export, smooth_scene
from messages import noted, refuses
from shared import make_once
from tiny_scene import Tiny, edited_json

import gsmerge
from gsmerge import Scene
from gsmerge.errors import SceneError
from gsmerge.method.fit.photo_sizes import large_photos, largest_scale
from gsmerge.method.raster.metrics import psnr
from gsmerge.reading.read_scene import load_scene
from gsmerge.research.generate import GenerateOptions, generate_scene

WIDTH, HEIGHT, SCALE = 48, 32, 3


def made_once() -> Path:
    """Return a scene whose photos are three times as large as its grid. Read only."""
    options = GenerateOptions(views=3, width=WIDTH, height=HEIGHT, noise=0.3, photo_scale=SCALE)
    return make_once("large", lambda folder: generate_scene(folder, options, seed=2))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Copy the scene, so that a test may change it."""
    return Path(shutil.copytree(made_once(), tmp_path / "scene"))


def change_cameras(folder: Path, change: Callable[[dict[str, float]], None]) -> None:
    with edited_json(folder / "transforms.json") as document:
        change(document)


def enlarge(document: dict[str, float]) -> None:
    for name in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        document[name] *= SCALE


def shift_between(scene: Scene, scale: float) -> tuple[float, float]:
    """Find where a larger photo, brought to the grid by the two cameras, fits the grid's own best; grid pixels."""
    photos = large_photos(scene, scale)
    image = cv2.GaussianBlur(photos.image(1), (0, 0), 0.35 * scale)
    to_large = photos.Ks[1] @ np.linalg.inv(scene.cameras.Ks[1])
    to_large[:2, 2] += 0.5 * np.diag(to_large)[:2] - 0.5  # OpenCV has the top-left pixel's centre at (0, 0)

    def fits(x: float, y: float) -> float:
        moved = to_large.copy()
        moved[:2, 2] += scale * np.array([x, y])
        small = cv2.warpAffine(
            image, moved[:2], (scene.cameras.width, scene.cameras.height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        )
        return psnr(small[3:-3, 3:-3], scene.images[1, 3:-3, 3:-3])  # type: ignore[index]

    offsets = [(x, y) for x in (-0.25, 0.0, 0.25) for y in (-0.25, 0.0, 0.25)]
    return max(offsets, key=lambda offset: fits(*offset))


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.5, 3])
def test_larger_photos_show_what_the_grid_shows(scale: float) -> None:
    scene = gsmerge.read_scene(made_once())
    assert scene.has_own_pixels
    assert largest_scale(scene) == pytest.approx(SCALE)
    assert shift_between(scene, scale) == (0, 0)


def test_photos_of_the_grids_size_are_not_large(folder: Path) -> None:
    for path in (folder / "images").iterdir():
        image = cv2.imread(str(path))
        cv2.imwrite(str(path), cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA))
    assert gsmerge.read_scene(folder).large_photos is None


def test_views_of_an_unaligned_scene_are_reduced_but_not_their_photos(folder: Path) -> None:
    change_cameras(folder, enlarge)
    scene = gsmerge.read_scene(folder, order="none", max_side=WIDTH)
    assert not scene.has_own_pixels
    assert (scene.cameras.width, largest_scale(scene)) == (WIDTH, pytest.approx(SCALE))
    np.testing.assert_allclose(scene.large_photos.Ks, scene.cameras.Ks * [[SCALE], [SCALE], [1]])


def test_large_photos_inside_an_npz_are_read(folder: Path) -> None:
    scene = gsmerge.read_scene(folder)
    photos = np.stack([scene.large_photos.read(view) for view in range(len(scene))])
    camera_file = gsmerge.read_cameras(folder)
    shutil.rmtree(folder / "images")
    (folder / "transforms.json").unlink()
    extrinsics = camera_file.viewmats[:, :3]
    np.savez(folder / "results.npz", extrinsics=extrinsics, intrinsics=scene.cameras.Ks, image=photos)
    inside = gsmerge.read_scene(folder, order="none", max_side=WIDTH)
    if inside.large_photos is None:
        pytest.fail("expected the photos of the file")
    np.testing.assert_array_equal(inside.large_photos.read(1), photos[1])


def test_a_large_photo_that_is_gone_when_it_is_needed_is_refused(folder: Path) -> None:
    scene = gsmerge.read_scene(folder)
    (folder / "images" / "view_001.png").unlink()
    with refuses(SceneError, "view_001.png", "no such file"):
        large_photos(scene, 2)


SMOOTH = smooth_scene(24, 18)
LARGE = replace(
    SMOOTH,
    K=SMOOTH.K * np.array([[4.0], [4], [1]]),
    width=96,
    height=72,
    images=np.stack([cv2.resize(image, (96, 72), interpolation=cv2.INTER_CUBIC) for image in SMOOTH.images]),
)
NOTE = "views of 96 x 72 are resized to 48 x 36, since max_side allows 48 pixels per side"


def save(folder: Path, *, shuffled: bool = True, tiny: Tiny = LARGE) -> Path:
    order = np.random.default_rng(0).permutation(3 * 18 * 24)[:750] if shuffled else None
    return save_export(folder, tiny, export_rows(SMOOTH, order))


@pytest.mark.slow
@pytest.mark.parametrize("order", ["auto", "none"])
def test_views_of_unaligned_scenes_are_resized(tmp_path: Path, order: str) -> None:
    loaded = load_scene(save(tmp_path), order=order, max_side=48)
    scene = loaded.scene
    assert not scene.has_own_pixels
    assert NOTE in loaded.notes
    assert scene.images.shape == (3, 36, 48, 3)
    assert (scene.cameras.width, scene.cameras.height) == (48, 36)
    assert np.allclose(scene.cameras.Ks, SMOOTH.K * np.array([[2.0], [2], [1]]))
    small = np.stack([cv2.resize(image, (48, 36), interpolation=cv2.INTER_AREA) for image in LARGE.images])
    assert np.abs(scene.images * 255 - small).max() < 0.6


def test_cameras_of_unaligned_scenes_are_resized_without_photos(tmp_path: Path) -> None:
    folder = save(tmp_path)
    for path in (folder / "images").rglob("*.png"):
        path.unlink()
    loaded = load_scene(folder, max_side=48)
    assert loaded.scene.images is None
    assert (loaded.scene.cameras.width, loaded.scene.cameras.height) == (48, 36)
    assert NOTE in loaded.notes


def test_scenes_with_pixels_keep_their_grid(tmp_path: Path) -> None:
    loaded = load_scene(
        save(tmp_path, shuffled=False, tiny=replace(LARGE, K=SMOOTH.K, width=24, height=18)), max_side=16
    )
    assert loaded.scene.has_own_pixels
    assert loaded.scene.cameras.width == 24


def test_more_photos_than_fit_into_memory_are_resized_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """More photos than fit are resized first."""
    monkeypatch.setattr("gsmerge.reading.larger_photos._MAX_BYTES", 3 * 52 * 39 * 12)
    loaded = load_scene(save(tmp_path), max_side=48)
    assert NOTE in loaded.notes
    assert (loaded.scene.cameras.width, loaded.scene.cameras.height) == (48, 36)


def test_photos_that_may_be_the_grid_are_never_resized(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsmerge.reading.larger_photos._MAX_BYTES", 0)
    loaded = load_scene(save(tmp_path, shuffled=False, tiny=SMOOTH), max_side=16)
    assert loaded.scene.pixels.shown.all()
    assert loaded.notes == ()


@pytest.mark.parametrize("value", [0, 15, -3, 99.5, True, "many"])
def test_impossible_sides_of_views_are_refused(tmp_path: Path, value: object) -> None:
    with refuses(ValueError, "max_side", 16, value):
        load_scene(tmp_path, max_side=value)


WIDE, HIGH, CUT = 56, 40, 16


@pytest.fixture
def smooth() -> Smooth:
    return smooth_scene(WIDE, HIGH)


def save_shuffled(folder: Path, scene: Smooth) -> Path:
    """Write the scene with rows that are no pixels."""
    order = np.random.default_rng(0).permutation(len(scene.gaussians))
    return save_export(folder, scene, export_rows(scene, order))


def change_frames(folder: Path, size: tuple[int, int], views: list[int], resize: bool = False) -> None:
    """Crop the photos of some views at the right to a ``size``, or resize them; cameras keep their other numbers."""
    path = folder / "transforms.json"
    document = json.loads(path.read_text())
    for view, frame in enumerate(document["frames"]):
        sides = {key: frame.get(key, document.get(key)) for key in ("w", "h")}
        if view in views:
            photo = folder / frame["file_path"]
            image = cv2.imread(str(photo))
            cv2.imwrite(str(photo), cv2.resize(image, size) if resize else image[: size[1], : size[0]])
            sides = sides if resize else dict(zip("wh", size, strict=True))
        frame |= sides
    path.write_text(json.dumps(document))


def test_photos_of_two_shapes_are_extended_to_one(tmp_path: Path, smooth: Smooth) -> None:
    folder = save_shuffled(tmp_path / "scene", smooth)
    whole = load_scene(folder).scene
    change_frames(folder, (WIDE - CUT, HIGH), [1])
    load = load_scene(folder)
    assert len(load.scene) == 3
    assert noted(load.notes, f"photos of 2 shapes are extended to {WIDE} x {HIGH}")
    assert load.scene.masks[[0, 2]].all()
    assert load.scene.masks[1, :, : WIDE - CUT - 1].all()
    assert not load.scene.masks[1, :, WIDE - CUT + 1 :].any()
    assert (load.scene.importance[1, :, WIDE - CUT + 1 :] == 0).all()
    np.testing.assert_allclose(load.scene.cameras.Ks, whole.cameras.Ks)
    np.testing.assert_allclose(load.scene.images[1, :, : WIDE - CUT], whole.images[1, :, : WIDE - CUT], atol=1e-6)


def test_masks_of_photos_of_two_shapes_are_extended_with_them(tmp_path: Path, smooth: Smooth) -> None:
    folder = save_shuffled(tmp_path / "scene", smooth)
    change_frames(folder, (WIDE - CUT, HIGH), [1])
    mask = np.full((HIGH, WIDE - CUT), 255, np.uint8)
    mask[:10] = 0
    path = folder / "masks" / smooth.names[1]
    path.parent.mkdir(parents=True)
    cv2.imwrite(str(path), mask)
    masks = load_scene(folder).scene.masks
    assert not masks[1, :9].any()
    assert masks[1, 11:, : WIDE - CUT - 1].all()
    assert not masks[1, :, WIDE - CUT + 1 :].any()


@pytest.mark.parametrize("is_stated", [True, False])
def test_previews_take_nothing_from_the_grid_of_the_rows(tmp_path: Path, smooth: Smooth, is_stated: bool) -> None:
    """Whether cameras state the size of the grid, or that of the photos."""
    folder = save_export(tmp_path / "scene", smooth, export_rows(smooth))
    small = WIDE // 4, HIGH // 4
    change_frames(folder, small, [0, 1, 2], resize=True)
    if not is_stated:
        path = folder / "transforms.json"
        document = json.loads(path.read_text())
        for place in (document, *document["frames"]):
            place |= {key: value / 4 for key, value in place.items() if key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
        path.write_text(json.dumps(document))
    load = load_scene(folder)
    assert load.scene.has_own_pixels
    assert (load.scene.cameras.width, load.scene.cameras.height) == (WIDE, HIGH)
    assert load.scene.images is None
    assert noted(load.notes, f"{small[0]} x {small[1]}", "so Gaussians keep their own colours")
