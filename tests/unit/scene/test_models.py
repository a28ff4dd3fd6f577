"""Files as models leave them, by what is beside them: read right, or refused with what to do."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from messages import noted
from model_files import MODELS
from model_rows import check_cameras, check_pixels
from sweeps import sweep

from gsmerge.io import read_ply
from gsmerge.scene.exporters import EXPORTERS, find_cameras_of_model
from gsmerge.scene.read import load_scene

DA3 = "Depth Anything 3"
PER_PIXEL = {  # and the exporters that may have written each
    "Flash3D": ("flash3d",),
    "Long-LRM": ("longlrm",),
    f"{DA3}, npz-gs_ply": ("da3",),
    f"{DA3}, mini_npz-gs_ply": ("da3",),
    f"{DA3}, glb-npz-gs_ply": ("da3",),
    f"{DA3}, colmap-npz-gs_ply": ("da3",),
    f"{DA3}, colmap-gs_ply": ("da3",),
    f"{DA3}, gs_ply": ("da3",),
    "DepthSplat": ("depthsplat",),
    "DepthSplat without cameras": ("depthsplat",),
    "MVSplat's script": ("mvsplat", "spfsplat"),
    "pixelSplat": ("pixelsplat",),
    "pixelSplat's script": ("pixelsplat-script",),
    "NoPoSplat": ("noposplat",),
    "Splatt3R": ("splatt3r",),
    "YoNoSplat": ("yonosplat",),
    "ReSplat": ("resplat",),
    "GS-LRM": ("lgm",),
    "GRM": ("lgm",),
    "FlashWorld": ("lgm",),
    "SHARP": ("sharp",),
}
# Their cameras differ by a few degrees: too little to show that rotations are those to the cameras
CAMERA_FRAME = ("pixelSplat", "pixelSplat's script", "YoNoSplat", "ReSplat")
UNALIGNED = {
    "VicaSplat": ("vicasplat",),
    "VolSplat": ("volsplat",),
    "Long-LRM, sorted": ("longlrm-sorted",),
    "WorldMirror 2": ("worldmirror",),
    "ffgs": ("ffgs",),
    "INRIA 3DGS": ("inria",),
    "InstantSplat": ("inria",),
    "nerfstudio": ("nerfstudio",),
}


@sweep("name", PER_PIXEL, often=8)
def test_every_row_is_at_its_pixel(tmp_path: Path, name: str) -> None:
    export = MODELS[name](tmp_path / "out")
    loaded = load_scene(export.path, **export.options)
    check_pixels(loaded.pixel_scene(), export, quats=name not in CAMERA_FRAME)
    check_cameras(loaded.scene, export)
    assert set(PER_PIXEL[name]) <= {exporter.name for exporter in loaded.exporters}


@pytest.mark.parametrize("name", CAMERA_FRAME)
def test_rotations_in_the_cameras_frames(tmp_path: Path, name: str) -> None:
    """The world is turned, and rotations with it as if they were those of the world."""
    export = MODELS[name](tmp_path / "out")
    loaded = load_scene(export.path, **export.options, quats="camera")
    check_pixels(loaded.pixel_scene(), export)
    assert set(PER_PIXEL[name]) <= {exporter.name for exporter in loaded.exporters}


@sweep("name", UNALIGNED, often=2)
def test_rows_of_no_pixels_have_the_cameras_and_photos_of_their_views(tmp_path: Path, name: str) -> None:
    """Takes over a second where many grids have as many pixels, as each is tried."""
    export = MODELS[name](tmp_path / "out")
    loaded = load_scene(export.path, **export.options)
    assert not loaded.scene.has_own_pixels
    check_cameras(loaded.scene, export)
    assert set(UNALIGNED[name]) <= {exporter.name for exporter in loaded.exporters}
    means = np.stack([export.rows[axis] for axis in "xyz"], 1)
    padding = (means == 0).all(1) if name == "VolSplat" else np.zeros(len(means), bool)
    assert np.array_equal(loaded.scene.gaussians.means, means[~padding])
    assert np.abs(loaded.scene.gaussians.opacities - export.opacities[~padding]).max() < 1e-5


def test_made_files_are_of_models_in_the_table() -> None:
    titles = tuple(model.title for exporter in EXPORTERS.values() for model in exporter.models)
    assert len(set(titles)) == len(titles)
    assert {name for name in MODELS if not name.startswith(titles)} == {"MapAnything", "VGGT"}  # of points


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (f"{DA3}, gs_ply", (f"{DA3}:", 'export_format="npz-gs_ply"')),
        ("Lyra 2", ("Lyra 2:", "cameras.npz")),
        ("INRIA 3DGS", ("INRIA 3DGS or InstantSplat:", "cameras.json")),
        ("nerfstudio", ("nerfstudio:", "transforms.json")),
        ("gsplat's trainer", ("gsplat:", "COLMAP")),
        ("Long-LRM", ("Long-LRM:", "data set's .json")),
        *((name, ()) for name in ("AnySplat", "pixelSplat", "WorldMirror 2")),
    ],
)
def test_what_brings_cameras_is_said_by_the_model(tmp_path: Path, name: str, said: tuple[str, ...]) -> None:
    """And of no model where the file may be that of several."""
    MODELS[name](tmp_path / "out")
    (path,) = (tmp_path / "out").rglob("*.ply")
    option = find_cameras_of_model(read_ply(path).info)
    assert all(part in option for part in said)
    assert bool(option) == bool(said)


def test_a_scene_without_cameras_says_what_brings_them(tmp_path: Path) -> None:
    MODELS["nerfstudio"](tmp_path / "out")
    shutil.copy(tmp_path / "out/splat.ply", tmp_path / "splat.ply")
    assert noted(load_scene(tmp_path / "splat.ply").notes, "nerfstudio:", "transforms.json", "--cameras")
