"""Examples in files, and streams of them."""

from __future__ import annotations

from collections import Counter
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
    Shard,
    make_example,
    make_training_scene,
    prepare_shards,
    read_shard,
    train,
)
from gsmerge.research.training.examples import make_examples as make_each
from gsmerge.research.training.shards import ExampleStreams, open_streams, scene_key

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def example() -> Example:
    return make_example(make_training_scene(make_scene(room(), arc(3, 32, 24)), range(3)), OPTIONS, 0.1, "room")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two of ``gsmerge lab generate``'s. Read only."""
    options = GenerateOptions(width=32, height=24, views=2)
    return [scene.folder for scene in generate(tmp_path_factory.mktemp("made"), 2, options, threads=1)]


def assert_same(one: object, other: object) -> None:
    """Two dataclasses of arrays, bit for bit."""
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
    read_shard(shard, check=False)
    with pytest.raises(SceneError, match="damaged"):
        read_shard(replace(shard, sha256="0"), check=False)
    shard.path.write_bytes(bytes(data[:1000]))
    with refuses(SceneError, shard.path, "example"):
        read_shard(shard)
    with refuses(SceneError, "none.safetensors", "example"):
        read_shard(replace(shard, path=tmp_path / "none.safetensors"))


@pytest.mark.slow
def test_preparing_goes_on_where_it_was(scenes: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    class StoppedError(Exception):
        pass

    def watch(*arguments: object) -> Iterator[object]:
        for label, make in make_each(*arguments):

            def counted(label: str = label, make: object = make) -> Example:
                if len(made) == stop:
                    raise StoppedError
                made.append(label)
                return make()

            yield label, counted

    monkeypatch.setattr("gsmerge.research.training.shards.make_examples", watch)
    options, stop = replace(PAPER, densities=(0.05, 0.1)), 3
    with pytest.raises(StoppedError):
        prepare_shards(scenes, options, tmp_path)
    assert len(made) == 3
    stop = 99
    moves: list[tuple[str, int, int]] = []
    shards = prepare_shards(scenes, options, tmp_path, report=lambda *move: moves.append(move))
    assert len(made) == len(shards) == 4
    assert [move[1:] for move in moves] == [(i, len(scenes)) for i in range(len(scenes))]
    assert all(text.startswith("examples: ") for text, _, _ in moves)
    times = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert prepare_shards(scenes, options, tmp_path) == shards
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == times
    shards[0].path.write_bytes(b"cut")
    assert prepare_shards(scenes, options, tmp_path) == shards
    assert len(made) == 5
    assert prepare_shards(scenes, replace(options, steps=7, lpips_weight=0.5), tmp_path) == shards  # not of examples
    assert prepare_shards(scenes[:1], replace(options, densities=(0.05,)), tmp_path)[0].sha256 == shards[0].sha256
    assert len(made) == 6


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


def shard_numbers(streams: ExampleStreams, steps: int) -> dict[int, list[int]]:
    """Of every crop, the oldest shard at each step."""
    return {crop: [streams.shard_id(step, crop, 0) for step in range(steps)] for crop in range(streams.options.crops)}


def test_every_pass_visits_every_shard_once_in_another_order() -> None:
    shards = [Shard(Path(str(i)), str(i), str(i)) for i in range(10)]
    options = replace(PAPER, crops=2, refresh=3)
    with open_streams(shards, options) as streams:
        seen = shard_numbers(streams, 60)
    assert all(seen[crop][3 * i] == seen[crop][3 * i + 2] for crop in (0, 1) for i in range(20))
    order = [seen[crop][3 * i] for i in range(20) for crop in (0, 1)]
    passes = [order[i : i + 10] for i in range(0, 40, 10)]
    assert [sorted(part) for part in passes] == [list(range(10))] * 4
    assert len(set(map(tuple, passes))) == 4
    with open_streams(shards, replace(options, seed=1)) as streams:
        assert shard_numbers(streams, 60) != seen


def test_few_examples_are_in_memory_and_draws_are_spread(monkeypatch: pytest.MonkeyPatch) -> None:
    reads: Counter[int] = Counter()

    def read(shard: Shard, *, check: bool) -> int:
        number = int(shard.sha256)
        assert check == (reads[number] == 0)  # compared with its hash once
        reads[number] += 1
        return number

    monkeypatch.setattr("gsmerge.research.training.shards.read_shard", read)
    shards = [Shard(Path(str(i)), str(i), str(i)) for i in range(100)]
    options, rng, drawn = replace(PAPER, buffer=4, refresh=2), np.random.default_rng(0), Counter[int]()
    with open_streams(shards, options) as streams:
        for step in range(100):
            streams.move_to(step)
            assert len(streams.examples) <= 2 * (options.buffer + 1)
            for crop in (0, 1):
                drawn[int(streams.draw(step, crop, rng))] += 1
    assert len(drawn) > 75
    assert max(reads.values()) <= 2
    reads.clear()
    with open_streams(shards[:3], options) as streams:  # all of few stay
        for step in range(50):
            streams.move_to(step)
            for crop in (0, 1):
                streams.draw(step, crop, rng)
    assert set(reads.values()) == {1}


@pytest.fixture(scope="module")
def shards(scenes: list[Path], tmp_path_factory: pytest.TempPathFactory) -> list[Shard]:
    return prepare_shards(scenes, PAPER, tmp_path_factory.mktemp("shards"))


def test_a_run_names_the_shard_that_is_damaged(shards: list[Shard], tmp_path: Path) -> None:
    data = bytearray(shards[0].path.read_bytes())
    data[-1] ^= 1
    damaged = replace(shards[0], path=tmp_path / "damaged.safetensors")
    damaged.path.write_bytes(bytes(data))
    with refuses(SceneError, "damaged.safetensors", "example", "damaged"):
        train([damaged], shards[:1], tmp_path / "run", PAPER, threads=1)
