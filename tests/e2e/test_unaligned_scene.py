"""Scenes in no order from files to files, with floors (floors.csv, dB) on photos that no stage has seen."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import unaligned_scenes
from plyfile import PlyData
from sweeps import sweep

import gsmerge
from gsmerge import read_scene

Measure = Callable[[Path, Path], float]


@pytest.fixture(scope="module")
def made(made_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The made scene as voxels."""
    folder = Path(shutil.copytree(made_scene, tmp_path_factory.mktemp("unaligned") / "scene"))
    scene = gsmerge.read_scene(folder)
    gsmerge.write_ply(folder / "scene.ply", unaligned_scenes.voxels(scene, 0.03).gaussians, overwrite=True)
    return folder


@sweep("settings", [{}, {"budget": "2%"}, {"k": 2}], ids=str)
def test_floor(settings: dict, made: Path, tmp_path: Path, target_psnr: Measure, floor: Callable[..., None]) -> None:
    scene = read_scene(made, order="none")
    result = gsmerge.compact(scene, fit_steps=300, **settings)
    assert len(result.gaussians) <= 0.044 * settings.get("k", 1) * len(scene.gaussians)
    out = tmp_path / "small.ply"
    gsmerge.write_ply(out, result.gaussians)
    floor(target_psnr(made / "targets", out))


def test_reading_leaves_out_what_is_not_finite(made: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(made, tmp_path / "spoilt"))
    ply = PlyData.read(folder / "scene.ply", mmap=False)
    count = len(ply["vertex"]["x"])
    ply["vertex"]["x"][::10] = np.nan
    ply.write(folder / "scene.ply")
    assert len(read_scene(folder, order="none").gaussians) == count - len(range(0, count, 10))
