"""Cameras that no file has follow from rows that are a grid, of some views or of all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import Smooth, export_rows, save_export, smooth_scene, with_intrinsics
from messages import names, noted
from sweeps import sweep
from tiny_scene import Tiny, rotation, write_colmap_binary, write_images, write_transforms

from gsmerge.reading.read_scene import Loaded, load_scene

WIDTH, HEIGHT = 96, 64
K = np.array([[110.0, 0, 48], [0, 110, 32], [0, 0, 1]])


def made(K: np.ndarray = K, width: int = WIDTH, height: int = HEIGHT) -> Smooth:
    return with_intrinsics(smooth_scene(width, height), K)


def read_bare(folder: Path, tiny: Smooth, index: np.ndarray) -> Loaded:
    """Write rows of a scene alone, and read them."""
    return load_scene(save_export(folder, tiny, export_rows(tiny, index.reshape(-1)), cameras=False) / "scene.ply")


ORDERS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "view-major": lambda ids: ids,
    "view-fastest": lambda ids: ids.transpose(1, 2, 0),
    "trimmed": lambda ids: ids[:, 5:-5, 5:-5],
    "trimmed, view-fastest": lambda ids: ids[:, 8:-8, 8:-8].transpose(1, 2, 0),
    "one view": lambda ids: ids[1:2],
}


@sweep("order", ORDERS, often=2)
@sweep("size", [(96, 64), (64, 64), (64, 96)])
def test_rows_of_a_grid_give_its_views_and_focal_length(tmp_path: Path, order: str, size: tuple[int, int]) -> None:
    width, height = size
    tiny = made(np.array([[110.0, 0, width / 2], [0, 110, height / 2], [0, 0, 1]]), *size)
    ids = np.arange(3 * width * height).reshape(3, height, width)
    kept = ORDERS[order](ids)
    loaded = read_bare(tmp_path, tiny, kept)
    scene = loaded.scene
    trim = 5 if order == "trimmed" else 8 if order.startswith("trimmed") else 0
    views = [1] if order == "one view" else [0, 1, 2]
    assert (scene.cameras.width, scene.cameras.height) == (width - 2 * trim, height - 2 * trim)
    assert np.allclose(scene.cameras.centres, tiny.c2w[views, :3, 3], atol=0.02)
    assert np.allclose(scene.cameras.Ks[:, (0, 1), (0, 1)], 110, rtol=0.01)
    home = tiny.gaussians[ids[views, trim : height - trim, trim : width - trim].reshape(-1)]
    assert np.array_equal(scene.gaussians.means, home.means)
    assert scene.names == tuple(f"view {view}" for view in range(len(views)))
    assert loaded.cameras.source == "estimated from the grid"
    assert noted(loaded.notes, "no", "cameras", "grid")


@pytest.mark.parametrize("changed", [(110, 110, 51.5, 30), (120, 100, 48, 32)])
def test_intrinsics_as_complex_as_the_rows_show(tmp_path: Path, changed: tuple[float, ...]) -> None:
    fx, fy, cx, cy = changed
    tiny = made(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    loaded = read_bare(tmp_path, tiny, np.arange(len(tiny.gaussians)))
    Ks = loaded.scene.cameras.Ks
    assert np.allclose(Ks[:, (0, 1, 0, 1), (0, 1, 2, 2)], changed, atol=0.6)
    assert (Ks == Ks[0]).all()


def test_focal_lengths_of_the_views_differ(tmp_path: Path) -> None:
    tiny = made()
    longer = K.copy()
    longer[(0, 1), (0, 1)] = 130
    means = tiny.gaussians.means.copy()
    means[: WIDTH * HEIGHT] = made(longer).gaussians.means[: WIDTH * HEIGHT]
    tiny = replace(tiny, gaussians=replace(tiny.gaussians, means=means))
    loaded = read_bare(tmp_path, tiny, np.arange(len(means)))
    assert np.allclose(loaded.scene.cameras.Ks[:, 0, 0], [130, 110, 110], rtol=0.01)
    assert noted(loaded.notes, "focal", "differ")


def test_focal_length_is_found_beside_rows_of_nan(tmp_path: Path) -> None:
    tiny = made()
    means = tiny.gaussians.means.copy()
    means[np.random.default_rng(0).random(len(means)) < 0.1] = np.nan
    loaded = read_bare(tmp_path, replace(tiny, gaussians=replace(tiny.gaussians, means=means)), np.arange(len(means)))
    assert np.allclose(loaded.scene.cameras.Ks[:, 0, 0], 110, rtol=0.01)


def test_rows_in_no_grid_have_no_views(tmp_path: Path) -> None:
    tiny, rng = made(), np.random.default_rng(0)
    count = len(tiny.gaussians)
    others = {"shuffled": rng.permutation(count), "sorted": np.lexsort(tiny.gaussians.means.T)}
    for name, index in others.items():
        loaded = read_bare(tmp_path / name, tiny, index)
        assert len(loaded.scene) == 0
        assert not loaded.scene.has_own_pixels


def test_a_wall_in_front_of_the_camera_has_no_focal_length(tmp_path: Path) -> None:
    tiny, rng = made(), np.random.default_rng(0)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + rng.uniform(-0.2, 0.2, (2, HEIGHT, WIDTH))
    wall = np.stack([x / 30, y / 30, np.full_like(x, 3)], -1).reshape(-1, 3).astype(np.float32)
    tiny = replace(tiny, gaussians=replace(tiny.gaussians[np.arange(len(wall))], means=wall))
    assert len(read_bare(tmp_path, tiny, np.arange(len(wall))).scene) == 0


def write_photos(folder: Path, tiny: Smooth, larger: int, margin: int, names: str = "{}.png") -> None:
    """Write photos that a model would have shrunk ``larger`` times, and cropped by ``margin`` columns of the result."""
    folder.mkdir()
    for i, image in enumerate(tiny.images):
        wide = cv2.copyMakeBorder(image, 0, 0, margin, margin, cv2.BORDER_REFLECT)
        size = larger * wide.shape[1], larger * wide.shape[0]
        whole = cv2.resize(wide, size, interpolation=cv2.INTER_LINEAR)
        cv2.imwrite(str(folder / names.format(i)), whole[..., ::-1])


@sweep(("larger", "margin", "trim"), [(3, 0, 0), (1, 0, 0), (3, 10, 0), (3, 0, 8), (3, 10, 8)], often=2)
def test_photos_of_any_size_are_those_of_the_grid(tmp_path: Path, larger: int, margin: int, trim: int) -> None:
    tiny = made()
    ids = np.arange(3 * WIDTH * HEIGHT).reshape(3, HEIGHT, WIDTH)[:, trim : HEIGHT - trim, trim : WIDTH - trim]
    write_photos(tmp_path / "images", tiny, larger, margin)
    scene = read_bare(tmp_path, tiny, ids).scene
    assert scene.images.shape == tiny.images.shape
    assert np.abs(scene.images * 255.0 - tiny.images).mean() < 2
    assert int(scene.pixels.shown.sum()) == ids.size
    assert scene.names == ("0.png", "1.png", "2.png")
    assert (scene.large_photos is not None) == (larger > 1)


def test_photos_of_another_shape_are_noted(tmp_path: Path) -> None:
    """Rows without every third pixel look like a narrower grid; larger photos do not show which size they had."""
    tiny = made()
    ids = np.arange(3 * WIDTH * HEIGHT)
    write_photos(tmp_path / "images", tiny, 3, 0)
    assert noted(read_bare(tmp_path, tiny, ids[ids % 3 != 1]).notes, "288 x 192", "64 x 64", "--cameras")


def test_photos_are_told_by_their_colors(tmp_path: Path) -> None:
    tiny = made()
    write_photos(tmp_path / "images", tiny, 2, 10)
    noise = np.random.default_rng(0).integers(0, 256, (2 * HEIGHT, 2 * (WIDTH + 20), 3), np.uint8)
    cv2.imwrite(str(tmp_path / "images" / "00.png"), cv2.GaussianBlur(noise, (0, 0), 9))
    scene = read_bare(tmp_path, tiny, np.arange(len(tiny.gaussians))).scene
    assert scene.names == ("0.png", "1.png", "2.png")


def test_photos_of_another_scene_are_not_used(tmp_path: Path) -> None:
    tiny = made()
    (tmp_path / "images").mkdir()
    for i, image in enumerate(np.random.default_rng(0).integers(0, 256, (3, 90, 120, 3), np.uint8)):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), image)
    loaded = read_bare(tmp_path, tiny, np.arange(len(tiny.gaussians)))
    assert loaded.scene.has_own_pixels
    assert loaded.scene.images is None
    assert noted(loaded.notes, "images", "left out", f"3 views of {WIDTH} x {HEIGHT}")


@pytest.mark.slow
def test_other_pictures_beside_the_file_are_no_photos(tmp_path: Path) -> None:
    tiny = made()
    for i in range(2):
        cv2.imwrite(str(tmp_path / f"chart{i}.png"), np.random.default_rng(i).integers(0, 256, (90, 120, 3), np.uint8))
    scene = read_bare(tmp_path, tiny, np.arange(len(tiny.gaussians))).scene
    assert scene.has_own_pixels
    assert scene.images is None
    write_photos(tmp_path / "photos", tiny, 2, 0, "view{}.png")
    for path in (tmp_path / "photos").iterdir():
        path.rename(tmp_path / path.name)
    scene = load_scene(tmp_path / "scene.ply").scene
    assert scene.names == ("view0.png", "view1.png", "view2.png")
    assert scene.images is not None


SMOOTH = smooth_scene(96, 64)
ALL = np.arange(len(SMOOTH.gaussians))
FAR = np.argsort(-SMOOTH.gaussians.means[:, 2], kind="stable")[: len(ALL) // 12]


def registered(views: list[int], *, moved: bool = False) -> Tiny:
    """Return some of the cameras, as they are or in a world of another frame and scale."""
    c2w = SMOOTH.c2w[views].copy()
    if moved:
        turn = rotation(0.4, -0.8, 0.3)
        c2w[:, :3, :3] = turn @ c2w[:, :3, :3]
        c2w[:, :3, 3] = 3 * c2w[:, :3, 3] @ turn.T + (5, 1, -2)
    return replace(SMOOTH, c2w=c2w, images=SMOOTH.images[views], names=tuple(SMOOTH.names[view] for view in views))


def read_with(
    folder: Path, cameras: Tiny, write: Callable[..., object], photos: Tiny | None, index: np.ndarray
) -> Loaded:
    """Read rows beside some cameras and photos."""
    save_export(folder, SMOOTH, export_rows(SMOOTH, index), cameras=False)
    place = folder / ("sparse/0" if write is write_colmap_binary else "transforms.json")
    place.parent.mkdir(parents=True, exist_ok=True)
    write(place, cameras)
    if photos is not None:
        write_images(folder / "images", photos)
    return load_scene(folder)


KINDS = [(False, write_colmap_binary), (True, write_colmap_binary), (False, write_transforms)]
# Rows, what gives poses of some views, and of which; rows of which some are missing, which is harder, have all of these
KNOWN = [
    *product([np.setdiff1d(ALL, FAR)], KINDS, [[0], [2], [0, 1], [0, 2]]),
    *product([ALL], KINDS[:1], [[0], [2], [0, 1], [0, 2]]),
]


@sweep(
    ("index", "kind", "views"),
    KNOWN,
    ids=[
        f"{'all rows' if index is ALL else 'far rows dropped'}-{write.__name__}{' moved' * moved}-{views}"
        for index, (moved, write), views in KNOWN
    ],
    often=2,
)
def test_views_without_a_camera_get_poses_and_photos(
    tmp_path: Path, index: np.ndarray, kind: tuple[bool, Callable[..., object]], views: list[int]
) -> None:
    moved, write = kind
    loaded = read_with(tmp_path, registered(views, moved=moved), write, SMOOTH, index)
    scene, missing = loaded.scene, [name for view, name in enumerate(SMOOTH.names) if view not in views]
    assert np.allclose(scene.cameras.centres, SMOOTH.c2w[:, :3, 3], atol=0.03)
    assert len(scene.photo_views) == 3
    assert not loaded.doubts
    (note,) = [note for note in loaded.notes if "camera" in note and "depth maps" not in note]
    assert names(note, f"{len(missing)} of 3", str(tmp_path), *missing)


@pytest.mark.parametrize("photos", [[0], []])
def test_views_without_a_camera_may_lack_photos_too(tmp_path: Path, photos: list[int]) -> None:
    loaded = read_with(tmp_path, registered([0]), write_transforms, registered(photos) if photos else None, ALL)
    assert len(loaded.scene) == 3
    assert len(loaded.scene.photo_views) == len(photos)
    assert noted(loaded.notes, "2 of 3", "transforms.json", *(["view 1", "view 2"] if photos else []))


def test_cameras_of_another_scene_are_left_out(tmp_path: Path) -> None:
    """They have fewer views than the grid, but nothing shows that the grid is theirs."""
    other = registered([0])
    other.c2w[:, :3, 3] += 50
    loaded = read_with(tmp_path, other, write_transforms, None, ALL)
    assert names(str(loaded.doubts), "transforms.json", "left out")
    assert len(loaded.scene) == 3


@pytest.mark.parametrize("views", [[0, 1], [0, 1, 2]])
def test_photos_without_a_camera_are_named_for_rows_without_pixels(tmp_path: Path, views: list[int]) -> None:
    index = np.random.default_rng(0).permutation(ALL)[:4027]
    loaded = read_with(tmp_path, registered(views), write_transforms, SMOOTH, index)
    spare = [name.rpartition("/")[2] for view, name in enumerate(SMOOTH.names) if view not in views]
    assert not loaded.scene.has_own_pixels
    assert noted(loaded.notes, f"{len(spare)} of 3 photos", "no camera", *spare) == bool(spare)


@pytest.mark.parametrize("lost", ["cut", "no numbers", "half", "nothing"])
@pytest.mark.parametrize("photos", [[0, 1, 2], [0, 1]], ids=["photos", "no photo of the last view"])
def test_views_without_any_row_are_doubted(tmp_path: Path, lost: str, photos: list[int]) -> None:
    """Once: a view without a photo is named already."""
    last = ALL[2 * len(ALL) // 3 :]
    rows = export_rows(SMOOTH, np.setdiff1d(ALL, {"cut": last, "half": last[::2]}.get(lost, last[:0])))
    if lost == "no numbers":
        rows["x"][last] = np.nan
    folder = save_export(tmp_path, SMOOTH, rows, cameras=False)
    write_transforms(folder / "transforms.json", SMOOTH)
    write_images(folder / "images", registered(photos))
    doubts = [doubt for doubt in load_scene(folder).doubts if SMOOTH.names[2] in doubt]
    is_bare = lost in ("cut", "no numbers") and len(photos) == 3
    assert [doubt.split(":")[0] for doubt in doubts if "photos" not in doubt] == [
        "1 of 3 views has no Gaussians"
    ] * is_bare
    assert len(doubts) == (is_bare or len(photos) < 3)
