"""Store examples in files: they are written once, hashed, and read in random order, with few in memory at a time.

A shard is a safetensors file with one example. The shards of a scene are listed in a record, a JSON file that is
written after all of them. Its name is a hash of the scene's files and of the settings. So an interrupted call continues
with the first missing example, and complete examples are not made again.

Threads read ahead. Every crop of a step has its own stream: every ``crops``-th shard, in an order that is shuffled
again for each pass. A stream has ``buffer`` examples in memory, and the crop draws one of them at random. Every
``refresh`` steps the next example in the order replaces the oldest one. A capture can replace a shard; its backbone
predicts a new example at every place in the order. All of this depends only on seed and step. So a resumed run
continues as if it had not been interrupted.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from gsmerge.errors import SceneError
from gsmerge.io.atomic import atomic_output
from gsmerge.pooling import Members
from gsmerge.raster.photos import Photos
from gsmerge.research.training.backbones import PredictedCapture
from gsmerge.research.training.examples import Example, make_examples, scene_name
from gsmerge.research.training.train_options import TrainOptions
from gsmerge.runtime.threads import work_alone
from gsmerge.scene.content_hash import content_hash, digest, list_files
from gsmerge.scene.files import find_scene_files
from gsmerge.types import Cameras, FeatureGaussians, Gaussians
from gsmerge.version import __version__

Report = Callable[[str, int, int], None]  # description of the work, step, steps
LAYOUT = 7  # version of the files and their contents
FORMAT = "gsmerge-example"
REMEDY = "remove it; the next call makes it again"
# Settings that an example depends on
SETTINGS = ("densities", "segmentation", "photo_scale", "photo_side", "seed")
PARTS = {"members": Members, "features": FeatureGaussians, "base": Gaussians}
# Each replaces the step in a seed of random numbers: of the order, and of the draws of a capture
ORDER, DRAWN = 2**32 + 1, 2**32 + 2


@dataclass(frozen=True)
class Shard:
    """File that stores one example."""

    path: Path
    scene: str  # name of the scene
    sha256: str  # hash of the arrays


def prepare_shards(
    scenes: Sequence[Path], options: TrainOptions, folder: Path, report: Report | None = None
) -> list[Shard]:
    """Return the shards of all scenes in order; missing shards are made.

    ``scenes`` are folders or ``.ply`` files. ``report`` is called with (words, step, steps). Raises SceneError if a
    scene cannot be used, or if the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SceneError(folder, f"cannot be written ({error.strerror})", "choose another folder") from error
    shards: list[Shard] = []
    for number, scene in enumerate(scenes):
        if report:
            report(f"examples: {scene_name(scene)}", number, len(scenes))
        shards += _scene_shards(scene, options, folder)
    return shards


def _scene_shards(scene: Path, options: TrainOptions, folder: Path) -> list[Shard]:
    key, name = scene_key(scene, options), scene_name(scene)
    record = folder / f"{key[:32]}.json"
    hashes = _read_record(record)
    if hashes is None:
        hashes = _make_shards(scene, options, folder / key[:32])
        with atomic_output(record, overwrite=True) as temporary:
            temporary.write_bytes(json.dumps(hashes, indent=1).encode() + b"\n")
    return [Shard(folder / file, name, sha256) for file, sha256 in hashes.items()]


def _make_shards(scene: Path, options: TrainOptions, start: Path) -> dict[str, str]:
    """Write the missing examples of a scene to files that begin with ``start``; return the hash of each by name."""
    hashes = dict[str, str]()
    for label, make in make_examples(scene, options):
        path = start.with_name(f"{start.name}-{label}.safetensors")
        hashes[path.name] = _content_hash(path) or write_shard(path, make())
    return hashes


def scene_key(scene: Path, options: TrainOptions) -> str:
    """Return a hash of a scene's files and the settings that its examples depend on; SceneError without a scene."""
    head = {"layout": LAYOUT, "gsmerge": __version__, "views": options.example_views}
    head |= {name: getattr(options, name) for name in SETTINGS}
    files = find_scene_files(scene)
    targets = files.ply.parent / "targets"
    held_out = content_hash([targets]) if targets.is_dir() else None  # separate, since names are relative to folders
    return digest({**head, "content": content_hash(list_files(files)), "held_out": held_out})


def _read_record(path: Path) -> dict[str, str] | None:
    """Read the hash of each shard of a scene; None if the scene is not complete."""
    try:
        hashes = json.loads(path.read_text())
        complete = all(_content_hash(path.with_name(file)) == sha256 for file, sha256 in hashes.items())
    except (OSError, ValueError, AttributeError):
        return None
    return hashes if complete else None


def _content_hash(path: Path) -> str | None:
    """Read a shard's hash from its header; None if there is no complete shard."""
    try:
        return str(_read(path, "none")[1]["sha256"])
    except (SceneError, KeyError, TypeError):
        return None


def write_shard(path: Path, example: Example) -> str:
    """Write an example to a file, replacing it, and return the hash of its arrays; SceneError if that fails."""
    arrays = dict(_arrays(example))
    facts = {"layout": LAYOUT, "sha256": hash_arrays(arrays), "unit": example.unit, "eps2d": example.photos.eps2d}
    facts |= {"size": [example.cameras.width, example.cameras.height]}
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_bytes(save(arrays, {FORMAT: json.dumps(facts)}))  # save_file would change the file's mode
    return str(facts["sha256"])


