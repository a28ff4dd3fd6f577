"""The rows of a scene may be in several files: one for each view, or chunks."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from messages import refuses
from tiny_scene import Tiny

import gsmerge
from gsmerge.cli import main
from gsmerge.errors import SceneError
from gsmerge.io import write_ply
from gsmerge.jobs.states.state_file import load_state
from gsmerge.reading.content_hash import content_hash, list_files
from gsmerge.reading.read_scene import load_scene, read_scene
from gsmerge.reading.scene_files import find_scene_files
from gsmerge.results.outputs import Outputs
from gsmerge.road import compact_files
from gsmerge.settings.compact import CompactOptions


def split(folder: Path, tiny: Tiny, names: list[str], cuts: list[int]) -> Path:
    """Save the tiny scene with its rows in files of their own, cut at ``cuts``."""
    tiny.save(folder)
    (folder / "scene.ply").unlink()
    for name, rows in zip(names, np.split(np.arange(len(tiny.gaussians)), cuts), strict=True):
        write_ply(folder / name, tiny.gaussians[rows])
    return folder


@pytest.mark.parametrize(
    ("names", "cuts"),
    [
        (["view_8.ply", "view_9.ply", "view_10.ply"], [280, 560]),
        (["scene.chunk000.ply", "scene.chunk001.ply"], [123]),
        (["0012.ply", "0040.ply", "0077.ply"], [280, 560]),  # as many as cameras
    ],
)
def test_parts_are_one_scene(tmp_path: Path, tiny: Tiny, names: list[str], cuts: list[int]) -> None:
    whole = read_scene(tiny.save(tmp_path / "whole"))
    folder = split(tmp_path / "parts", tiny, names, cuts)
    files = find_scene_files(folder)
    assert [path.name for path in files.plys] == names
    assert set(files.plys) <= set(list_files(files))
    load = load_scene(folder)
    assert load.notes[0] == f"{len(names)} files are read as one scene: {names[0]} to {names[-1]}"
    assert load.info.count == len(tiny.gaussians)
    assert load.info.file_bytes == sum(path.stat().st_size for path in files.plys)
    for name, column in vars(whole.gaussians).items():
        np.testing.assert_array_equal(getattr(load.scene.gaussians, name), column)


def test_missing_part_is_named(tmp_path: Path, tiny: Tiny) -> None:
    folder = split(tmp_path / "near", tiny, ["part_0.ply", "part_1.ply", "part_3.ply"], [280, 560])
    with refuses(SceneError, folder, "part_0.ply", "part_3.ply", "number 2"):
        find_scene_files(folder)
    folder = split(tmp_path / "far", tiny, ["view_1.ply", "view_20241122101500.ply"], [280])
    with refuses(SceneError, folder, "number 2"):
        find_scene_files(folder)


def test_parts_of_different_kinds_are_refused(tmp_path: Path, tiny: Tiny) -> None:
    folder = split(tmp_path, tiny, ["view_0.ply", "view_1.ply"], [280])
    degree = replace(tiny.gaussians[:280], shN=np.zeros((280, 3, 3), np.float32))
    write_ply(folder / "view_1.ply", degree, overwrite=True)
    with refuses(SceneError, "view_1.ply", "view_0.ply"):
        read_scene(folder)


def test_numbered_files_may_be_several_scenes(tmp_path: Path, tiny: Tiny) -> None:
    """Two for three cameras, and names that say nothing."""
    folder = split(tmp_path, tiny, ["0.ply", "1.ply"], [420])
    with refuses(SceneError, folder, "2 (0.ply, 1.ply)"):
        find_scene_files(folder)


@pytest.mark.parametrize("names", [["0.ply", "1.ply", "2.ply"], ["step_7000.ply", "step_30000.ply", "step_3.ply"]])
def test_files_of_different_sizes_are_different_scenes(tmp_path: Path, tiny: Tiny, names: list[str]) -> None:
    """Even if there are as many as cameras."""
    folder = split(tmp_path, tiny, names, [100, 560])
    with refuses(SceneError, folder, 3):
        find_scene_files(folder)


@pytest.mark.parametrize("named", [True, False])
def test_files_of_the_same_bytes_are_one_scene(tmp_path: Path, tiny: Tiny, named: bool) -> None:
    """As Flash3D writes one for each view that it renders, of which there may be as many as cameras."""
    whole = read_scene(tiny.save(tmp_path / "whole"))
    folder = split(tmp_path / "copies", tiny, ["0.ply"], [])
    for i in (1, 2):
        shutil.copy(folder / "0.ply", folder / f"{i}.ply")
    load = load_scene(folder, cameras=folder / "transforms.json" if named else None)
    assert load.notes[0] == "3 files have the same bytes; 0.ply is read"
    np.testing.assert_array_equal(load.scene.gaussians.means, whole.gaussians.means)
    write_ply(folder / "2.ply", tiny.gaussians[::-1], overwrite=True)
    assert len(find_scene_files(folder).plys) == 3


@pytest.mark.parametrize("cuts", [[280, 560], [100, 300]])
def test_moments_are_refused_with_calls_that_compact_or_join_them(tmp_path: Path, tiny: Tiny, cuts: list[int]) -> None:
    folder = split(tmp_path, tiny, ["0000.ply", "0001.ply", "0002.ply"], cuts)
    (folder / "transforms.json").unlink()
    calls = f"gsmerge batch {folder}", f"gsmerge convert {folder}/*.ply one.ply"
    with refuses(SceneError, folder, "3 (0000.ply", "moments", "280 Gaussians" if cuts[0] == 280 else "parts", *calls):
        find_scene_files(folder)
    out = tmp_path / "one.ply"
    assert main(["convert", *map(str, sorted(folder.glob("*.ply"))), str(out), "-q"]) == 0
    assert gsmerge.read_ply(out).info.count == len(tiny.gaussians)


def test_state_of_a_scene_in_parts_has_all_of_them(tmp_path: Path, tiny: Tiny) -> None:
    folder = split(tmp_path, tiny, ["view_0.ply", "view_1.ply", "view_2.ply"], [280, 560])
    assert main(["extend", str(folder / "scene.gsm"), str(folder), "--set", "superpixels=20%", "-q"]) == 0
    (batch,) = load_state(folder / "scene.gsm").about["batches"]
    assert batch["content"] == content_hash(list_files(find_scene_files(folder)))
    assert batch["num_input"] == len(tiny.gaussians)


def test_the_report_has_all_parts(tmp_path: Path, tiny: Tiny) -> None:
    folder = split(tmp_path, tiny, ["view_0.ply", "view_1.ply", "view_2.ply"], [280, 560])
    settings = CompactOptions().with_settings({"superpixels": "20%", "fit": "none", "threads": 1})
    files = find_scene_files(folder)
    document = compact_files(files, settings, Outputs(tmp_path / "out.ply"), hashed=True)
    assert document["input"]["parts"] == [str(path) for path in files.plys]
    assert document["input"]["bytes"] == sum(path.stat().st_size for path in files.plys)
    assert gsmerge.read_ply(tmp_path / "out.ply").info.count == document["output"]["num_gaussians"]
