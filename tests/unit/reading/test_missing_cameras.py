"""Rows of more views than the file has cameras give the poses of all views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import export_rows, save_export, smooth_scene
from messages import names, noted
from sweeps import sweep
from tiny_scene import Tiny, rotation, write_colmap_binary, write_images, write_transforms

from gsmerge.reading.read_scene import Loaded, load_scene

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


@sweep("views", [[0], [2], [0, 1], [0, 2]], often=2)
@sweep("kind", [(False, write_colmap_binary), (True, write_colmap_binary), (False, write_transforms)], often=1)
@pytest.mark.parametrize("index", [ALL, np.setdiff1d(ALL, FAR)], ids=["all rows", "far rows dropped"])
def test_views_without_a_camera_get_poses_and_photos(
    tmp_path: Path, views: list[int], kind: tuple[bool, Callable[..., object]], index: np.ndarray
) -> None:
    moved, write = kind
    loaded = read_with(tmp_path, registered(views, moved=moved), write, SMOOTH, index)
    scene, missing = loaded.scene, [name for view, name in enumerate(SMOOTH.names) if view not in views]
    assert np.allclose(scene.cameras.centres, SMOOTH.c2w[:, :3, 3], atol=0.03)
    assert len(scene.photo_views) == 3
    assert not loaded.doubts
    (note,) = [note for note in loaded.notes if "camera" in note]
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
