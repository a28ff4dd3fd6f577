"""``gsmerge train`` and ``--checkpoint`` as users call them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from shutil import copytree, rmtree

import numpy as np
from learned import SMALL, noisy, written

from gsmerge.cli.train import find_training_scenes
from gsmerge.networks import load_checkpoint
from gsmerge.research.training import TrainOptions, read_examples
from gsmerge.research.training.losses import window_psnr
from gsmerge.research.training.windows import whole_photo

from .conftest import Run, listing

FAST = ("--superpixels", 100, "--fit", "none", "--no-robust")
CONFIG = {
    "densities": [0.02], "fit_steps": 6, "levels": [1], "steps": 4, "save_every": 2, "crop": 50, "validation_crops": 1,
    "views": [3], "photo_start": 0.5, "window": 32, "validation_windows": 1, "lpips_weight": 0,
    "network": {"width": 16, "heads": 2, "latent": 8, "members": 8, "neighbors": 4, "bounds": {"mean": 0.5}},
}  # fmt: skip


def test_train_then_compact(scene_copy: Path, run: Run) -> None:
    config, out = scene_copy / "train.json", scene_copy / "run"
    config.write_text(json.dumps(CONFIG))
    call = ("train", "--data", scene_copy, "--output", out, "--config", config, "--preset", "paper")
    outcome = run(*call)
    assert outcome.code == 0, outcome.err
    assert "best.safetensors: 4 steps" in outcome.out
    assert "--validation" in outcome.err
    kept = {"best.safetensors", "last.safetensors", "losses.csv", "state.safetensors"}
    kept |= {f"validation-{scene_copy.name}.png"}
    assert kept < set(listing(out))
    trained = load_checkpoint(out / "best.safetensors")
    assert trained.networks.options.bounds.mean == 0.5
    assert trained.training["options"]["photo_loss"] == "mse"
    document = json.loads(run(*call, "--validation", scene_copy, "--json").out)
    assert (document["step"], document["resumed"], document["notes"]) == (4, 4, [])
    small = scene_copy / "small.ply"
    networks = run("compact", scene_copy, "-o", small, *FAST, "--checkpoint", out / "best.safetensors", "--json")
    assert networks.code == 0, networks.err
    report = json.loads(networks.out)
    assert report["choices"]["networks"]["training"]["step"] in (2, 4)
    assert report["options"]["checkpoint"] == str(out / "best.safetensors")
    assert "refine" in report["seconds"]


def test_photos_beside_the_scene_are_novel_views(scene_copy: Path, floor: Callable[..., None]) -> None:
    options = TrainOptions(views=(2, 0), densities=(0.02,), fit_steps=6, levels=(1,))
    few, whole = read_examples(scene_copy, options)
    context, held_out = (
        len(whole.cameras),
        len(json.loads((scene_copy / "targets/transforms.json").read_text())["frames"]),
    )
    assert len(few.cameras) == 2
    assert len(few.photos) == len(whole.photos) == context + held_out
    assert whole.photo_ids(novel=True) == list(range(context, context + held_out))
    assert few.name == whole.name == scene_copy.name
    # between two views the scene's Gaussians render a photo that nobody fitted
    floor(np.mean([window_psnr(whole_photo(whole, photo), None) for photo in whole.photo_ids(novel=True)]))
    rmtree(scene_copy / "targets")
    (alone,) = read_examples(scene_copy / "scene.ply", replace(options, views=(0,)))
    assert len(alone.photos) == context
    assert alone.sha256 != whole.sha256
    assert alone.name == f"{scene_copy.name}-scene"


def test_settings_and_scenes_are_told_in_one_line(scene_copy: Path, run: Run, tmp_path: Path) -> None:
    config, out = tmp_path / "train.toml", tmp_path / "run"
    for text, told in (("steps = 0\n", "steps"), ("stride = 3\n", "stride"), ("steps = = 3", "TOML")):
        config.write_text(text)
        outcome = run("train", "--data", scene_copy, "--output", out, "--config", config)
        assert outcome.code == 3
        assert told in outcome.err
        assert outcome.err.count("\n") == 1
    assert run("train", "--data", tmp_path / "nowhere", "--output", out).code == 3
    assert run("train", "--output", out).code == 2


def test_data_may_be_a_folder_of_scenes(scene_copy: Path, tmp_path: Path, run: Run) -> None:
    folder, out = tmp_path / "scenes", tmp_path / "scenes" / "run"
    for name in ("a", "deeper/b", "c"):
        copytree(scene_copy, folder / name)
    out.mkdir()
    copytree(scene_copy, out / "not-a-scene-of-the-user")
    held = find_training_scenes([folder / "c"], out)
    assert held == [folder / "c"]
    found = find_training_scenes([folder, folder / "a"], out, held)
    assert found == [folder / "a", folder / "deeper/b"]
    assert find_training_scenes([folder / "c"], out, held) == held  # it was named
    config = tmp_path / "train.json"
    config.write_text(json.dumps(CONFIG | {"steps": 1, "save_every": 1}))
    call = ("train", "--data", folder, "--output", out, "--config", config)
    done = run(*call, "--validation", folder / "c", "--json")
    assert done.code == 0, done.err
    training = load_checkpoint(out / "last.safetensors").training
    assert (len(training["data"]), len(training["validation"])) == (2, 1)
    outcome = run("train", "--data", folder / "deeper", "--validation", folder / "deeper/b", "--output", out)
    assert outcome.code == 2
    assert "besides those of --validation" in outcome.err


def test_a_checkpoint_that_cannot_be_used(scene_copy: Path, run: Run) -> None:
    missing, small = scene_copy / "missing.safetensors", scene_copy / "small.ply"
    outcome = run("compact", scene_copy, "-o", small, *FAST, "--checkpoint", missing)
    assert outcome.code == 0
    notes = [line for line in outcome.err.splitlines() if line.startswith("note")]
    assert len(notes) == 1
    assert str(missing) in notes[0]
    outcome = run("compact", scene_copy, *FAST, "--checkpoint", missing, "--require-checkpoint")
    assert outcome.code == 3
    assert outcome.err.count("\n") == 1
    assert run("compact", scene_copy, *FAST, "--checkpoint", "none", "--require-checkpoint").code == 2


def test_a_checkpoint_is_not_replaced(scene_copy: Path, run: Run) -> None:
    path = written(scene_copy / "a.safetensors", noisy(SMALL))
    before = path.read_bytes()
    assert run("compact", scene_copy, *FAST, "--checkpoint", path, "-o", path, "--overwrite").code == 2
    assert path.read_bytes() == before
