"""Rows without pixels may be in another frame than the cameras, which are moved there."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import Smooth, export_rows, save_export, smooth_scene, turned
from messages import names, noted, refuses
from model_rows import merge_voxels
from sweeps import sweep
from tiny_scene import make_tiny, write_images

from gsmerge.errors import SceneError
from gsmerge.method.geometry.transforms import Similarity
from gsmerge.method.kernels import elementary
from gsmerge.reading.alignment import unaligned
from gsmerge.reading.alignment.frames import axis_turns
from gsmerge.reading.read_scene import load_scene
from gsmerge.types import SH_C0, Cameras

WIDTH, HEIGHT = 56, 40
SMOOTH = smooth_scene(WIDTH, HEIGHT)


def voxel_rows() -> np.ndarray:
    """Return rows of merged Gaussians, a prime number, in an order of space."""
    return export_rows(replace(SMOOTH, gaussians=merge_voxels(SMOOTH, 0.07)), np.arange(4027))


def padded(rows: np.ndarray) -> np.ndarray:
    """As VolSplat writes them: filled up with equal rows, then every view and border cut as if they were pixels."""
    full = np.zeros(3 * WIDTH * HEIGHT, rows.dtype)
    full[: len(rows)] = rows
    for name in full.dtype.names:
        if name.startswith("f_dc"):
            full[name][len(rows) :] = 0.1
    for name in ("opacity", "scale_0", "scale_1", "scale_2"):
        full[name][len(rows) :] = -4.6
    full["rot_0"][len(rows) :] = 1
    grid = np.arange(len(full)).reshape(3, HEIGHT, WIDTH)[:, 8:-8, 8:-8]
    return full[grid.transpose(1, 2, 0).reshape(-1)]


def test_cameras_are_rotated_into_the_first_for_padded_rows_of_volsplat(tmp_path: Path) -> None:
    rows = turned(padded(voxel_rows()), SMOOTH.w2c[0, :3, :3])
    loaded = load_scene(save_export(tmp_path, SMOOTH, rows))
    assert not loaded.scene.has_own_pixels
    assert "the cameras are rotated into the first camera, as the photos' colours show" in loaded.notes
    assert any(" empty rows at the origin, set aside" in note for note in loaded.notes)
    viewmats = loaded.scene.cameras.viewmats
    assert np.allclose(viewmats[0, :3, :3], np.eye(3), atol=1e-6)
    assert np.allclose(viewmats[:, :3, 3], SMOOTH.w2c[:, :3, 3], atol=1e-6)


@pytest.mark.parametrize("axes", ["x, -z, y", "x, z, -y", "-y, -x, -z", "z, x, y", "y, x, -z"])
def test_cameras_are_turned_for_voxels_in_other_axes(tmp_path: Path, axes: str) -> None:
    """As Blender has z up, and nerfstudio swaps the axes of COLMAP and Metashape; the photos' colours decide."""
    turn = np.array([np.eye(3)["xyz".index(axis[-1])] * (-1 if "-" in axis else 1) for axis in axes.split(", ")])
    loaded = load_scene(save_export(tmp_path, SMOOTH, turned(voxel_rows(), turn)))
    assert f"the cameras are turned from axes x, y, z to {axes}, as the photos' colours show" in loaded.notes
    assert np.allclose(loaded.scene.cameras.viewmats[:, :3, :3], SMOOTH.w2c[:, :3, :3] @ turn.T, atol=1e-6)


