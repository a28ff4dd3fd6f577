"""Examples are kept in files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
from messages import refuses
from scenes import arc, make_scene, room
from training_runs import OPTIONS, PAPER, written

from gsmerge.errors import SceneError
from gsmerge.research.generate import GenerateOptions, generate
from gsmerge.research.training import (
    Example,
    TrainOptions,
    make_example,
    make_training_scene,
    prepare_shards,
    read_shard,
    train,
)
from gsmerge.research.training.examples import make_examples as make_each
from gsmerge.research.training.shards import scene_key

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def example() -> Example:
    return make_example(make_training_scene(make_scene(room(), arc(3, 32, 24)), range(3)), OPTIONS, 0.1, "room")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return two scenes of ``gsmerge lab generate``. Read only."""
    options = GenerateOptions(width=32, height=24, views=2)
    return [scene.folder for scene in generate(tmp_path_factory.mktemp("made"), 2, options, threads=1)]


def assert_same(one: object, other: object) -> None:
    """Check that two dataclasses of arrays are equal, bit for bit."""
    for f in fields(one):
        a, b = getattr(one, f.name), getattr(other, f.name)
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype
            assert a.shape == b.shape
            np.testing.assert_array_equal(a, b)
        elif hasattr(a, "__dataclass_fields__"):
            assert_same(a, b)
        else:
            assert a == b, f.name


def test_a_shard_holds_the_example_bit_for_bit(example: Example, tmp_path: Path) -> None:
    shard = written(example, tmp_path)
    assert_same(read_shard(shard), example)
    again = written(example, tmp_path / "again")
    assert again.sha256 == shard.sha256
    assert again.path.read_bytes() == shard.path.read_bytes()


def test_a_damaged_shard_is_named_in_one_line(example: Example, tmp_path: Path) -> None:
    shard = written(example, tmp_path)
    data = bytearray(shard.path.read_bytes())
    data[-100] ^= 1
    shard.path.write_bytes(bytes(data))
    with pytest.raises(SceneError, match="damaged"):
        read_shard(shard)
    with pytest.raises(SceneError, match="damaged"):
        read_shard(replace(shard, sha256="0"))
    shard.path.write_bytes(bytes(data[:1000]))
    with refuses(SceneError, shard.path, "example"):
        read_shard(shard)
    with refuses(SceneError, "none.safetensors", "example"):
        read_shard(replace(shard, path=tmp_path / "none.safetensors"))


@pytest.mark.slow
def test_complete_scenes_are_not_made_again(
    scenes: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Path] = []

    def watch(path: Path, options: TrainOptions) -> Iterator[object]:
        made.append(path)
        if len(made) == stop:
            raise KeyboardInterrupt
        yield from make_each(path, options)

    monkeypatch.setattr("gsmerge.research.training.shards.make_examples", watch)
    options, stop = replace(PAPER, densities=(0.05, 0.1)), 2
    with pytest.raises(KeyboardInterrupt):
        prepare_shards(scenes, options, tmp_path)
    moves: list[tuple[str, int, int]] = []
    shards = prepare_shards(scenes, options, tmp_path, progress=lambda *move: moves.append(move))
    assert (len(shards), made) == (4, [scenes[0], scenes[1], scenes[1]])
    assert moves == [(f"examples: {scene.name}", i, len(scenes)) for i, scene in enumerate(scenes)]
    assert prepare_shards(scenes, options, tmp_path) == shards
    assert prepare_shards(scenes, replace(options, steps=7, lpips_weight=0.5), tmp_path) == shards  # not of examples
    assert len(made) == 3
    shards[0].path.unlink()
    assert prepare_shards(scenes, options, tmp_path) == shards
    assert prepare_shards(scenes[:1], replace(options, densities=(0.05,)), tmp_path)[0].sha256 == shards[0].sha256
    assert len(made) == 5


@pytest.mark.slow
def test_a_scene_s_shards_depend_on_its_files(scenes: list[Path], tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    copytree(scenes[0], copy)
    (first,), (same,) = (prepare_shards([path], PAPER, tmp_path / "out") for path in (scenes[0], copy))
    assert (first.path, first.scene, same.scene) == (same.path, "scene_0000", "copy")
    photo = next((copy / "targets" / "images").iterdir())
    photo.write_bytes(next((copy / "images").iterdir()).read_bytes())
    (other,) = prepare_shards([copy], PAPER, tmp_path / "out")
    assert other.sha256 != first.sha256
    with pytest.raises(SceneError):
        prepare_shards([tmp_path / "nowhere"], PAPER, tmp_path / "out")


def test_a_photo_that_is_held_out_makes_other_shards(scenes: list[Path], tmp_path: Path) -> None:
    """Also where photos are hashed as a folder alone, because the cameras do not name files in it."""
    copy = copytree(scenes[0], tmp_path / "copy")
    cameras = copy / "transforms.json"
    cameras.write_text(cameras.read_text().replace("images/", ""))
    (copy / "targets").rename(copy / "old")
    (copy / "targets").mkdir()
    before = scene_key(copy, OPTIONS)
    last = max((copy / "images").iterdir())
    last.rename(copy / "targets" / last.name)
    assert scene_key(copy, OPTIONS) != before


def test_a_run_names_the_shard_that_is_damaged(scenes: list[Path], tmp_path: Path) -> None:
    shards = prepare_shards(scenes, PAPER, tmp_path / "shards")
    data = bytearray(shards[0].path.read_bytes())
    data[-1] ^= 1
    damaged = replace(shards[0], path=tmp_path / "damaged.safetensors")
    damaged.path.write_bytes(bytes(data))
    with refuses(SceneError, "damaged.safetensors", "example", "damaged"):
        train([damaged], shards[:1], tmp_path / "run", PAPER, threads=1)
