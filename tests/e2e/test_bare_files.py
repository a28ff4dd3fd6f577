"""Files beside which nothing lies: each command runs without a hint; photos without cameras are not passed over."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import unaligned_scenes
from messages import noted

import gsmerge
from gsmerge import Gaussians

PLACED = ("no cameras", "--cameras", "--images", "cannot be better than its input")


def make_object(count: int) -> Gaussians:
    """A ball of anisotropic Gaussians with harmonics of degree 1, as models of objects write."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    quats = np.concatenate([1 + normals[:, 2:], -normals[:, 1:2], normals[:, :1], 0 * normals[:, :1]], 1)
    colors = np.sin(4 * normals + [0, 1, 2])
    columns = (
        normals,
        quats,
        np.exp(rng.normal(0, 0.3, (count, 3))) * [0.05, 0.05, 0.005],
        rng.uniform(0.3, 1, count),
        colors[:, None],
        rng.normal(0, 0.1, (count, 3, 3)),
    )
    return Gaussians(*(column.astype(np.float32) for column in columns))


@pytest.fixture(scope="module", params=["voxels", pytest.param("object", marks=pytest.mark.slow)])
def bare(request: pytest.FixtureRequest, small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file alone in its folder. Read only."""
    path = tmp_path_factory.mktemp(request.param) / "scene.ply"
    voxels = unaligned_scenes.voxels(gsmerge.read_scene(small_scene), 0.05).gaussians
    gsmerge.write_ply(path, voxels if request.param == "voxels" else make_object(3000))
    return path


def report_of(run: Any, *words: Any) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(run(*words, "--json", code=0).out)
    return document


def test_compact_needs_no_hint(bare: Path, tmp_path: Path, run: Any) -> None:
    report = report_of(run, "compact", bare, "-o", tmp_path / "small.ply", "--budget", "20%")
    assert sum(noted([note], *PLACED) for note in report["notes"]) == 1
    assert not noted(report["notes"], "Depth Anything 3")
    assert report["output"]["num_gaussians"] == report["input"]["num_gaussians"] // 5
    judged = report["choices"]["fidelity"]
    assert judged["views"] == 8
    assert judged["psnr"] > 20
    assert judged["held_out"]
    assert report["psnr_input_views"] == {"before": None, "after": None}
    assert "unseen" not in report["choices"]
    hinted = report_of(run, "compact", bare, "-o", tmp_path / "b.ply", "--budget", "20%", "--hint", "order=none")
    assert (tmp_path / "small.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert hinted["notes"] == report["notes"]
    line = run("compact", bare, "-o", tmp_path / "c.ply", code=0).out
    assert "dB from the input in 8 held-out views" in line


def test_other_commands_need_none(bare: Path, tmp_path: Path, run: Any) -> None:
    small = tmp_path / "small.ply"
    run("compact", bare, "-o", small, "--effort", "draft", code=0)
    quick = ("--set", "superpixels=40", "--set", "checkpoint=none")
    for words in (
        ("compact", bare, "--dry-run"), ("inspect", bare), ("render", bare, small, "-o", tmp_path / "p.png"),
        ("render", bare, "--path", "orbit", "--frames", "2", "-o", tmp_path / "frames"),
        ("view", bare, small, "-o", tmp_path / "v.html"), ("evaluate", bare, small, "--lpips", "none"),
        ("extend", tmp_path / "state.gsm", bare, *quick),
    ):  # fmt: skip
        document = report_of(run, *words)
        notes = document.get("batches", [document])[0]["notes"]
        assert sum(noted([note], *PLACED) for note in notes) == 1, words
    folder = tmp_path / "scenes" / "first"
    folder.mkdir(parents=True)
    shutil.copy(bare, folder)
    run("batch", tmp_path / "scenes", "-o", tmp_path / "out", "--effort", "draft", code=0)
    run("inspect", bare, code=0)


def test_counts_are_judged_by_views_that_nothing_was_fitted_to(bare: Path, tmp_path: Path, run: Any) -> None:
    report = report_of(run, "compact", bare, "-o", tmp_path / "a.ply", "--quality", "22dB")
    assert report["choices"]["search"]["met"]
    assert report["choices"]["search"]["psnr"] >= 22
    for words in ((), ("--budget", "auto")):
        kept = report_of(run, "compact", bare, "-o", tmp_path / "b.ply", *words, "--overwrite")
        assert kept["choices"]["fidelity"]["psnr"] >= 32.5


def test_settings_of_stages_that_are_left_out_are_named(bare: Path, tmp_path: Path, run: Any) -> None:
    words = (
        "--set",
        "fit_steps=50",
        "--set",
        "unseen=keep",
        "--levels",
        "3",
        "--set",
        "drop=floaters",
        "--k",
        "2",
    )
    report = report_of(run, "compact", bare, "-o", tmp_path / "a.ply", *words)
    assert noted(report["notes"], "not used", "fit_steps", "unseen")
    assert not noted(report["notes"], "not used", "k")
    assert len(report["levels"]) == 2
    assert all(level["choices"]["fidelity"]["psnr"] > 5 for level in report["levels"])


@pytest.mark.parametrize("named", [True, False])
def test_photos_without_cameras_change_nothing(
    bare: Path, small_scene: Path, tmp_path: Path, run: Any, named: bool
) -> None:
    photos, scene = small_scene / "images", bare
    if not named:
        scene = shutil.copy(bare, tmp_path)
        photos = shutil.copytree(photos, tmp_path / "images")
    quick = ("--budget", "20%", "--effort", "draft")
    report = report_of(run, "compact", scene, *(("--images", photos) * named), *quick, "-o", tmp_path / "a.ply")
    assert sum(noted([note], photos, "not used", "no cameras", "transforms.json") for note in report["notes"]) == 1
    assert sum(noted([note], *PLACED) for note in report["notes"]) == 1
    run("compact", bare, *quick, "-o", tmp_path / "b.ply", code=0)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_photos_are_used_with_order_none_where_cameras_are_known(small_scene: Path, tmp_path: Path, run: Any) -> None:
    """Where the photos' sizes are the rows', their cameras are estimated, whatever the hint says of the order."""
    shutil.copy(small_scene / "scene.ply", tmp_path / "scene.ply")
    images = ("--images", small_scene / "images")
    quick = ("--effort", "draft", "--hint", "order=none")
    report = report_of(run, "compact", tmp_path / "scene.ply", *images, *quick, "-o", tmp_path / "a.ply")
    assert not noted(report["notes"], "not used")
    assert report["psnr_input_views"]["after"] is not None