def test_a_frame_of_keypoints_gives_way_to_a_turn_that_shows_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where no frame fits exactly, keypoints are matched, and errors of their frame stay out of the cameras."""
    turn = np.eye(3)[[2, 0, 1]]
    near = Similarity(turn, 1.002, np.zeros(3), "by keypoints")
    monkeypatch.setattr(unaligned, "find_frame", lambda inputs, measure, fits: (near, True))
    monkeypatch.setattr(unaligned, "_fits_exactly", lambda inputs, frame: False)
    loaded = load_scene(save_export(tmp_path, SMOOTH, turned(voxel_rows(), turn)))
    assert any("to z, x, y" in note for note in loaded.notes)


def test_axes_are_turned_in_all_ways() -> None:
    rotations = np.array([np.eye(3), *(turn.rotation for turn in axis_turns())])
    assert len(np.unique(rotations, axis=0)) == 24
    assert np.allclose(np.linalg.det(rotations), 1)


@sweep("scale", [0.2, 1.0, 3.0])
def test_cameras_are_moved_into_the_first_for_voxels_at_any_scale(tmp_path: Path, scale: float) -> None:
    first = SMOOTH.w2c[0]
    rows = turned(voxel_rows(), first[:3, :3], scale=scale, shift=scale * first[:3, 3])
    rows["opacity"] = 1 / (1 + elementary.exp(-rows["opacity"]))
    loaded = load_scene(save_export(tmp_path, SMOOTH, rows))
    assert not loaded.scene.has_own_pixels
    assert any("moved into the first camera" in note for note in loaded.notes)
    assert np.allclose(loaded.scene.cameras.viewmats[0], np.eye(4), atol=1e-6)
    centres = (SMOOTH.c2w[:, :3, 3] - SMOOTH.c2w[0, :3, 3]) @ SMOOTH.c2w[0, :3, :3]
    assert np.allclose(loaded.scene.cameras.centres, scale * centres, atol=0.03 * scale)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("turn", "scale"),
    [(np.eye(3), 39.37), (np.diag([1.0, -1, -1]), 0.01), (np.eye(3), 1000.0)],
    ids=["as it is-39.37", "y up-0.01", "as it is-1000.0"],
)
def test_the_scale_of_voxels_in_another_unit_is_found(
    tmp_path: Path, scale: float, turn: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four frames are searched at a hundred scales each, and no shift, because one of them fits exactly."""
    monkeypatch.setattr(unaligned, "_solve_shift", lambda inputs: pytest.fail("a shift is searched"))
    loaded = load_scene(save_export(tmp_path, SMOOTH, turned(voxel_rows(), turn, scale=scale)))
    (note,) = [note for note in loaded.notes if "scale" in note]
    solved = float(note.partition("--hint scene_scale=")[2].partition(")")[0])
    assert solved == pytest.approx(scale, rel=0.02)
    assert np.allclose(loaded.scene.cameras.centres, scale * SMOOTH.c2w[:, :3, 3] @ turn.T, atol=0.02 * scale)
    assert len(loaded.scene.photo_views) == 3
    hinted = load_scene(tmp_path, scene_scale=solved)
    assert np.allclose(hinted.scene.cameras.centres, loaded.scene.cameras.centres, atol=0.01 * scale)


OFFSET = np.array([448262.5, 4582120.25, 187.5])
OFFSET_FILES = {
    "none": None,
    "offset.txt": "448262.5 4582120.25 187.5\n",
    "shift.txt": "# of the cameras\n448262.5, 4582120.25, 187.5",
    "metadata.xml": "<M><SRS>EPSG:32631</SRS><SRSOrigin>448262.5,4582120.25,187.5</SRSOrigin></M>",
    "wrong.txt": "1 2 3\n",
}


def shifted(scene: Smooth, offset: np.ndarray) -> Smooth:
    c2w = scene.c2w.copy()
    c2w[:, :3, 3] += offset
    return replace(scene, c2w=c2w)


# Where places are tried, which takes seconds, each sign once
SEARCHED = [("none", 1), ("wrong.txt", -1)]
FOUND = [name for name in OFFSET_FILES if name not in dict(SEARCHED)]


@sweep(("name", "sign"), [*product(FOUND, (1,)), *product(FOUND, (-1,)), *SEARCHED], often=len(FOUND))
def test_an_offset_of_cameras_is_found_from_a_file_or_photos(tmp_path: Path, name: str, sign: int) -> None:
    """Without a right file, a thousand places are tried, which takes seconds."""
    text = OFFSET_FILES[name]
    if text is not None:
        (tmp_path / name).write_text(text)
    loaded = load_scene(save_export(tmp_path, shifted(SMOOTH, sign * OFFSET), voxel_rows()))
    is_exact = name not in ("none", "wrong.txt")
    assert np.allclose(loaded.scene.cameras.centres, SMOOTH.c2w[:, :3, 3], atol=1e-4 if is_exact else 0.03)
    assert noted(loaded.notes, "cameras are moved by", name if is_exact else "photos")
    assert len(loaded.scene.photo_views) == 3


def test_an_offset_of_cameras_without_photos_is_a_doubt(tmp_path: Path) -> None:
    folder = save_export(tmp_path, shifted(SMOOTH, OFFSET), voxel_rows())
    for photo in (folder / "images").rglob("*.png"):
        photo.unlink()
    assert names(str(load_scene(folder).doubts), "transforms.json", "0 %", "offset.txt")


