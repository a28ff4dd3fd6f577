"""Scenes in no order reach floors (floors.csv, dB) on photos that no stage has seen, from files to files."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import unaligned_scenes
from messages import names, noted
from PIL import Image
from scripts import target_psnr
from shared import write_made
from sweeps import sweep
from tiny_scene import edited_json

import gsmerge
from gsmerge import read_scene
from gsmerge.counts.search import MAX_BUILDS
from gsmerge.method.raster.metrics import MAX_LOSS
from gsmerge.plan.counts import FIDELITY_LOSS

from .conftest import Run


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the made scene as voxels."""
    folder = write_made(tmp_path_factory.mktemp("unaligned") / "scene")
    scene = gsmerge.read_scene(folder)
    gsmerge.write_ply(folder / "scene.ply", unaligned_scenes.voxels(scene, 0.03).gaussians, overwrite=True)
    return folder


@sweep("settings", [{}, {"budget": "2%"}, {"k": 2}])
def test_result_reaches_the_floor_on_held_out_photos(
    settings: dict, made: Path, tmp_path: Path, floor: Callable[..., None]
) -> None:
    """300 steps, as users' fits have."""
    scene = read_scene(made, order="none")
    result = gsmerge.compact(scene, fit_steps=300, **settings)
    assert len(result.gaussians) <= 0.044 * settings.get("k", 1) * len(scene.gaussians)
    out = tmp_path / "small.ply"
    gsmerge.write_ply(out, result.gaussians)
    floor(target_psnr(made / "targets", out))


def scale(folder: Path) -> None:
    gaussians = gsmerge.read_ply(folder / "scene.ply").gaussians
    scaled = replace(gaussians, means=100 * gaussians.means, scales=100 * gaussians.scales)
    gsmerge.write_ply(folder / "scene.ply", scaled, overwrite=True)


def shift(folder: Path) -> None:
    with edited_json(folder / "transforms.json") as data:
        for frame in data["frames"]:
            for axis, offset in enumerate((448262.5, 4582120.25, 187.5)):
                frame["transform_matrix"][axis][3] += offset


def forget(folder: Path) -> None:
    with edited_json(folder / "transforms.json") as data:
        del data["frames"][1:]


@sweep(
    ("harm", "kind", "words"),
    [(forget, "grid", ("no camera", "transforms.json")), (scale, "voxels", ("another scale", "--hint")),
     (shift, "voxels", ("moved by",))],
)  # fmt: skip
def test_cameras_that_contradict_the_gaussians_cost_nothing(
    harm: Callable[[Path], None],
    kind: str,
    words: tuple[str, ...],
    made: Path,
    made_scene: Path,
    tmp_path: Path,
    run: Run,
) -> None:
    """Searches for scales and shifts take seconds."""
    scores = {}
    for name in ("sound", "harmed"):
        folder = Path(shutil.copytree(made if kind == "voxels" else made_scene, tmp_path / name))
        if name == "harmed":
            harm(folder)
        said = run("compact", folder, "-o", tmp_path / f"{name}.ply", "--effort", "draft", "--json", code=0)
        document = json.loads(said.out)
        scores[name] = document["psnr_input_views"]["after"]
        assert noted(document["notes"], *words) == (name == "harmed")
    assert scores["harmed"] > scores["sound"] - 0.3


# Which other views judge; of those that are placed, seeds differ by 1.4 dB
@sweep(("beside", "least"), [("cameras", 30), ("nothing", 27)])
def test_a_result_compacted_again_looks_as_it_did(
    compacted_scene: Path, beside: str, least: float, tmp_path: Path, run: Run
) -> None:
    """Its Gaussians belong to no pixels, and a share of them would be a blur."""
    small, again = tmp_path / "small.ply", tmp_path / "again.ply"
    shutil.copy(compacted_scene / "small.ply", small)
    cameras = compacted_scene / "small.cameras.json"
    shutil.copy(cameras, tmp_path / ("small.cameras.json" if beside == "cameras" else "elsewhere.cameras.json"))
    said = run("compact", small, "-o", again, code=0)
    assert "dB  from the input in" in said.out
    assert "looks different" not in said.err
    before, after = (gsmerge.read_ply(path).gaussians for path in (small, again))
    views = read_scene(compacted_scene / "small.ply").cameras
    shown = [gsmerge.render(gaussians, views).images.clip(0, 1) for gaussians in (before, after)]
    assert -10 * np.log10(np.square(shown[0] - shown[1]).mean((1, 2, 3))).mean() >= least
    assert len(after) < len(before)


@pytest.mark.slow
@sweep("odd", [2, 0])  # photos of another scene, which decide nothing
def test_a_result_compacted_again_shows_the_photos_as_it_did(
    compacted_scene: Path, made_scene: Path, odd: int, tmp_path: Path, run: Run
) -> None:
    small, images, again = tmp_path / "small.ply", tmp_path / "images", tmp_path / "again.ply"
    shutil.copy(compacted_scene / "small.ply", small)
    shutil.copy(compacted_scene / "small.cameras.json", tmp_path / "small.cameras.json")
    shutil.copytree(made_scene / "images", images)
    for seed, photo in enumerate(sorted(images.iterdir())[:odd]):
        with Image.open(photo) as image:
            noise = np.random.default_rng(seed).integers(0, 256, (6, 8, 3), np.uint8)
            Image.fromarray(noise).resize(image.size).save(photo)
    # by other seeds a fit of nearly as many is refused on its held-out patches, and all Gaussians stay
    words = ("--images", images, "-o", again, "--json", "--set", "seed=2")
    document = json.loads(run("compact", small, *words, code=0).out)
    assert document["worse"] is None
    assert len(document["choices"]["search"]["tried"]) <= MAX_BUILDS
    assert document["output"]["num_gaussians"] < document["input"]["num_gaussians"]
    psnr = document["psnr_input_views"]
    assert psnr["after"] > psnr["before"] - MAX_LOSS
    planned = run("compact", small, "--images", images, "--dry-run", code=0).out
    assert f"within {FIDELITY_LOSS:g} dB of the input" in " ".join(planned.split())


@pytest.mark.slow
def test_result_unlike_its_input_is_a_warning(compacted_scene: Path, tmp_path: Path, run: Run) -> None:
    words = ("compact", compacted_scene / "small.ply", "-o", tmp_path / "few.ply", "--budget", "5%", "--strict")
    assert names(run(*words, code=4).err, "looks different from its input", "below 30 dB")


def test_dry_run_names_the_psnr_that_decides_the_count(compacted_scene: Path, tmp_path: Path, run: Run) -> None:
    words = ("compact", compacted_scene / "small.ply", "-o", tmp_path / "few.ply", "--dry-run")
    assert names(run(*words, code=0).out, "or more until the PSNR against the input is 32.5 dB", "fit: full")
    assert "or more until" not in run(*words, "--budget", "5%", code=0).out
