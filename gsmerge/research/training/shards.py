"""Store examples in files, so that few of them are in memory at a time.

A shard is a safetensors file with one example. The shards of a scene are listed in a record, a JSON file that is
written after all shards. The record's name is a hash of the scene's files and of the settings, so that an interrupted
call continues with the first scene that has no record.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass, fields
from gsmerge.io.atomic import atomic_output
from gsmerge.jobs.content_hash import content_hash, digest, list_files
from gsmerge.method.geometry.pooling import Members
from gsmerge.method.raster.photos import Photos
from gsmerge.reading.scene_files import find_scene_files
from gsmerge.research.training.examples import Example, example_name, make_examples
from gsmerge.research.training.train_options import TrainOptions
from gsmerge.runtime.record import Progress
from gsmerge.types import Cameras, FeatureGaussians, Gaussians
from gsmerge.version import __version__

LAYOUT = 7  # version of the files and their contents
EXAMPLE_FORMAT = "gsmerge-example"
EXAMPLE_REMEDY = "remove it; the next call makes it again"
# Settings that decide an example, besides its views
EXAMPLE_SETTINGS = ("densities", "segmentation", "photo_scale", "photo_side", "seed")
STORED_PARTS = {"members": Members, "features": FeatureGaussians, "base": Gaussians}  # all their fields are arrays


@dataclass(frozen=True)
class Shard:
    """File that stores one example."""

    path: Path
    scene: str  # name of the scene
    sha256: str  # hash of the arrays


def prepare_shards(
    scenes: Sequence[Path], options: TrainOptions, folder: Path, progress: Progress = lambda *_: None
) -> list[Shard]:
    """Return the shards of all scenes in order; missing shards are made.

    ``scenes`` are folders or ``.ply`` files. ``progress`` is called with (words, number of finished scenes, number of
    scenes). Raises SceneError if a scene cannot be used, or if the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SceneError(folder, f"cannot be written ({error.strerror})", "choose another folder") from error
    shards: list[Shard] = []
    for number, scene in enumerate(scenes):
        progress(f"examples: {example_name(scene)}", number, len(scenes))
        key = scene_key(scene, options)
        name = example_name(scene)
        record = folder / f"{key[:32]}.json"
        hashes = _read_hashes(record)
        if hashes is None:
            hashes = {}
            for label, make in make_examples(scene, options):
                path = folder / f"{key[:32]}-{label}.safetensors"
                hashes[path.name] = write_shard(path, make())
            with atomic_output(record, overwrite=True) as temporary:  # after all shards
                temporary.write_bytes(json.dumps(hashes, indent=1).encode() + b"\n")
        shards += [Shard(folder / file, name, sha256) for file, sha256 in hashes.items()]
    return shards


def scene_key(scene: Path, options: TrainOptions) -> str:
    """Return a hash of a scene's files, and of the settings that decide its examples.

    Raises SceneError if there is no scene.
    """
    head = {"layout": LAYOUT, "gsmerge": __version__, "views": options.example_views}
    head |= {name: getattr(options, name) for name in EXAMPLE_SETTINGS}
    files = find_scene_files(scene)
    targets = files.ply.parent / "targets"
    # Held-out photos get a separate hash, because a hash contains names relative to one folder
    held_out = content_hash([targets]) if targets.is_dir() else None
    return digest({**head, "content": content_hash(list_files(files)), "held_out": held_out})


def _read_hashes(path: Path) -> dict[str, str] | None:
    """Read the hash of each shard from a scene's record.

    Returns None if there is no record, or if a shard is missing.
    """
    try:
        hashes = json.loads(path.read_text())
        return hashes if all(path.with_name(file).is_file() for file in hashes) else None
    except (OSError, ValueError, TypeError):
        return None


def write_shard(path: Path, example: Example) -> str:
    """Write an example to a file, which is replaced, and return the hash of its arrays.

    Raises SceneError if the file cannot be written.
    """
    arrays = {
        f"{part}.{f.name}": np.ascontiguousarray(getattr(getattr(example, part), f.name))
        for part, kind in STORED_PARTS.items()
        for f in fields(kind)
    }
    for part, cameras in (("cameras", example.cameras), ("photos", example.photos)):
        arrays[f"{part}.viewmats"] = np.ascontiguousarray(cameras.viewmats)
        arrays[f"{part}.Ks"] = np.ascontiguousarray(cameras.Ks)
    arrays |= {"images": example.images, "covers": example.covers}
    facts = {"layout": LAYOUT, "sha256": hash_arrays(arrays), "unit": example.unit, "eps2d": example.photos.eps2d}
    facts |= {"size": [example.cameras.width, example.cameras.height]}
    with atomic_output(path, overwrite=True) as temporary:
        # ``save_file`` would change the rights of the file
        temporary.write_bytes(save(arrays, {EXAMPLE_FORMAT: json.dumps(facts)}))
    return str(facts["sha256"])


def hash_arrays(arrays: Mapping[str, np.ndarray]) -> str:
    """Hash names, types, shapes and values by SHA-256."""
    state = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        state.update(json.dumps([name, str(array.dtype), *array.shape]).encode("ascii"))
        state.update(array.data if array.size else b"")
    return state.hexdigest()


def read_shard(shard: Shard) -> Example:
    """Read the example of a shard, and compare the arrays with their hash.

    Raises SceneError if the file is missing, damaged, or has changed since the run began.
    """
    try:
        with safe_open(shard.path, "np") as file:
            facts = json.loads((file.metadata() or {})[EXAMPLE_FORMAT])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
        raise SceneError(shard.path, "expected an example, found a damaged file or none", EXAMPLE_REMEDY) from error
    if hash_arrays(arrays) != shard.sha256:
        raise SceneError(
            shard.path, "expected the example that was written, found a damaged file or another", EXAMPLE_REMEDY
        )

    def part(name: str) -> dict[str, Any]:
        """Return the arrays of a part of the example by field."""
        prefix = f"{name}."
        return {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}

    black = np.broadcast_to(np.float32(0), arrays["images"].shape)  # the photos' colours are in ``images``
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