def _arrays(example: Example) -> Iterator[tuple[str, np.ndarray]]:
    for part, kind in PARTS.items():
        for f in fields(kind):
            yield f"{part}.{f.name}", np.ascontiguousarray(getattr(getattr(example, part), f.name))
    for part, cameras in (("cameras", example.cameras), ("photos", example.photos)):
        yield f"{part}.viewmats", np.ascontiguousarray(cameras.viewmats)
        yield f"{part}.Ks", np.ascontiguousarray(cameras.Ks)
    yield "images", example.images
    yield "covers", example.covers


def hash_arrays(arrays: Mapping[str, np.ndarray]) -> str:
    """Hash names, types, shapes and values by SHA-256."""
    state = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        state.update(json.dumps([name, str(array.dtype), *array.shape]).encode("ascii"))
        state.update(array.data if array.size else b"")
    return state.hexdigest()


def read_shard(shard: Shard, *, check: bool = True) -> Example:
    """Read the example of a shard; with ``check`` compare the arrays with their hash.

    Raises SceneError if the file is missing, damaged, or has changed since the run began.
    """
    arrays, facts = _read(shard.path)
    if facts["sha256"] != shard.sha256 or (check and hash_arrays(arrays) != shard.sha256):
        raise SceneError(shard.path, "expected the example that was written, found a damaged file or another", REMEDY)

    def part(name: str) -> dict[str, Any]:
        prefix = f"{name}."
        return {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}

    black = np.broadcast_to(np.float32(0), arrays["images"].shape)
    return Example(
        name=shard.scene,
        unit=float(facts["unit"]),
        members=Members(**part("members")),
        cameras=Cameras(**part("cameras"), width=facts["size"][0], height=facts["size"][1]),
        features=FeatureGaussians(**part("features")),
        base=Gaussians(**part("base")),
        photos=Photos(black, **part("photos"), eps2d=facts["eps2d"]),
        images=arrays["images"],
        covers=arrays["covers"],
    )


def _read(path: Path, prefix: str = "") -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read the arrays whose names begin with ``prefix``, and the facts in the header."""
    try:
        with safe_open(path, "np") as file:
            facts = json.loads((file.metadata() or {})[FORMAT])
            return {n: file.get_tensor(n) for n in file.keys() if n.startswith(prefix)}, facts  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
        raise SceneError(path, "expected an example, found a damaged file or none", REMEDY) from error


TrainingSource = Shard | PredictedCapture


def read_example(
    source: TrainingSource, options: TrainOptions, rng: np.random.Generator, *, check: bool = True
) -> Example:
    """Read the example of a shard as :func:`read_shard` does, or draw an example of a capture."""
    if isinstance(source, Shard):
        return read_shard(source, check=check)
    return source.draw(options, rng)


class ExampleStreams:
    """Streams of examples, one stream for each crop of a step."""

    def __init__(self, shards: Sequence[TrainingSource], options: TrainOptions) -> None:
        self.shards, self.options = shards, options
        self.pool = ThreadPoolExecutor(options.workers, "gsmerge-read", initializer=work_alone)
        # Examples in memory, or being read, by number of the shard and, for a capture, place in the order (else 0)
        self.examples: dict[tuple[int, int], Future[Example]] = {}
        self.checked: set[int] = set()

    def move_to(self, step: int) -> None:
        """Load the shards that ``step`` may draw from and the next ones; release all others."""
        ahead = self.options.buffer + 1
        keys = [self._key(step, crop, slot) for slot in range(ahead) for crop in range(self.options.crops)]
        for key in self.examples.keys() - set(keys):
            self.examples.pop(key).cancel()
        for key in keys:
            if key not in self.examples:
                self.examples[key] = self.pool.submit(self._read, *key)

    def draw(self, step: int, crop: int, rng: np.random.Generator) -> Example:
        """Return a random example for crop number ``crop`` of the current step."""
        slot = int(rng.integers(self.options.buffer))
        return self.examples[self._key(step, crop, slot)].result()

    def shard_id(self, step: int, crop: int, slot: int) -> int:
        """Return the number of the shard in one slot of a crop's stream; slot 0 is the oldest."""
        epoch, index = divmod(self._position(step, crop, slot), len(self.shards))
        return int(_order(self.options.seed, epoch, len(self.shards))[index])

    def _position(self, step: int, crop: int, slot: int) -> int:
        return (step // self.options.refresh + slot) * self.options.crops + crop

    def _key(self, step: int, crop: int, slot: int) -> tuple[int, int]:
        number = self.shard_id(step, crop, slot)
        return number, 0 if isinstance(self.shards[number], Shard) else self._position(step, crop, slot)

    def _read(self, number: int, position: int) -> Example:
        rng = np.random.default_rng([self.options.seed, DRAWN, position])
        example = read_example(self.shards[number], self.options, rng, check=number not in self.checked)
        self.checked.add(number)
        return example


@contextmanager
def open_streams(shards: Sequence[TrainingSource], options: TrainOptions) -> Iterator[ExampleStreams]:
    """Open streams of examples; their threads end at the end of the block."""
    streams = ExampleStreams(shards, options)
    try:
        yield streams
    finally:
        streams.pool.shutdown(cancel_futures=True)


@lru_cache(maxsize=4)
def _order(seed: int, epoch: int, count: int) -> np.ndarray:
    """Shuffle all shards for one pass over them, ``[count]``."""
    return np.random.default_rng([seed, ORDER, epoch]).permutation(count)
