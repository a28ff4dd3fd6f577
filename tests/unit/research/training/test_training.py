"""Training runs write, resume and refuse what they should, and presets have their values."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from messages import refuses
from scenes import arc, make_scene, room
from training_runs import OPTIONS, TINY, written

from gsmerge.errors import SceneError
from gsmerge.method.networks.corrections import LOGIT_COLUMN
from gsmerge.method.networks.options import Bounds
from gsmerge.reading.checkpoint import load_checkpoint
from gsmerge.research.training import Shard, TrainOptions, make_example, preset_options, train
from gsmerge.research.training.scenes import make_training_scene


class StoppedError(Exception):
    """What a test interrupts a run with."""


@pytest.fixture(scope="module")
def shard(tmp_path_factory: pytest.TempPathFactory) -> Shard:
    example = make_example(make_training_scene(make_scene(room(), arc(3, 32, 24)), range(3)), OPTIONS, 0.1, "room")
    return written(example, tmp_path_factory.mktemp("shards"))


def files(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(out.iterdir()) if path.is_file()}


@pytest.mark.slow
def test_run_writes_its_losses_and_the_best_checkpoint(shard: Shard, tmp_path: Path) -> None:
    """Three steps of training with a validation after each take a second."""
    options = replace(OPTIONS, steps=3, save_every=1)
    done = train([shard], [], tmp_path, options)
    rows = list(csv.DictReader((tmp_path / "losses.csv").read_text().splitlines()))
    assert [int(row["step"]) for row in rows] == [1, 2, 3]
    learned = [float(row["psnr_learned"]) for row in rows]
    assert done.psnr_learned == pytest.approx(max(learned))
    best = load_checkpoint(done.best)
    assert best.training["step"] == learned.index(max(learned)) + 1
    assert best.networks.options == TINY
    assert best.training["data"] == [shard.sha256]
    assert best.training["options"] == options.to_dict()


@pytest.mark.slow
def test_interrupted_run_refuses_other_options_or_data(shard: Shard, tmp_path: Path) -> None:
    options = replace(OPTIONS, steps=1, save_every=1)
    train([shard], [], tmp_path, options)
    with refuses(SceneError, "state.safetensors", "options", "--output"):
        train([shard], [], tmp_path, replace(options, steps=8))
    with refuses(SceneError, "state.safetensors", "data", "--output"):
        train([replace(shard, sha256="0")], [], tmp_path, options)
    with pytest.raises(ValueError, match="examples"):
        train([], [], tmp_path)
    (tmp_path / "state.safetensors").write_bytes(b"state")
    with pytest.raises(SceneError, match="damaged"):
        train([shard], [], tmp_path, options)


@pytest.mark.slow
def test_interrupted_runs_end_with_the_same_bytes_on_any_number_of_threads(shard: Shard, tmp_path: Path) -> None:
    train([shard], [shard], tmp_path / "whole", OPTIONS, threads=1)

    def stop(step: int, *_: float) -> None:
        if step in (6, 9):
            stops.append(step)
            raise StoppedError

    stops: list[int] = []
    with pytest.raises(StoppedError):
        train([shard], [shard], tmp_path / "parts", OPTIONS, threads=4, progress=stop)
    assert load_checkpoint(tmp_path / "parts" / "last.safetensors").training["step"] == 4
    with pytest.raises(StoppedError):
        train([shard], [shard], tmp_path / "parts", OPTIONS, threads=2, progress=stop)
    done = train([shard], [shard], tmp_path / "parts", OPTIONS)
    assert done.resumed == 4
    assert stops == [6, 6]
    assert files(tmp_path / "whole") == files(tmp_path / "parts")
    again = train([shard], [shard], tmp_path / "parts", OPTIONS)
    assert (again.resumed, again.step) == (12, 12)


@pytest.mark.parametrize("wrong", [
        {"steps": 0}, {"rate": -1.0}, {"levels": (3,)}, {"levels": ()}, {"densities": ()}, {"densities": (2,)},
        {"match": "all"}, {"seed": 1.5}, {"views": ()}, {"views": (-1,)}, {"novel": -0.1}, {"photo_scale": 0},
        {"window": 5}, {"photo_loss": "l2"}, {"lpips_weight": -1}, {"teacher_steps": 0}, {"buffer": 0},
        {"segmentation": "slice"}, {"overlap": 2}, {"iou": -0.1}, {"photo_side": -1}, {"random_views": (3, 2)},
])  # fmt: skip
def test_settings_out_of_range_are_refused(wrong: dict[str, object], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        replace(OPTIONS, **wrong)


@pytest.mark.slow
def test_checkpoints_show_more_than_the_networks_in_training(shard: Shard, tmp_path: Path) -> None:
    """By the shift of the opacities, which training itself does not see."""
    weights = []
    for shift in (0.0, 0.25):
        done = train([shard], [], tmp_path / str(shift), replace(OPTIONS, steps=1, opacity_shift=shift))
        weights.append(load_checkpoint(done.last).networks.arrays)
        rows = (tmp_path / str(shift) / "losses.csv").read_text()
    before, after = weights
    for name in before:
        difference = after[name] - before[name]
        if name in {f"heads.{slots}.out.bias" for slots in (1, 2, 4)}:
            np.testing.assert_allclose(difference, 0.25 * (np.arange(13) == LOGIT_COLUMN), rtol=1e-5)
        else:
            assert not difference.any()
    assert rows == (tmp_path / "0.0" / "losses.csv").read_text()


def test_paper_preset_has_the_paper_s_values() -> None:
    paper = preset_options("paper")
    assert (paper.photo_loss, paper.photo_weight, paper.ssim_weight, paper.lpips_weight) == ("mse", 1, 0.05, 0.05)
    assert (paper.teacher_weight, paper.diversity_weight, paper.steps) == (0.25, 1, 300_000)
    assert (paper.rate_at(1999), paper.clip) == (5e-5, 10)
    assert paper.rate_at(299_999) == pytest.approx(1e-6, rel=1e-3)
    network = replace(paper.network, width=16, bounds=Bounds(mean=0.5))
    assert paper.with_settings({"steps": 10, "width": 16, "mean": 0.5}) == replace(paper, steps=10, network=network)
    assert paper.photo_level(952, 100) == 2
    assert paper.photo_level(320, 240) == 1


def test_preset_of_the_shipped_networks_has_their_values() -> None:
    shipped = preset_options("shipped")
    assert [shipped.lpips_weight_at(step) for step in (0, 2079, 2080, 2599)] == [0, 0, 0.06, 0.06]
    assert not shipped.network.encoder
    assert Bounds(color=0) == shipped.network.bounds


def test_default_preset_changes_no_option() -> None:
    assert preset_options("default") == TrainOptions()


def test_unknown_presets_are_refused() -> None:
    with pytest.raises(ValueError, match="preset"):
        preset_options("papers")


def test_regularizer_weights_fade_with_the_steps() -> None:
    options = replace(OPTIONS, teacher_weight=0.25, teacher_steps=10, diversity_weight=1.0, diversity_steps=1000)
    assert options.regularizer_weights(0) == (0.25, 1)
    assert options.regularizer_weights(5) == pytest.approx((0.125, 0.995))
    assert options.regularizer_weights(40) == pytest.approx((0, 0.96))
