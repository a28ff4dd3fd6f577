"""Made scenes are folders, the same for the same seed, read back aligned, and kept when they are there."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from messages import refuses
from shared import make_once

import gsmerge
from gsmerge.errors import SceneError, UsageError
from gsmerge.method.geometry.transforms import project
from gsmerge.method.raster.metrics import psnr
from gsmerge.reading.held_out import read_held_out
from gsmerge.reading.read_scene import load_scene
from gsmerge.research.generate import GenerateOptions, generate

TINY = GenerateOptions(views=3, width=32, height=24)
NUM_SCENES = 2


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def make_two() -> Path:
    """Return a folder with two scenes, which take a second together. Read only."""
    return make_once("generated", lambda out: generate(out, NUM_SCENES, TINY, seed=0, threads=2))


@pytest.fixture(scope="module")
def folder() -> Path:
    return make_two()


@pytest.fixture
def first(tmp_path: Path) -> Path:
    """Return a folder with the first scene alone, which a test may change."""
    shutil.copytree(make_two() / "scene_0000", tmp_path / "scene_0000")
    return tmp_path


@pytest.mark.slow
def test_made_folders_have_all_files(folder: Path) -> None:
    views = {f"{sub}images/view_00{i}.png" for sub, n in (("", 3), ("targets/", 2)) for i in range(n)}
    files = {"scene.ply", "transforms.json", "targets/transforms.json", "generated.json"} | views
    for index in range(NUM_SCENES):
        assert set(contents(folder / f"scene_{index:04d}")) == files
        record = json.loads((folder / f"scene_{index:04d}" / "generated.json").read_text())
        assert (record["num_views"], record["num_gaussians"]) == (3, 3 * 32 * 24)
    assert len(list(folder.iterdir())) == NUM_SCENES


@pytest.mark.slow
@pytest.mark.parametrize("index", range(NUM_SCENES))
def test_scenes_are_read_back_aligned(folder: Path, index: int) -> None:
    load = load_scene(folder / f"scene_{index:04d}")
    scene = load.scene
    assert load.notes == ()
    assert scene.pixels.shown.all()
    pixels, depths = project(scene.gaussians.means, scene.cameras)
    centres = np.stack(np.meshgrid(np.arange(32) + 0.5, np.arange(24) + 0.5), -1)
    for view in range(3):
        own = slice(view * 32 * 24, (view + 1) * 32 * 24)
        assert np.abs(pixels[view, own] - centres.reshape(-1, 2)).max() < 0.31
        assert depths[view, own].min() > 0


@pytest.mark.slow
def test_held_out_photos_show_the_same_scene(folder: Path) -> None:
    """Renders of the Gaussians are nearer to the held-out photos than those photos are to one another's places."""
    better = []
    for index in range(NUM_SCENES):
        load = load_scene(folder / f"scene_{index:04d}")
        targets = read_held_out(load, folder / f"scene_{index:04d}" / "targets", None)
        images = gsmerge.render(load.scene.gaussians, targets.cameras).images
        own = np.mean([psnr(a, b) for a, b in zip(images, targets.images, strict=True)])
        other = np.mean([psnr(a, b) for a, b in zip(images, targets.images[::-1], strict=True)])
        better.append(own > other + 1)
    assert np.mean(better) >= 0.8


@pytest.mark.slow
def test_generate_keeps_scenes_that_are_there_and_adds_the_rest(folder: Path, first: Path) -> None:
    """The same bytes on one thread as on two."""
    before = (first / "scene_0000" / "scene.ply").stat().st_mtime_ns
    calls: list[tuple[int, int]] = []
    actual = generate(first, 2, TINY, threads=1, progress=lambda done, total: calls.append((done, total)))
    assert [scene.kept for scene in actual] == [True, False]
    assert (first / "scene_0000" / "scene.ply").stat().st_mtime_ns == before
    assert calls[-1] == (2, 2)
    assert contents(first / "scene_0001") == contents(folder / "scene_0001")


def test_scene_of_another_seed_is_not_replaced(first: Path) -> None:
    before = contents(first)
    with refuses(UsageError, "scene_0000", "remove it"):
        generate(first, 1, TINY, seed=6)
    assert contents(first) == before


def test_folder_of_other_files_is_not_replaced(first: Path) -> None:
    stranger = first / "scene_0001"
    stranger.mkdir()
    (stranger / "thesis.txt").write_text("years of work")
    with refuses(UsageError, "scene_0001", "remove it"):
        generate(first, 2, TINY)
    assert (stranger / "thesis.txt").read_text() == "years of work"


def test_a_damaged_record_is_no_scene(first: Path) -> None:
    (first / "scene_0000" / "generated.json").write_text("[")
    with refuses(UsageError, "scene_0000", "remove it"):
        generate(first, 1, TINY)


def test_failed_scene_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("gsmerge.research.generate.folders.write_ply", full)
    with refuses(SceneError, "images/view_000.png", "No space left"):
        generate(tmp_path, 1, TINY)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("count", "seed"), [(0, 0), (1, -1)])
def test_count_or_seed_out_of_range_is_refused(count: int, seed: int, tmp_path: Path) -> None:
    with refuses(ValueError, "", "1 scene", "seed"):
        generate(tmp_path, count, TINY, seed=seed)
