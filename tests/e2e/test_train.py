"""``gsmerge lab train`` and ``checkpoint`` work as users call them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from shutil import copytree, rmtree
from typing import Any

import numpy as np
import pytest
from network_fixtures import SMALL, noisy, written
from training_runs import whole_photo

pytest.importorskip("torch", reason="torch is not installed")

from gsmerge.reading.checkpoint import load_checkpoint
from gsmerge.research.commands.train_command import find_training_scenes
from gsmerge.research.training import Example, TrainOptions
from gsmerge.research.training.examples import make_examples
from gsmerge.research.training.losses import render_window, window_psnr

from .conftest import Run, assert_refused, listing

FAST = ("--set", "superpixels=100", "--fit", "none")
TINY = {"width": 16, "heads": 2, "latent": 8, "members": 8, "neighbors": 4, "mean": 0.5}
CONFIG = {
    "densities": [0.02], "levels": [1], "steps": 4, "save_every": 2, "views": [3], "window": 32,
    "validation_windows": 1, **TINY,
}  # fmt: skip
PAPER = {
    "densities": [0.02], "steps": 2, "save_every": 1, "warmup": 1, "rate": 1e-3, "crops": 4, "window": 32,
    "lpips_weight": 0, **TINY,
}  # fmt: skip


def words(settings: dict[str, Any]) -> list[str]:
    """Return ``--set`` for every setting."""
    return [word for name, value in settings.items() for word in ("--set", f"{name}={json.dumps(value)}")]


@pytest.mark.slow
def test_networks_trained_as_in_the_paper_compact_a_scene(small_copy: Path, run: Run) -> None:
    """Absolute heads, clusters; settings of the networks change the preset's."""
    out = small_copy / "run"
    call = ("lab", "train", "--data", small_copy, "--output", out, *words(PAPER), "--preset", "paper")
    outcome = run(*call, code=0)
    assert "best.safetensors: 2 steps" in outcome.out
    assert "--validation" in outcome.err
    expected = {"best.safetensors", "last.safetensors", "losses.csv", "state.safetensors"}
    assert expected < set(listing(out))
    trained = load_checkpoint(out / "best.safetensors")
    options, training = trained.networks.options, trained.training["options"]
    assert (options.outputs, options.width, options.bounds.mean) == ("absolute", 16, 0.5)
    assert (training["photo_loss"], training["segmentation"], training["random_views"]) == ("mse", "bass-st", [1, 12])
    assert trained.training["figures"]["matched"] > 0.05
    assert trained.networks.arrays["merger.out.weight"].any()
    again = json.loads(run(*call, "--validation", small_copy, "--json").out)
    assert (again["step"], again["resumed"], again["notes"]) == (2, 2, [])
    small = small_copy / "small.ply"
    learned = run(
        "compact", small_copy, "-o", small, *FAST, "--set", f"checkpoint={out / 'best.safetensors'}", "--json", code=0
    )
    report = json.loads(learned.out)
    assert report["choices"]["networks"]["training"]["step"] in (1, 2)
    assert report["options"]["checkpoint"] == str(out / "best.safetensors")
    assert "refine" in report["seconds"]


@pytest.mark.slow
def test_photos_beside_the_scene_are_novel_views(scene_copy: Path, floor: Callable[..., None]) -> None:
    options = TrainOptions(views=(2, 0), densities=(0.02,), levels=(1,))

    def examples(path: Path, options: TrainOptions) -> list[Example]:
        return [make() for _, make in make_examples(path, options)]

    few, whole = examples(scene_copy, options)
    context, held_out = (
        len(whole.cameras),
        len(json.loads((scene_copy / "targets/transforms.json").read_text())["frames"]),
    )
    assert len(few.cameras) == 2
    assert len(few.photos) == len(whole.photos) == context + held_out
    assert few.name == whole.name == scene_copy.name
    # between two views the scene's Gaussians render a photo that nobody fitted
    windows = [whole_photo(whole, photo) for photo in range(context, context + held_out)]
    floor(np.mean([window_psnr(window, render_window(window, None, options)[0]) for window in windows]))
    rmtree(scene_copy / "targets")
    (alone,) = examples(scene_copy / "scene.ply", replace(options, views=(0,)))
    assert len(alone.photos) == context
    assert alone.name == f"{scene_copy.name}-scene"


@pytest.mark.parametrize(("place", "name", "value"), [("--set steps", "steps", 0), ("--set width", "width", 50)])
def test_wrong_settings_are_refused_in_one_line(
    place: str, name: str, value: int, small_scene: Path, run: Run, tmp_path: Path
) -> None:
    said = run("lab", "train", "--data", small_scene, "--output", tmp_path / "run", "--set", f"{name}={value}")
    assert_refused(said, 2, place, value)


@pytest.mark.slow
def test_data_may_be_a_folder_of_scenes(small_copy: Path, tmp_path: Path, run: Run) -> None:
    """Training prepares three scenes, and begins with loading torch."""
    folder, out = tmp_path / "scenes", tmp_path / "scenes" / "run"
    for name in ("a", "deeper/b", "c"):
        copytree(small_copy, folder / name)
    out.mkdir()
    copytree(small_copy, out / "not-a-scene-of-the-user")
    held = find_training_scenes([folder / "c"], out)
    assert held == [folder / "c"]
    actual = find_training_scenes([folder, folder / "a"], out, held)
    assert actual == [folder / "a", folder / "deeper/b"]
    assert find_training_scenes([folder / "c"], out, held) == held  # it was named
    call = ("lab", "train", "--data", folder, "--output", out, *words(CONFIG | {"steps": 1, "save_every": 1}))
    run(*call, "--validation", folder / "c", "--json", code=0)
    training = load_checkpoint(out / "last.safetensors").training
    assert (len(training["data"]), len(training["validation"])) == (2, 1)
    held = ("--data", folder / "deeper", "--validation", folder / "deeper/b")
    assert "--validation" in run("lab", "train", *held, "--output", out, code=2).err


def test_training_replaces_no_checkpoint(small_copy: Path, run: Run) -> None:
    path = written(small_copy / "a.safetensors", noisy(SMALL))
    before = path.read_bytes()
    assert run("compact", small_copy, *FAST, "--set", f"checkpoint={path}", "-o", path, "--overwrite").code == 2
    assert path.read_bytes() == before
