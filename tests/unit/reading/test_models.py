"""Files of models are read right by what is beside them, or refused with what to do."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from messages import names, noted, refuses
from model_files import MODELS
from model_rows import check_cameras, check_pixels
from sweeps import sweep

from gsmerge.errors import SceneError
from gsmerge.io import read_ply
from gsmerge.reading.exporters import EXPORTERS, find_cameras_of_model
from gsmerge.reading.read_scene import load_scene

DA3 = "Depth Anything 3"
PIXELS = (  # rows that are pixels in order
    *(
        f"{DA3}, {formats}"
        for formats in ("npz-gs_ply", "mini_npz-gs_ply", "colmap-npz-gs_ply", "colmap-gs_ply", "gs_ply")
    ),
    "Long-LRM",
    "DepthSplat",
    "DepthSplat without cameras",
    "ZPressor",
    "SPFSplat",  # inputs under names of the scene, and drawings of its own that are no photos of these views
    "NoPoSplat",
    "Splatt3R",
    "YoNoSplat",
    # photos of twice the model's size, and where it takes squares cropped to one
    *(f"{model} with the user's own photos" for model in ("NoPoSplat", "Splatt3R", "YoNoSplat")),
    "GS-LRM",
    "GRM",
    "FlashWorld",
    "Splatter Image",
)
SEEN = (  # rows that get cameras alone, or several Gaussians of a pixel
    "Lyra 2",
    "MVSplat's script",
    "MVSplat's script with its far cut",
    "pixelSplat",
    "pixelSplat's script",
    "FreeSplat",  # stretches of rows show the upright frame, which colours alone would choose wrongly
    "ReSplat",
    "Flash3D",
    "SHARP",
    "VolSplat",
    "Long-LRM, sorted",
    "WorldMirror 1",  # squeezed photos beside the right ones
    "WorldMirror 2",
    "ffgs",
    "INRIA 3DGS",
    "InstantSplat",
    "nerfstudio",
    "gsplat's trainer",
)
MARKED = {"Long-LRM": "longlrm", "SHARP": "sharp", "nerfstudio": "nerfstudio", "ffgs": "ffgs", "INRIA 3DGS": "inria"}


@sweep("name", (*PIXELS, *SEEN), often=8)
def test_files_of_a_model_give_cameras_and_photos_of_all_views(tmp_path: Path, name: str) -> None:
    """And every row is there, at its pixel if it has one."""
    export = MODELS[name](tmp_path / "out")
    loaded = load_scene(export.path, **export.options)
    check_cameras(loaded.scene, export)
    assert MARKED.get(name, "") in {"", *(exporter.name for exporter in loaded.exporters)}
    if name in PIXELS:
        check_pixels(loaded.scene, export)
        return
    means = np.stack([export.rows[axis] for axis in "xyz"], 1)
    is_there = (export.opacities >= 1 / 255) & ~((means == 0).all(1) & (name == "VolSplat"))
    assert loaded.scene.num_gaussians == is_there.sum()


@pytest.mark.parametrize(("formats", "is_lacking"), [("npz-gs_ply", False), ("colmap-gs_ply", True)])
def test_missing_depth_maps_of_depth_anything_are_noted(tmp_path: Path, formats: str, is_lacking: bool) -> None:
    export = MODELS[f"{DA3}, {formats}"](tmp_path / "out")
    notes = load_scene(export.path, **export.options).notes
    assert noted(notes, "guessed depths", "npz-gs_ply") == is_lacking


@pytest.mark.parametrize("name", ["DepthSplat, the .ply alone", "Flash3D without cameras"])
def test_rows_of_a_model_without_photos_are_every_pixel_of_a_smaller_grid(tmp_path: Path, name: str) -> None:
    """Where no photo shows that a border was cut off, the rows are every pixel of a smaller grid."""
    export = MODELS[name](tmp_path / "out")
    loaded = load_scene(export.path, **export.options)
    ranks = np.unique(export.pixels, return_inverse=True)[1].reshape(-1)
    check_pixels(loaded.scene, replace(export, pixels=ranks))
    assert loaded.alignment.worst_px < 0.5


def test_poses_without_a_focal_length_ask_for_it(tmp_path: Path) -> None:
    """As VicaSplat writes them; beside the file they are left out, and named they are refused."""
    export = MODELS["VicaSplat"](tmp_path / "out")
    assert names(str(load_scene(export.path).doubts), "transforms.json", "fx, fy, cx, cy", "add them")
    with refuses(SceneError, "transforms.json", "fx, fy, cx, cy", "add them"):
        load_scene(export.path, cameras=export.path / "transforms.json")


def test_photos_whose_cameras_cannot_be_found_are_noted_as_not_used(tmp_path: Path) -> None:
    """Voxels and no cameras: the scene is that of the rows alone, and a note names the photos."""
    export = MODELS["VolSplat without cameras"](tmp_path / "out")
    loaded = load_scene(export.path, **export.options)
    alone = load_scene(shutil.copy(loaded.files.ply, tmp_path / "alone.ply"))
    np.testing.assert_array_equal(loaded.scene.gaussians.means, alone.scene.gaussians.means)
    assert sum(noted([text], "images", "not used", "no cameras") for text in loaded.notes) == 1


@pytest.mark.parametrize(
    ("name", "place", "said"),
    [
        *((f"{DA3}, {name}", place, "npz-gs_ply") for name, place in
          (("scene.glb", "scene.glb"), ("npz", "out"), ("results.npz", "results.npz"))),
        ("MapAnything", "out", "--cameras"),
        ("VGGT", "out", "--cameras"),
    ],
)  # fmt: skip
def test_outputs_without_gaussians_are_refused_with_what_to_do(
    tmp_path: Path, name: str, place: str, said: str
) -> None:
    export = MODELS[name](tmp_path / "out")
    with refuses(SceneError, place, said):
        load_scene(export.path, **export.options)


@pytest.mark.parametrize("name", ["AnySplat", "LGM", "ZipSplat", "Splatter Image"])
def test_scenes_without_cameras_are_read_without_a_hint(tmp_path: Path, name: str) -> None:
    """Every row is there; of those that show their cameras nearly every one."""
    export = MODELS[name](tmp_path / "out")
    loaded = load_scene(export.path)
    g, means = loaded.scene.gaussians, np.stack([export.rows[axis] for axis in "xyz"], 1)
    assert len(g) >= 0.999 * (export.opacities >= 1 / 255).sum()
    assert np.isin(g.means[:, 0], means[:, 0]).all()
    assert loaded.scene.has_own_pixels or np.array_equal(g.means, means)


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
def test_options_that_bring_cameras_are_named_for_the_model(tmp_path: Path, name: str, said: tuple[str, ...]) -> None:
    """And of no model where the file may be that of several."""
    MODELS[name](tmp_path / "out")
    (path,) = (tmp_path / "out").rglob("*.ply")
    option = find_cameras_of_model(read_ply(path).info)
    assert all(part in option for part in said)
    assert bool(option) == bool(said)


@pytest.mark.slow
def test_a_scene_without_cameras_says_what_brings_them(tmp_path: Path) -> None:
    MODELS["nerfstudio"](tmp_path / "out")
    shutil.copy(tmp_path / "out/splat.ply", tmp_path / "splat.ply")
    assert noted(load_scene(tmp_path / "splat.ply").notes, "nerfstudio:", "transforms.json", "--cameras")
