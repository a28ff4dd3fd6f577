"""Results of degree 4, which splat-transform and gsply refuse in a ``.ply``, get degree 3 and a note."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from messages import noted
from tiny_scene import Tiny, make_tiny

import gsmerge
from gsmerge.io import read_gaussians, write_ply
from gsmerge.io.formats.ply import file_bytes
from gsmerge.jobs.file_checks import check_content
from gsmerge.reading.scene_files import find_scene_files
from gsmerge.results.outputs import Outputs
from gsmerge.run import compact_files
from gsmerge.settings.compact import CompactOptions

PLAIN = CompactOptions().with_settings({"superpixels": "20%", "fit": "none", "threads": 1})


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    tiny = make_tiny()
    shN = np.random.default_rng(0).normal(0, 0.1, (len(tiny.gaussians), 24, 3)).astype(np.float32)
    return replace(tiny, gaussians=replace(tiny.gaussians, shN=shN)).save(tmp_path)


@pytest.mark.parametrize(("name", "degree"), [("x.ply", 3), ("x.spz", 3), ("x.glb", 3)])
def test_results_of_degree_4_have_harmonics_of_degree_3(folder: Path, name: str, degree: int) -> None:
    document = compact_files(find_scene_files(folder), PLAIN, Outputs(folder / name))
    assert read_gaussians(folder / name).info.sh_degree == degree
    assert noted(document["notes"], "above degree 3")
    assert document["input"]["sh_degree"] == 4


def test_a_budget_of_bytes_counts_harmonics_that_are_written(folder: Path) -> None:
    settings = PLAIN.with_settings({"budget": "30kB", "fill": True})
    document = compact_files(find_scene_files(folder), settings, Outputs(folder / "x.ply"))
    size = (folder / "x.ply").stat().st_size
    degree = read_gaussians(folder / "x.ply").info.sh_degree  # 0 where more Gaussians show the photos better
    assert size == file_bytes(document["output"]["num_gaussians"], degree)
    assert size <= 30_000 < size + 62 * 4


def test_files_of_degree_4_are_noted(folder: Path, tiny: Tiny) -> None:
    assert noted(check_content(folder / "scene.ply").notes, "degree 4", "splat-transform 3.7")
    assert noted(gsmerge.inspect(folder)["notes"], "degree 4", "gsply")
    write_ply(folder / "three.ply", gsmerge.read_ply(folder / "scene.ply").gaussians, sh_degree=3)
    assert not noted(check_content(folder / "three.ply").notes, "degree")
    assert gsmerge.read_ply(folder / "scene.ply").info.sh_degree == 4  # written by write_ply, which keeps them
