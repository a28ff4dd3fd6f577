"""Scenes without photos are compacted by the rows' own colours, which every command says."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from scripts import target_psnr
from shared import write_smallest
from sweeps import sweep

import gsmerge
from gsmerge.method.facts.pictures import ROW_COLORS
from gsmerge.prepare.row_colors import NO_PHOTOS

from .conftest import Run

QUICK = ("--set", "superpixels=60", "--set", "fit_steps=40", "--threads", 1)
UNFITTED = [
    ("--fit", "none"),
    ("--set", "recipe=paper"),
    ("--set", "blocks=2"),
]  # of blocks, each block says how it was
CLOSE = 0.3  # dB between a result fitted to photos and one fitted to colours that are the photos'


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a scene without its photos. Read only."""
    folder = write_smallest(tmp_path_factory.mktemp("bare") / "scene")
    shutil.rmtree(folder / "images")
    return folder


@sweep(
    "options",
    [
        ("--effort", "draft"), ("--effort", "fast", "--k", 2), ("--fit", "none"), ("--budget", "5%"),
        ("--budget", "20KB"), ("--budget", "auto"), ("--quality", "15dB"), ("--quality", "-1dB"), ("--set", "blocks=2"),
        ("--set", "recipe=paper"), ("--drop", "sky"), ("--set", "exposure=per-photo"), ("--set", "poses=free"),
        ("--set", "method=unmerged-fit"), ("--levels", 2),
    ],
    ids=lambda options: " ".join(map(str, options)), often=3)  # fmt: skip
def test_every_setting_works_without_photos(options: tuple[object, ...], bare: Path, tmp_path: Path, run: Run) -> None:
    sizes = QUICK if options[0] not in ("--effort", "--budget") else QUICK[2:]
    said = run("compact", bare, "-o", tmp_path / "small.ply", *sizes, *options, "--json", code=0)
    document = json.loads(said.out)
    assert document["psnr_reference"] == ROW_COLORS
    assert document["psnr_input_views"]["after"] > 10
    assert sum(note.startswith(NO_PHOTOS) for note in document["notes"]) == 1
    assert ("fit" in document["choices"]) == (options not in UNFITTED)


@pytest.mark.slow
@sweep("effort", ["draft", "fast"])
def test_result_without_photos_is_as_good_as_with_them(effort: str, small_scene: Path, tmp_path: Path) -> None:
    """Judged by photos that neither has seen, over ten seeds, between which results so small differ by 0.5 dB."""
    scene, differences = gsmerge.read_scene(small_scene), []
    for seed in range(10):
        actual = []
        for name, one in (("with", scene), ("without", replace(scene, images=None))):
            out = tmp_path / f"{name}-{seed}.ply"
            gsmerge.write_ply(out, gsmerge.compact(one, effort=effort, threads=1, seed=seed).gaussians)
            actual.append(target_psnr(small_scene / "targets", out))
        differences.append(actual[1] - actual[0])
    assert sum(differences) / 10 > -CLOSE


def test_summary_says_what_the_result_is_measured_against(bare: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / "small.ply"
    psnr = json.loads(run("compact", bare, "-o", out, *QUICK, "--json", code=0).out)["psnr_input_views"]
    said = run("compact", bare, "-o", out, *QUICK, "--overwrite", code=0)
    assert psnr["after"] > psnr["before"] + 1
    assert f"{ROW_COLORS} {psnr['before']:.2f} dB {psnr['after']:.2f} dB" in " ".join(said.out.split())
    assert NO_PHOTOS in said.err
    assert NO_PHOTOS in run("inspect", bare, code=0).out
    planned = json.loads(run("compact", bare, *QUICK, "--dry-run", "--json", code=0).out)
    assert planned["notes"].count(NO_PHOTOS) == 1
    assert planned["compact"]["fit"] == "full"
    assert ROW_COLORS in run("evaluate", bare, out, "--lpips", "none", code=0).out
    page = run("view", bare, out, "-o", tmp_path / "page.html", "--json", code=0)
    assert ROW_COLORS in json.loads(page.out)["headline"]
