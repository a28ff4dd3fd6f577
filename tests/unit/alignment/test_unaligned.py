"""Rows without pixels in the frame of the first camera, with the cameras of the data set."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from exports import export_rows, save_export, smooth_scene, turned
from messages import refuses

from gsmerge.alignment import recovery
from gsmerge.errors import SceneError
from gsmerge.scene.read import load_scene

WIDTH, HEIGHT = 64, 48
SMOOTH = smooth_scene(WIDTH, HEIGHT)


def voxels(share: float = 0.6) -> np.ndarray:
    """Rows of a share of the Gaussians, in an order of space."""
    means = SMOOTH.gaussians.means
    chosen = np.random.default_rng(0).permutation(len(means))[: round(share * len(means))]
    return export_rows(SMOOTH, chosen[np.lexsort(means[chosen].round(1).T)])


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


def test_volsplat_with_the_cameras_of_its_data_set(tmp_path: Path) -> None:
    rows = turned(padded(voxels()), SMOOTH.w2c[0, :3, :3])
    loaded = load_scene(save_export(tmp_path, SMOOTH, rows))
    assert not loaded.scene.aligned
    assert "the cameras are rotated into the first camera, as the photos' colours show" in loaded.notes
    assert any("rows that only fill the file up are left out" in note for note in loaded.notes)
    viewmats = loaded.scene.cameras.viewmats
    assert np.allclose(viewmats[0, :3, :3], np.eye(3), atol=1e-6)
    assert np.allclose(viewmats[:, :3, 3], SMOOTH.w2c[:, :3, 3], atol=1e-6)


@pytest.mark.parametrize("scale", [0.2, 1.0, 3.0])
def test_voxels_in_the_first_camera_at_any_scale(tmp_path: Path, scale: float) -> None:
    first = SMOOTH.w2c[0]
    rows = turned(voxels(), first[:3, :3], scale=scale, shift=scale * first[:3, 3])
    rows["opacity"] = 1 / (1 + np.exp(-rows["opacity"]))
    loaded = load_scene(save_export(tmp_path, SMOOTH, rows))
    assert not loaded.scene.aligned
    assert any("moved into the first camera" in note for note in loaded.notes)
    assert np.allclose(loaded.scene.cameras.viewmats[0], np.eye(4), atol=1e-6)
    centres = (SMOOTH.c2w[:, :3, 3] - SMOOTH.c2w[0, :3, 3]) @ SMOOTH.c2w[0, :3, :3]
    assert np.allclose(loaded.scene.cameras.centres, scale * centres, atol=0.03 * scale)


def test_cameras_that_fit_stay_in_their_frame(tmp_path: Path) -> None:
    loaded = load_scene(save_export(tmp_path, SMOOTH, voxels()))
    assert np.allclose(loaded.scene.cameras.viewmats, SMOOTH.w2c)
    assert loaded.notes == ("the rows belong to no pixels that could be found: unaligned",)


def test_without_photos_no_other_frame_is_tried(tmp_path: Path) -> None:
    rows = turned(voxels(), np.diag([-1.0, 1, -1]))
    folder = save_export(tmp_path, SMOOTH, rows)
    for photo in (folder / "images").rglob("*.png"):
        photo.unlink()
    with refuses(SceneError, "scene.ply", 9216, "cameras"):
        load_scene(folder)


def test_no_frame_is_solved_for_rows_that_no_camera_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The number of VolSplat's rows allows many grids; none of them is worth a search."""
    efforts = []
    usual = recovery.candidate_similarities

    def count(*args: object, effort: int = 2, **options: object) -> object:
        efforts.append(effort)
        return usual(*args, effort=effort, **options)

    monkeypatch.setattr(recovery, "candidate_similarities", count)
    load_scene(save_export(tmp_path, SMOOTH, turned(padded(voxels()), SMOOTH.w2c[0, :3, :3])))
    assert set(efforts) == {0}