def test_cameras_are_turned_for_voxels_with_y_up(tmp_path: Path) -> None:
    """As files are that were written in the axes of .spz, beside OpenCV cameras."""
    half = np.diag([1.0, -1, -1])
    loaded = load_scene(save_export(tmp_path, SMOOTH, turned(voxel_rows(), half)))
    assert any("turned to y up" in note for note in loaded.notes)
    assert np.allclose(loaded.scene.cameras.viewmats[:, :3, :3], SMOOTH.w2c[:, :3, :3] @ half, atol=1e-6)


def test_voxels_in_another_frame_without_photos_are_refused(tmp_path: Path) -> None:
    rows = turned(voxel_rows(), np.diag([-1.0, 1, -1]))
    folder = save_export(tmp_path, SMOOTH, rows)
    for photo in (folder / "images").rglob("*.png"):
        photo.unlink()
    with refuses(SceneError, "scene.ply", 6720, "cameras"):
        load_scene(folder, cameras=folder)


def test_a_frame_is_refused_where_photos_contradict_the_foremost_colours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever chooses a frame: where the photos are far from what they should show, it is refused."""
    wrong = Similarity(np.eye(3), 1.0, np.array([0.9, 0.4, 0.0]), "somewhere else")
    rows = voxel_rows()
    rows["x"] += np.random.default_rng(0).uniform(-0.05, 0.05, len(rows))  # a pixel to each side
    folder = save_export(tmp_path, SMOOTH, rows)
    monkeypatch.setattr(unaligned, "_choose_frame", lambda inputs, usual, stated: wrong)
    with refuses(SceneError, "scene.ply", "somewhere else", "colours", "--hint exporter"):
        load_scene(folder, cameras=folder)


def test_hidden_gaussians_do_not_count_in_the_foremost_colours() -> None:
    cameras = Cameras(np.eye(4)[None], np.array([[[50.0, 0, 50], [0, 50, 50], [0, 0, 1]]]), 100, 100)
    rng = np.random.default_rng(0)
    photo = rng.random((1, 10, 10, 3)).repeat(10, 1).repeat(10, 2).astype(np.float32)
    xy = rng.uniform(-1, 1, (4000, 2))
    places = np.floor(50 * xy + 50).astype(int)
    colors = photo[0, places[:, 1], places[:, 0]]
    front = np.concatenate([xy, np.ones((4000, 1))], 1)
    means = np.concatenate([front, 3 * front]).astype(np.float32)
    shown = (np.concatenate([colors, rng.random((4000, 3))]) - 0.5) / SH_C0
    tiny = make_tiny().gaussians[np.zeros(8000, int)]
    gaussians = replace(tiny, means=means, sh0=shown[:, None].astype(np.float32))
    every, foremost = (
        unaligned.check_cameras(gaussians, np.ones(8000, bool), cameras, photo, foremost=foremost).color_ratio
        for foremost in (False, True)
    )
    assert every > 0.4  # half of the Gaussians are hidden, and of random colours
    assert foremost < 0.1


def test_resized_photos_of_the_model_are_taken_where_they_fit(tmp_path: Path) -> None:
    """As WorldMirror leaves a portrait: whole photos squeezed to the shape of what was cut out of them."""
    folder = save_export(tmp_path, SMOOTH, voxel_rows())
    squeezed = [cv2.resize(np.pad(i, ((16, 16), (0, 0), (0, 0)), "reflect"), (WIDTH, HEIGHT)) for i in SMOOTH.images]
    write_images(folder / "images", replace(SMOOTH, images=np.stack(squeezed)))
    write_images(folder / "images_resized", SMOOTH)
    loaded = load_scene(folder)
    assert np.abs(loaded.scene.images - SMOOTH.images / 255).mean() < 0.01
    assert loaded.files.images.name == "images_resized"


def test_rows_that_are_all_padding_are_refused(tmp_path: Path) -> None:
    rows = np.repeat(voxel_rows()[:1], 100)
    for name in "xyz":
        rows[name] = 0
    folder = save_export(tmp_path, SMOOTH, rows)
    with refuses(SceneError, "scene.ply", 100, "origin"):
        load_scene(folder, cameras=folder)
