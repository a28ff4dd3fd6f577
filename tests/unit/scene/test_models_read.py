"""Files as models leave them that are hard to read: a wrong frame, no cameras, photos of any size, no Gaussians."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from messages import noted, refuses
from model_files import MODELS
from model_rows import Export, check_cameras, check_pixels

from gsmerge.errors import SceneError
from gsmerge.scene.read import Loaded, load_scene

DA3 = "Depth Anything 3"


def load(name: str, folder: Path) -> tuple[Loaded, Export]:
    export = MODELS[name](folder / "out")
    return load_scene(export.path, **export.options), export


@pytest.mark.parametrize(
    "name",
    [
        "ZPressor",  # a border of 4 pixels is no resize
        "MVSplat's script with its far cut",  # dropped rows do not move the frame
        # photos of twice the model's size, and where it takes squares cropped to one
        *(f"{model} with the user's own photos" for model in ("NoPoSplat", "Splatt3R", "YoNoSplat")),
        "SPFSplat",  # inputs under names of the scene, and drawings of its own that are no photos of these views
        "Lyra 2",
    ],
)
def test_every_row_is_at_its_pixel(tmp_path: Path, name: str) -> None:
    loaded, export = load(name, tmp_path)
    check_cameras(loaded.scene, export)
    check_pixels(loaded.pixel_scene(), export, quats="YoNoSplat" not in name)


@pytest.mark.parametrize(
    "name",
    [
        "FreeSplat",  # stretches of rows show the upright frame, which colours alone would choose wrongly
        "WorldMirror 1",  # squeezed photos beside the right ones
        "gsplat's trainer",
    ],
)
def test_cameras_and_photos_of_rows_of_no_pixels(tmp_path: Path, name: str) -> None:
    loaded, export = load(name, tmp_path)
    assert not loaded.scene.has_own_pixels
    check_cameras(loaded.scene, export)
    assert ("gsplat" in name) == ("gsplat" in {exporter.name for exporter in loaded.exporters})


# Cameras from the rows


@pytest.mark.parametrize("name", ["DepthSplat, the .ply alone", "Flash3D without cameras"])
def test_cameras_of_a_grid_without_photos(tmp_path: Path, name: str) -> None:
    """Where no photo shows that a border was cut off, the rows are every pixel of a smaller grid."""
    loaded, export = load(name, tmp_path)
    ranks = np.unique(export.pixels, return_inverse=True)[1].reshape(-1)
    check_pixels(loaded.pixel_scene(), replace(export, pixels=ranks))
    assert loaded.alignment is not None
    assert loaded.alignment.worst_px < 0.5


def test_photos_whose_cameras_cannot_be_found(tmp_path: Path) -> None:
    """Voxels and no cameras: the scene is that of the rows alone, and a note names the photos."""
    loaded, _ = load("VolSplat without cameras", tmp_path)
    alone = load_scene(shutil.copy(loaded.files.ply, tmp_path / "alone.ply"))
    np.testing.assert_array_equal(loaded.scene.gaussians.means, alone.scene.gaussians.means)
    assert sum(noted([text], "images", "not used", "no cameras") for text in loaded.notes) == 1


# Folders


@pytest.mark.parametrize(
    ("name", "place", "said"),
    [
        (f"{DA3}, scene.glb", "scene.glb", ("npz-gs_ply",)),
        ("MapAnything", "out", ("MapAnything", "predictions.npz")),
        ("VGGT", "out", ("VGGT", "predictions.npz")),
    ],
)
def test_folders_without_gaussians(tmp_path: Path, name: str, place: str, said: tuple[str, ...]) -> None:
    with refuses(SceneError, place, *said):
        load(name, tmp_path)


@pytest.mark.parametrize("name", [f"{DA3}, npz", f"{DA3}, results.npz"])
def test_depth_maps_without_gaussians(tmp_path: Path, name: str) -> None:
    loaded = load_scene(MODELS[name](tmp_path / "out").path)
    assert loaded.scene.has_own_pixels
    assert loaded.scene.images is not None
    assert loaded.info.layout.startswith("depth maps")


# Nothing but Gaussians


@pytest.mark.parametrize("name", ["AnySplat", "LGM", "ZipSplat", "Splatter Image"])
def test_scenes_without_cameras_are_read_without_a_hint(tmp_path: Path, name: str) -> None:
    """Every row is there; of those that show their cameras nearly every one."""
    export = MODELS[name](tmp_path / "out")
    loaded = load_scene(export.path)
    g, means = loaded.scene.gaussians, np.stack([export.rows[axis] for axis in "xyz"], 1)
    assert len(g) >= 0.999 * (export.opacities >= 1 / 255).sum()
    assert np.isin(g.means[:, 0], means[:, 0]).all()
    assert loaded.scene.has_own_pixels or np.array_equal(g.means, means)
